"""Different ids give different names, or the second is refused and nothing of the first is touched.

The tests of refusals shorten digests to one digit, so that names are the same by chance.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from random import Random
from typing import Any

import pytest
import yaml
from demandops.base import naming
from demandops.base.errors import InvalidInput, Refused
from demandops.base.naming import SubjectKind, id_problem
from demandops.decide.booking import Drain
from demandops.decide.checks import collisions
from demandops.decide.decision import decide
from demandops.decide.placement.relocation import following_overrides
from demandops.decide.state import rendered_files
from demandops.model.config.load import load
from demandops.model.demand.demand import Requirement
from demandops.model.demand.goals import read_goal
from demandops.model.ledger import records
from demandops.model.ledger.claim import demand_id
from demandops.model.ledger.ledger import Changes
from demandops.model.ledger.records import Wait, WaitingDemand
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.chance import chances, examples, rival, told, visible
from tests.kit.config import configuration, override, skeleton, state_of
from tests.kit.goals import CLOUD, Goal, application, connection, goal, put
from tests.kit.memory import NOW, MemoryRepo, ledger_in, outcome, rebuilt
from tests.kit.plain_yaml import FAST

NODES = "inventory/nodes.yaml"


alike = st.builds(
    "{}{}{}".format,
    st.sampled_from(["a", "A"]),
    st.sampled_from(["/", "//", "-", "_/", "/-", "_", "/_", "-/"]),
    st.sampled_from(["b", "B", "b/", "b_"]),
)
"""Ids with one slug; a name that is made from them differs in the digest only."""

nodes = st.sampled_from(["edge", "cloud"])
topics = st.lists(
    st.sampled_from([CLOUD[0], "/a_b", "/a/b", "/a__b", "/A/b"]), min_size=1, max_size=2
)
ends = st.sampled_from([("vehicle00", "edge"), ("vehicle01", "cloud")])
# every item has another target topic, because a second source of a topic is refused too
targets = st.integers(0, 99).map("/t{}".format)
who = st.sampled_from(["vehicle00", "vehicle01"])


def reading(id: str, *topics: str, who: str = "vehicle00", demand: str = "", **where: Any) -> Goal:
    """Return a demand whose shared services have names made from the topics and the node."""
    inputs = {"point_cloud": [{"topic": one, "source": CLOUD[1]} for one in topics]}
    app = {"id": id, "type": "object-detection-fusion", "connect": "none", "inputs": inputs}
    made = {"kind": "Demand", "demand": demand or id, "requesters": [who]}
    return made | {"applications": [app | where]}


joins = st.builds(
    lambda request, app, node, link, ends, who, topics, target: goal(
        [application(app, node=node, who=[who], clouds=[(one, CLOUD[1]) for one in topics])],
        [connection(link, who=[who], ends=ends, topics=["/x"], targets=[target])],
        id=request,
    ),
    *(alike, alike, nodes, alike, ends, who, topics, targets),
)
links = joins.map(lambda joined: joined | {"id": joined["connections"][0]["id"], "apps": []})
puts = st.builds(
    lambda demand, app, node, who, topics: reading(app, *topics, who=who, demand=demand, node=node),
    *(alike, alike, nodes, who, topics),
)


def end_of(request: Goal) -> Goal:
    if "demand" in request:
        return request | {"operation": "release", "applications": []}
    return request | {"shutdown": True}


def assert_apart(repo: MemoryRepo) -> None:
    """Check that each file is whole, and that each name belongs to one release."""
    assert ledger_in(repo.files) == repo.state.ledger
    again = rendered_files(repo.state)
    assert {path: repo.files[path] for path in again} == again
    assert repo.rendered().keys() == again.keys() - repo._initial.keys()
    texts = repo.rendered().values()
    documents = [one for text in texts for one in yaml.load_all(text, Loader=FAST)]
    named = [(one["kind"], one["metadata"]["name"]) for one in documents]
    assert len(set(named)) == len(named), "two objects of one domain have one name"
    for pattern in (r"nodeName: (\S+)", r"node_name:=(\S+?)\"", r" id: (\S+)"):
        names = [name for text in texts for name in re.findall(pattern, text)]
        assert len(set(names)) == len(names), pattern
    links = repo.state.ledger.subjects(SubjectKind.CONNECTION)
    channels = {naming.object_name("mqtt", id) for id in links}
    assert len(channels) == len(links), "two connections have one channel"


@pytest.mark.usefixtures("short_digests")
@given(st.lists(st.one_of(joins, links, puts), min_size=2, max_size=14), chances)
@examples(24)
def test_whatever_the_ids_each_has_its_own_names_and_files_or_is_refused(
    requests: list[Goal], random: Random
) -> None:
    repo, refused, taken = MemoryRepo(), [], []
    for request in told(requests):
        result = repo.take(request)  # checks that a refused request changes nothing
        if isinstance(result, Refused):
            assert {fault.code for fault in result.faults} <= {"conflict", "not-yours"}
            refused.append(request)
        else:
            taken.append(request)
        if random.random() < 0.3:
            repo.take(end_of(random.choice(requests)))
        assert_apart(repo)
    for request in taken:
        repo.take(end_of(request))
        assert_apart(repo)
    assert not repo.rendered()
    for request in refused:
        assert outcome(repo.take(request)) == outcome(MemoryRepo().take(request))
        repo.take(end_of(request))


@pytest.mark.usefixtures("short_digests")
def test_two_nodes_have_two_folders() -> None:
    other = rival("Van", lambda id: naming.object_name("", id))
    nodes = skeleton()[NODES] + "".join(
        f"  - id: {id}\n    type: vehicle\n    cluster: c-its\n    selector: {{van: a}}\n"
        for id in ("Van", other)
    )
    with pytest.raises(InvalidInput) as refused:
        load(configuration({NODES: nodes}))
    (found,) = refused.value.faults
    assert (found.file, found.field.split(".")[-1]) == (NODES, "id")
    assert "'Van'" in found.message


@pytest.mark.usefixtures("short_digests")
def test_two_waiting_demands_have_two_files() -> None:
    other = rival("Van", records.waiting_path)
    one, two = (WaitingDemand(read_goal(put(demand)), NOW) for demand in ("Van", other))
    request = Wait(demand=other, waiting=two)

    def faults(text: str | None) -> list[str]:
        files = {records.waiting_path("Van"): text}
        found = collisions.faults_in_files(request, Changes(waiting=(other,)), files.get)
        return [fault.code for fault in found]

    assert faults(None) == faults(records.waiting_text(two)) == []
    assert faults(records.waiting_text(one)) == ["conflict"]


def rivals_at(node: str) -> str:
    """Return a topic whose service on ``node`` has the name of the one for ``/p/a``."""
    probe = MemoryRepo()
    probe.send(reading("probe", "/p/a", node=node))
    for number in range(1, 1000):
        other = f"/p{'_' * (number % 30)}/{'_' * (number // 30)}a"
        taken = probe.copy().take(reading("rival", other, node=node))
        if isinstance(taken, Refused) and "release" in str(taken):
            return other
    raise AssertionError("no topic has the same name")


@pytest.mark.usefixtures("short_digests")
def test_a_name_that_is_taken_keeps_one_application_on_a_drained_node_and_no_other() -> None:
    repo = MemoryRepo()
    repo.send(reading("a", "/p/a", node="cloud"))
    repo.send(reading("b", "/q/b", node="cloud"))
    placed = (
        replace(one, held=replace(one.application, place=Requirement(role="edge")))
        for one in repo.state.ledger
    )
    repo.state = state_of(repo.config, rebuilt(placed))
    repo.send(reading("x", rivals_at("edge"), node="edge"))
    cloud = repo.config.nodes["cloud"].model_copy(update={"drained": True})
    config = replace(repo.config, nodes={**repo.config.nodes, "cloud": cloud})
    drained = decide(replace(repo.state, config=config), Drain(id="cloud"), NOW, repo.files.get)
    assert isinstance(drained.request, Drain)
    assert [text.split("'")[1] for text in drained.request.moved] == ["b"]
    assert [text.split("'")[1] for text in drained.request.stays] == ["a"]


@pytest.mark.usefixtures("short_digests")
@pytest.mark.parametrize("ends", [False, True])
def test_a_name_that_is_taken_stops_neither_begin_nor_end_of_an_override(ends: bool) -> None:
    moving = {"overrides/move.yaml": override({"applications": ["a", "b"]}, node="cloud")}
    repo, later = (MemoryRepo(moving), None) if ends else (MemoryRepo(), moving)
    repo.send(reading("a", "/p/a", node="edge"))
    repo.send(reading("b", "/q/b", node="edge"))
    here = "edge" if ends else "cloud"
    repo.send(reading("x", rivals_at(here), node=here))
    state = state_of(load(configuration(later)), repo.state.ledger)
    ledger = following_overrides(state).ledger
    assert ledger.application("a") == repo.state.ledger.application("a")
    assert ledger.application("b") != repo.state.ledger.application("b")
    rendered_files(replace(state, ledger=ledger))


def test_no_two_releases_of_one_name_are_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    repo = MemoryRepo()
    for topic in ("/points/a", "/points_a"):
        repo.send(goal([application("edge/a", clouds=[(topic, CLOUD[1])])], id=topic))
    monkeypatch.setattr(naming, "MOST_DIGITS", 0)
    with pytest.raises(Refused) as refused:
        rendered_files(repo.state)
    assert {fault.code for fault in refused.value.faults} == {"conflict"}


# ---- whole digests, with which Kubernetes and ROS 2 accept every name ----


DNS_1123 = re.compile(r"[a-z0-9]([-a-z0-9]*[a-z0-9])?")
ROS_NODE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
LONGEST_NAME = 53

Subject = tuple[str, ...]  # what a name is made from: a prefix, and ids or topics
COUNTS = {"od": (2, 3), "of": (1,), "mqtt": (2,)}  # how many ids are behind a prefix

close = st.text("ab0-_/.A", min_size=1, max_size=5)
hashed = st.builds(
    "{}{}{}".format,
    st.sampled_from(["", "a", "edge", "edge/a"]),
    st.sampled_from(["-", "_", "/", ""]),
    st.text("0123456789abcdef", min_size=12, max_size=12),
)
long = st.builds(
    lambda filler, size, end: filler * (size // len(filler)) + end,
    st.sampled_from(["a", "ab-", "a/", "x_", "ü"]),
    st.sampled_from([54, 300, 1000]),
    st.sampled_from(["", "a", "b", "-", "_a"]),
)
anything = st.text(visible, min_size=1, max_size=12)
ids = st.one_of(close, hashed, long, anything).filter(lambda text: not id_problem(text))
subjects: st.SearchStrategy[Subject] = st.one_of(
    st.tuples(st.just(prefix), *[ids] * count)
    for prefix, counts in COUNTS.items()
    for count in counts
)


def rivals(subject: Subject, name: str) -> Iterator[Subject]:
    """Yield other subjects that would also get ``name`` if names were made in a simpler way."""
    prefix, *ids_ = subject
    rest = name.removeprefix(f"{prefix}-")
    pieces = rest.split("-")
    yield ("of", rest)
    for cut in range(1, len(pieces)):
        yield (prefix, "-".join(pieces[:cut]), "-".join(pieces[cut:]))
    for old, new in (("_", "-"), ("/", "-"), ("-", "_"), ("/", "_")):
        yield (prefix, *(part.replace(old, new) for part in ids_))
        yield (prefix, *(part.replace(old, new) for part in pieces))
    for first in (ids_[0].lower(), ids_[0].upper(), ids_[0][:-1] or "x"):
        yield (prefix, first, *ids_[1:])


@examples(40)
@given(st.lists(subjects, min_size=1, max_size=12))
def test_different_subjects_have_different_names_that_kubernetes_takes(
    drawn: list[Subject],
) -> None:
    found = set(drawn)
    for _ in range(2):  # the second round adds the rivals of rivals
        every = [one for each in found for one in rivals(each, naming.object_name(*each))]
        found |= {one for one in every if len(one) - 1 in COUNTS[one[0]]}
        if len(found) > 150:
            break
    names: dict[str, Subject] = {}
    for subject in sorted(found):
        name = naming.object_name(*subject)
        assert names.setdefault(name, subject) == subject, "two subjects have one name"
        assert DNS_1123.fullmatch(name) and len(name) <= LONGEST_NAME, subject
    ros_names = {naming.ros_name(name) for name in names}
    assert len(ros_names) == len(names)
    assert all(ROS_NODE.fullmatch(name) for name in ros_names)


def test_each_group_of_requesters_has_a_demand_of_its_own() -> None:
    pairs = [*combinations(["a", "a,b", "b", "a b", '["a"]', "a\\", "\\a", '"'], 2)]
    assert len({demand_id("request", pair) for pair in pairs}) == len(pairs)
