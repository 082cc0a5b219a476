"""A demand that takes too long is refused, also after a kill, and holds up nobody else.

The processor time is that of a clock which moves with each look at it.
"""

from __future__ import annotations

import json
import logging
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from demandops.serve import agenda
from demandops.serve.generator import Generator
from demandops.serve.journal import Ticket

from tests.kit import goals, rig
from tests.kit.clock import Clock

LOOKS = 400
"""After so many looks at the clock, the time of a decision is over."""


class Ticking(Clock):
    look_s = 0.5 / LOOKS


def large(name: str) -> dict[str, Any]:
    """Return a demand with 1,000 placements and 1,000 connections."""
    inputs = {"ego_data": [{"topic": "/ego", "source": "vehicle00"}]}
    app = {"type": "object-detection-fusion", "place": {"role": "edge"}, "inputs": inputs}
    link = {"type": "mqtt", "source": "vehicle00", "target": "edge"}
    return {
        "kind": "Demand",
        "demand": name,
        "requesters": ["attacker"],
        "applications": [app | {"id": f"{name}-{number}"} for number in range(1000)],
        "connections": [
            link | {"id": f"{name}-{number}", "topics": [{"source": f"/{name}/t{number}"}]}
            for number in range(1000)
        ],
    }


def connections(name: str) -> dict[str, Any]:
    return large(name) | {"applications": []}


def booked_in_time(name: str) -> dict[str, Any]:
    """Return a demand that is admitted in time, and not rendered in time."""
    return connections(name) | {"connections": connections(name)["connections"][: LOOKS // 2]}


def too_many_topics(name: str) -> dict[str, Any]:
    made = connections(name)
    topics = [{"source": f"/t{number}"} for number in range(19_000)]
    return made | {"connections": [made["connections"][0] | {"topics": topics}]}


Send = Callable[..., Ticket]


def sender(generator: Generator, order: list[str]) -> Send:
    """Return a function that sends a demand and notes in ``order`` when it is answered."""

    def send(name: str, goal: Any, *listener: Any) -> Ticket:
        ticket = generator.submit(goal, name, *listener)
        ticket.future.add_done_callback(lambda _: order.append(name))
        return ticket

    return send


@pytest.mark.parametrize("made", [large, connections, too_many_topics])
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


@pytest.mark.parametrize("made", [large, connections])
def test_after_a_kill_in_the_middle_it_is_refused_and_leaves_the_journal(
    bare: Path, made: Any, caplog: pytest.LogCaptureFixture
) -> None:
    killed = subprocess.run(
        [sys.executable, "-c", DIES, str(bare)],
        input=json.dumps(made("d")),
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
