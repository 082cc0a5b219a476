"""The commit messages that `git log` shows, and their authors."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from demandops.base.errors import fault
from demandops.decide.decision import Decision
from demandops.decide.state import ReleaseChange
from demandops.model.config.load import load
from demandops.model.demand.demand import Decommission
from demandops.repo.history import commit_message

from tests.kit import goals
from tests.kit.config import state_of
from tests.kit.memory import MemoryRepo
from tests.scenarios.running import configuration
from tests.unit.repo.conftest import NOW, Desk

FILE = Path(__file__).with_name("commit-messages.txt")
CONNECTION = goals.connection(
    "station00/edge", ends=("station00", "edge"), topics=[goals.STATION_CLOUD[0]], broker=""
)


def messages() -> Iterator[tuple[str, str]]:
    """Yield the text of each kind of commit, with what it is for."""

    def text(decision: Decision) -> str:
        return commit_message.of_decision(decision, "op-1", NOW)

    yield "a join with a warning", text(Desk(now=NOW).join("vehicle00", "station00"))
    desk = Desk(now=NOW)
    desk.join("vehicle00")
    more = desk.join("vehicle00", cloud="/stations/station00/rear")
    yield "a join that changes a release", text(more)
    same = desk.join("vehicle01", cloud="/stations/station00/rear")
    yield "a join that changes nothing", text(same)
    app = goals.application("edge/fusion", clouds=[])
    goal = goals.goal([app], [CONNECTION], id="intersection", shutdown=True)
    desk = Desk(now=NOW)
    desk.join("vehicle00")
    yield "a shutdown that lists what was not held", text(desk.send(goal))
    some = goals.application("edge/fusion", clouds=[("/stations/station00/rear", "station00")])
    desk = Desk(now=NOW)
    desk.join("vehicle00")
    desk.join("vehicle00", cloud="/stations/station00/rear")
    goal = goals.goal([some], [], id="intersection", shutdown=True)
    yield "a shutdown of a topic", text(desk.send(goal))
    releases = [ReleaseChange("of-edge", "object-fusion on edge", "", "change", ("- replicas 1",))]
    problems = [fault("nodes[0].id", "appears twice; remove one").within("inventory/nodes.yaml")]
    ids, how = ("c" * 40, "b" * 40), "correct the files, or undo the commits: git revert cccc"
    followed = commit_message.of_follow(releases, *ids, "", [], "")
    yield "a commit that follows one of a person", followed
    held = commit_message.of_follow([], *ids, "b" * 40, problems, how)
    yield "a commit that follows one whose configuration is not valid", held
    put_back = commit_message.of_follow([], *ids, "", problems, "")
    yield "a commit that puts a claim back", put_back
    long = Desk(now=NOW).join("vehicle00", application="edge/" + "fusion" * 40)
    yield "a long id", text(long).split("\n")[0]
    full = MemoryRepo(state=state_of(load(configuration(config=FULL))))
    release = {"kind": "Demand", "operation": "release", "demand": "d1", "requesters": ["v"]}
    for wanted in (
        waiting("d1", "v"),
        waiting("d2", "solo"),
        Decommission(id="solo", kinds=frozenset({"requester"})),
        release,
    ):
        yield "a demand that waits", commit_message.of_decision(full.send(wanted), "op", full.now)


FULL = {
    "inventory/nodes.yaml": {
        "nodes": [{"id": "edge", "type": "edge", "cluster": "c-its", "capacity": {"cpu": 1}}]
    },
    "inventory/brokers.yaml": {"brokers": []},
    "policy/access-domains.yaml": {
        "domains": [{"name": "all", "namespace": "all", "whenFull": "wait"}]
    },
    "appdefs/object-detection-fusion/appdef.yaml": {
        "services": {"object-fusion": {"requests": {"cpu": 2}}}
    },
}


def waiting(demand: str, who: str) -> goals.Goal:
    made = goals.put(demand, who, topic=("/ego", "edge"), node="")
    made["applications"][0]["place"] = {"role": "edge"}
    return made


def listing() -> str:
    return "".join(f"==== {title} ====\n{text.rstrip()}\n\n" for title, text in messages())


def test_messages_are_those_of_the_file() -> None:
    assert listing() == FILE.read_text(), f"run python -m {__name__} and review the diff"


@pytest.mark.parametrize(
    ("names", "wanted"),
    [
        (("vehicle00", "station00"), "vehicle00, station00 (requesters)"),
        (("Ada <ada@example.org>",), "Ada (ada@example.org) (requester)"),
        (("x" * 300,), "x" * 187 + "… (requester)"),
        ((".",), "(requester)"),
        (("\\",), "(requester)"),
        (("'quoted'",), "quoted' (requester)"),
    ],
)
def test_the_author_is_the_requesters_as_listed_and_never_a_person(
    desk: Any, names: tuple[str, ...], wanted: str
) -> None:
    decision = desk.join(*names)
    who = commit_message.author(decision, desk.now)
    assert who.name == wanted
    demand = decision.changes.claims[0].key.demand
    assert who.email == f"{demand}@requester.demandops.invalid"
    assert (who.time, who.offset) == (int(desk.now.timestamp()), 0)


if __name__ == "__main__":
    FILE.write_text(listing())
