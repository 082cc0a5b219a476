"""A demand that takes too long is refused, also after a kill, and holds up nobody else.

The processor time is that of a clock which moves with each look at it.
"""

from __future__ import annotations

import json
import logging
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from demandops.model.demand import goals as demand_goals
from demandops.repo.git.repository import StateRepository
from demandops.repo.write.commit_batch import CommitBatch
from demandops.serve import agenda, worker
from demandops.serve.agenda import Agenda
from demandops.serve.generator import Generator
from demandops.serve.journal import Ticket
from demandops.templating.evaluator import processor_time

from tests.kit import goals, rig
from tests.kit.clock import Clock
from tests.kit.repo import Person

ROOT = "appdefs/object-detection-fusion"
APPDEF, TEMPLATE = f"{ROOT}/appdef.yaml", f"{ROOT}/values/object-fusion.yaml.j2"
NODES, POLICY, SETTINGS = "inventory/nodes.yaml", "policy/access-domains.yaml", "demandops.yaml"
ENDLESS = "{% for a in range(99999) %}{% for b in range(99999) %}{% endfor %}{% endfor %}"
LOOKS = 400
"""After so many looks at the clock, the time of a decision is over."""


class Ticking(Clock):
    look_s = 0.5 / LOOKS


def connections(name: str, count: int = 1000) -> dict[str, Any]:
    link = {"type": "mqtt", "source": "vehicle00", "target": "edge"}
    made = [
        link | {"id": f"{name}-{number}", "topics": [{"source": f"/{name}/t{number}"}]}
        for number in range(count)
    ]
    return {"kind": "Demand", "demand": name, "requesters": ["attacker"], "connections": made}


def placed(id: str) -> dict[str, Any]:
    inputs = {"ego_data": [{"topic": "/ego", "source": "vehicle00"}]}
    return {
        "id": id,
        "type": "object-detection-fusion",
        "place": {"role": "edge"},
        "inputs": inputs,
    }


def placements(name: str) -> dict[str, Any]:
    apps = [placed(f"{name}-{number}") for number in range(1000)]
    return connections(name) | {"applications": apps}


def booked_in_time(name: str) -> dict[str, Any]:
    """Return a demand that is admitted in time, and not rendered in time."""
    return connections(name, LOOKS // 2)


def too_many_topics(name: str) -> dict[str, Any]:
    made = connections(name, 1)
    made["connections"][0]["topics"] = [{"source": f"/t{number}"} for number in range(19_000)]
    return made


Send = Callable[..., Ticket]


def sender(generator: Generator, order: list[str]) -> Send:
    """Return a function that sends a demand and notes in ``order`` when it is answered."""

    def send(name: str, goal: Any, *listener: Any) -> Ticket:
        ticket = generator.submit(goal, name, *listener)
        ticket.future.add_done_callback(lambda _: order.append(name))
        return ticket

    return send


@pytest.mark.parametrize("made", [placements, connections, too_many_topics])
def test_who_sends_what_takes_too_long_holds_up_others_for_one_demand(
    bare: Path, made: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(agenda, "LONGEST_EVALUATION_S", 0.0)
    order: list[str] = []
    with rig.running(bare, runtime=Ticking()) as generator:
        send = sender(generator, order)
        with rig.busy(generator, rig.goal(1) | {"id": "attacker's"}):
            attacks = [send(f"a{number}", made(f"a{number}")) for number in range(4)]
            other = send("other", rig.goal(0))
        assert rig.outcome(other) == "booked"
        for ticket in attacks:
            assert rig.outcome(ticket) == "too-large"
            # what is too large is not even written to the journal
            assert ticket.journaled.result() is (made is not too_many_topics)
        assert (generator._demands._journal.pending, generator.unpublished) == ({}, 0)
    assert order.index("other") <= (4 if made is too_many_topics else 1)
    rig.assert_sound(bare)


def test_a_demand_that_comes_meanwhile_is_next(bare: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(agenda, "LONGEST_EVALUATION_S", 0.0)
    order: list[str] = []
    busy = rig.Gate()
    with rig.running(bare, runtime=Ticking()) as generator:
        send = sender(generator, order)
        with rig.busy(generator, rig.goal(1)):
            attacks = [send("a0", booked_in_time("a0"), busy)]
            attacks += [send(f"a{number}", booked_in_time(f"a{number}")) for number in range(1, 4)]
        assert busy.reached.wait(rig.PATIENCE_S)
        other = send("other", rig.goal(0))
        rig.wait_until_queued([*attacks, other])
        busy.open.set()
        assert rig.outcome(other) == "booked"
        assert {rig.outcome(ticket) for ticket in attacks} == {"too-large"}
    assert order[:2] == ["a0", "other"]


DIES = f"""
import json, os, signal, sys
from demandops.base.runtime import Runtime
from demandops.serve.generator import Generator

class Dying(Runtime):
    looks = 0

    def processor_s(self):
        self.looks += 1
        if self.looks > {LOOKS} // 2:
            os.kill(os.getpid(), signal.SIGKILL)
        return 0.0

generator = Generator(sys.argv[1], runtime=Dying())
generator.submit(json.load(sys.stdin), "op-large").future.result(60)
"""


def test_after_a_kill_in_the_middle_it_is_refused_and_leaves_the_journal(
    bare: Path, caplog: pytest.LogCaptureFixture
) -> None:
    killed = subprocess.run(
        [sys.executable, "-c", DIES, str(bare)],
        input=json.dumps(placements("d")),
        text=True,
        check=False,
        timeout=rig.PATIENCE_S,
    )
    assert killed.returncode == -signal.SIGKILL
    with caplog.at_level(logging.INFO), rig.running(str(bare), runtime=Ticking()) as generator:
        assert "resuming demand op-large from the journal" in caplog.text
        assert rig.book(generator, rig.goal(0))[0].outcome == "booked"
        pending = generator._demands._journal.pending
        rig.wait_until(lambda: not pending, "the large demand to be answered")
        assert generator.unpublished == 0
    assert "demand op-large ('d') from the journal: refused: too-large" in caplog.text
    assert rig.restart(bare)
    assert [commit.one("Operation") for commit in rig.commits(bare)] == ["join"]


def test_what_was_decided_is_published_before_a_large_demand_is_begun(
    generator: Generator,
) -> None:
    told = list[tuple[str, str]]()
    topics = [f"/t{number:070}" for number in range(300)]
    big = goals.goal([], [goals.connection("c9", who=["r9"], topics=topics)], id="9")
    with rig.busy(generator, rig.goal(1)):
        sent = [
            generator.submit(
                goal, listener=lambda stage, text, name=name: told.append((name, stage))
            )
            for name, goal in (("small", rig.goal(2)), ("large", big))
        ]
    assert [rig.outcome(ticket) for ticket in sent] == ["booked", "booked"]
    assert told.index(("small", "pushed")) < told.index(("large", "admitted"))


def test_a_rollback_may_take_longer_than_a_demand(
    generator: Generator, bare: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker, "DEMAND_S", 0.05)  # all services together take longer
    demands = [
        goals.goal([goals.application(f"edge/f-{number}")], id=f"demand-{number}")
        for number in range(60)
    ]
    rig.book(generator, *demands)
    then = rig.tip(bare)
    rig.book(generator, *(demand | {"shutdown": True} for demand in demands))
    who = ("A person", "person@example.org")
    back = demand_goals.rollback(then, drop_newer=False, reason="a test", who=who)
    assert rig.receipt(generator.submit(back)).outcome == "restored"


# ---- demands that wait for room ----


@pytest.fixture
def crowded(bare: Path, person: Person, clock: Clock) -> Iterator[Generator]:
    """A generator of a full edge: the demand `a` is booked, and `b` to `f` wait for room."""
    service, domain = "  object-fusion:\n", "    namespace: perception\n"
    patient = f"{person.read(SETTINGS)}limits: {{decisionMilliseconds: 1000000}}\n"
    edits = {
        APPDEF: (service, f"{service}    requests: {{cpu: 1}}\n"),
        NODES: ("- id: edge\n", "- id: edge\n    capacity: {cpu: 1}\n"),
        POLICY: (domain, f"{domain}    whenFull: wait\n"),
    }
    changed = {path: person.read(path).replace(*edit) for path, edit in edits.items()}
    person.change(changed | {SETTINGS: patient})
    demands = [connections(name, 0) | {"applications": [placed(name)]} for name in "abcdef"]
    with rig.running(bare, runtime=clock) as generator:
        rig.book(generator, *demands)
        yield generator


def runs(bare: Path) -> list[str]:
    return sorted(rig.books(bare)["services"])


def test_waiting_demands_are_tried_in_rounds_until_all_were_tried(
    crowded: Generator, bare: Path, person: Person, clock: Clock
) -> None:
    assert runs(bare) == ["of-a"]
    clock.look_s = 1.0  # so a round is over once it has tried one demand
    person.change({NODES: person.read(NODES).replace("{cpu: 1}", "{cpu: 9}")})
    crowded.fetch_now()
    rig.wait_until(lambda: len(runs(bare)) == 6, "all waiting demands to be booked")


def test_a_round_ends_with_a_demand_whose_template_takes_too_long(
    crowded: Generator, bare: Path, person: Person
) -> None:
    nodes, template = person.read(NODES).replace("{cpu: 1}", "{cpu: 9}"), person.read(TEMPLATE)
    person.change({NODES: nodes, TEMPLATE: ENDLESS + template}, "Room, and no end")
    rig.book(crowded, goals.link(1))
    # two threads must not use one repository
    own = StateRepository(bare)
    turns = Agenda(0, own.runtime)
    with processor_time(0.1):
        turns.book_waiting(CommitBatch(own, crowded.snapshot))
    assert turns.left
    person.change({TEMPLATE: template}, "An end")
    rig.book(crowded, goals.link(2))
    rig.wait_until(lambda: len(runs(bare)) == 6, "all waiting demands to be booked")
