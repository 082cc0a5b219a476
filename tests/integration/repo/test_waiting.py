"""Demands that lack only room wait in the state repo; any generator books them in order."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from demandops.model.ledger import records
from demandops.repo.write.commit_batch import CommitBatch
from demandops.serve.agenda import Agenda
from demandops.serve.generator import Generator
from demandops.templating.evaluator import processor_time

from tests.integration.repo.test_hanging_template import ENDLESS, TEMPLATE
from tests.kit import rig
from tests.kit.clock import Clock, Turns
from tests.kit.goals import link
from tests.kit.repo import read as file_of
from tests.kit.rig import Person

APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
NODES, DOMAINS = "inventory/nodes.yaml", "policy/access-domains.yaml"


def _with_room_for_one(bare: Path) -> dict[str, str | None]:
    """Return files in which the edge has room for one application, so that further ones wait."""
    appdef = file_of(bare, APPDEF)
    service = "  object-fusion:\n"
    assert service in appdef
    return {
        APPDEF: appdef.replace(service, f"{service}    requests: {{cpu: 1}}\n"),
        NODES: file_of(bare, NODES).replace("- id: edge\n", "- id: edge\n    capacity: {cpu: 1}\n"),
        DOMAINS: file_of(bare, DOMAINS).replace(
            "    namespace: perception\n", "    namespace: perception\n    whenFull: wait\n"
        ),
    }


def _put(name: str, **more: Any) -> dict[str, Any]:
    inputs = {"ego_data": [{"topic": "/ego", "source": "vehicle00"}]}
    app = {"id": name, "type": "object-detection-fusion", "place": {"role": "edge"}}
    head = {"kind": "Demand", "demand": name, "requesters": ["vehicle00"]}
    return head | {"applications": [app | {"inputs": inputs}]} | more


def _runs(bare: Path) -> list[str]:
    return sorted(rig.books(bare)["services"])


def test_a_waiting_demand_that_a_person_breaks_waits_on_until_its_file_is_deleted(
    generator: Generator, bare: Path, person: Person
) -> None:
    person.change(_with_room_for_one(bare))
    outcomes = [rig.outcome(generator.submit(_put(name))) for name in "abc"]
    assert outcomes == ["booked", "waiting", "waiting"]
    paths = {name: records.waiting_path(name) for name in "bc"}
    whole = file_of(bare, paths["b"])
    person.change({paths["b"]: "kind: nonsense\n", paths["c"]: None})
    release = {"kind": "Demand", "demand": "a", "requesters": ["vehicle00"], "operation": "release"}
    rig.book(generator, _put("d"))
    assert file_of(bare, paths["b"]) == whole
    rig.book(generator, release)
    rig.wait_until(lambda: "b" in str(_runs(bare)), "b runs")
    assert not file_of(bare, paths["c"])
    rig.assert_sound(bare)


def test_a_waiting_demand_whose_answer_was_lost_is_answered_again(
    bare: Path, person: Person, tmp_path: Path
) -> None:
    """The repeated demand gets no commit of its own; the next commit records that it waits."""
    person.change(_with_room_for_one(bare), "One at a time")
    turns, base = Turns(1), rig.tip(bare)
    generator = Generator(str(bare), data=tmp_path / "first", runtime=turns)
    goals = [_put("a"), _put("b"), _put("b"), _put("c")]
    tickets = [generator.submit(goal, f"op-{number}") for number, goal in enumerate(goals)]
    turns.wait(generator.stop().done)
    outcomes = [ticket.future.result().outcome for ticket in tickets]
    assert outcomes == ["booked", *["waiting"] * 3]

    received = tickets[2].received.isoformat()
    rig.leave_in_journal(tmp_path / "second", rig.journaled("op-2", goals[2], received, base))
    again = Generator(str(bare), data=tmp_path / "second", runtime=turns)
    resumed = again._demands._journal.pending["op-2"].future
    turns.wait(again.stop().done)
    assert resumed.result().outcome == "waiting"


def test_waiting_demands_are_tried_in_rounds_until_all_were_tried(
    bare: Path, person: Person
) -> None:
    files = _with_room_for_one(bare)
    settings = file_of(bare, "demandops.yaml")
    files["demandops.yaml"] = f"{settings}limits: {{decisionMilliseconds: 1000000}}\n"
    person.change(files, "One at a time")
    clock = Clock()
    with rig.running(bare.as_uri(), runtime=clock) as generator:
        rig.book(generator, *(_put(name) for name in "abcdef"))
        assert _runs(bare) == ["of-a"]
        clock.look_s = 1.0  # so a round is over once it has tried one demand
        nodes = file_of(bare, NODES).replace("{cpu: 1}", "{cpu: 9}")
        person.change({NODES: nodes}, "Room for all")
        generator.fetch_now()
        rig.wait_until(lambda: len(_runs(bare)) == 6, "all waiting demands to be booked")


def test_a_round_ends_with_a_demand_whose_template_takes_too_long(
    bare: Path, person: Person
) -> None:
    person.change(_with_room_for_one(bare), "One at a time")
    with rig.running(bare) as generator:
        rig.book(generator, *(_put(name) for name in "abc"))
        nodes = file_of(bare, NODES).replace("{cpu: 1}", "{cpu: 9}")
        template = file_of(bare, TEMPLATE)
        person.change({NODES: nodes, TEMPLATE: ENDLESS + template}, "Room, and no end")
        rig.book(generator, link(1))
        turns = Agenda(0, generator._repository.runtime)
        with processor_time(0.1):
            turns.book_waiting(CommitBatch(generator._repository, generator.snapshot))
        assert turns.left
        person.change({TEMPLATE: template}, "An end")
        rig.book(generator, link(2))
        rig.wait_until(lambda: _runs(bare)[-3:] == ["of-a", "of-b", "of-c"], "all to be booked")
