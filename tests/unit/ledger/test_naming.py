"""Different ids give different names, and Kubernetes and ROS 2 accept every name."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import combinations
from types import MappingProxyType

from demandops.base import naming
from demandops.base.errors import Refused
from demandops.base.naming import id_problem
from demandops.decide.decision import Decision
from demandops.model.config.inventory import Node
from demandops.model.ledger.claim import demand_id
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.chance import examples, told, visible
from tests.kit.goals import application, connection, goal
from tests.kit.memory import MemoryRepo

DNS_1123 = re.compile(r"[a-z0-9]([-a-z0-9]*[a-z0-9])?")
ROS_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
ROS_NODE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
LONGEST_NAME, LONGEST_TOPIC = 53, 247

Subject = tuple[str, ...]
"""What a name is made from: a prefix, and ids or topics."""

close = st.text("ab0-_/.A", min_size=1, max_size=5)
words = st.sampled_from(
    ["edge", "vehicle00", "vehicle_00", "vehicle/00", "Vehicle00", "a", "a-watcher"]
)
watched = st.sampled_from(["a-watcher", "edge-watcher", "b"])
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
ids = st.one_of(words, watched, close, hashed, long, anything).filter(
    lambda text: not id_problem(text)
)
topics = st.from_regex(r"(/[ab_][a0_]{0,3}){1,3}", fullmatch=True) | st.builds(
    lambda part, count: f"/{part}" * count, st.sampled_from(["a", "b_0", "a_"]), st.integers(50, 60)
)
sides = st.sampled_from(["source", "target"])

subjects: st.SearchStrategy[Subject] = st.one_of(
    st.tuples(st.just("od"), ids, ids),
    st.tuples(st.just("od"), ids, ids, topics),
    st.tuples(st.just("of"), ids),
    st.tuples(st.just("mqtt"), ids, sides),
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


def is_named(prefix: str, *ids: str) -> bool:
    """Return whether the program makes a name from this."""
    counts = {"od": (2, 3), "of": (1,), "mqtt": (2,)}
    return len(ids) in counts[prefix] and (prefix != "mqtt" or ids[1] in ("source", "target"))


def named_apart(found: set[Subject], name_of: Callable[..., str]) -> dict[str, Subject]:
    """Check that all subjects have different names; return the subjects by name."""
    names: dict[str, Subject] = {}
    for subject in sorted(found):
        other = names.setdefault(name_of(*subject), subject)
        assert other == subject, f"{other} and {subject} have one name"
    return names


@examples(40)
@given(st.lists(subjects, min_size=1, max_size=12))
def test_different_subjects_have_different_names_that_kubernetes_takes(
    drawn: list[Subject],
) -> None:
    found = set(drawn)
    for _ in range(2):  # the second round adds the rivals of rivals
        every = [one for each in found for one in rivals(each, naming.object_name(*each))]
        found |= {one for one in every if is_named(*one)}
        if len(found) > 150:
            break
    names = named_apart(found, naming.object_name)
    for name, subject in names.items():
        assert DNS_1123.fullmatch(name), subject
        assert len(name) <= LONGEST_NAME, subject
    ros_names = {naming.ros_name(name) for name in names}
    assert len(ros_names) == len(names)
    assert all(ROS_NODE.fullmatch(name) for name in ros_names)


def test_each_group_of_requesters_has_a_demand_of_its_own() -> None:
    pairs = [*combinations(["a", "a,b", "b", "a b", '["a"]', "a\\", "\\a", '"'], 2)]
    assert len({demand_id("request", pair) for pair in pairs}) == len(pairs)


def as_the_reference(id: str) -> str:
    """Return an id as the reference writes it in topics (application_manager/utils.py)."""
    return id.replace("-", "_").replace("/", "_")


@examples(50)
@given(st.lists(st.one_of(st.tuples(ids), st.tuples(ids, topics)), min_size=1, max_size=12))
def test_derived_topics_are_the_references_or_differ_and_ros_takes_them(
    drawn: list[Subject],
) -> None:
    found = {*drawn, *((naming.topic_part(*subject),) for subject in drawn)}
    taken = {s for s in found if len(s) == 1 and ROS_NODE.fullmatch(as_the_reference(s[0]))}
    taken = {(id,) for (id,) in taken if len(id) <= 120 and re.search("[^-/_]", id)}
    assert all(naming.topic_part(id) == as_the_reference(id) for (id,) in taken)
    named_apart(found - taken, naming.topic_part)
    for subject in found:
        topic = f"/{naming.topic_part(*subject)}_global_trajectories"
        assert ROS_TOPIC.fullmatch(topic), topic
        assert len(topic) <= LONGEST_TOPIC


@examples(30)
@given(
    st.lists(ids, min_size=2, max_size=4, unique=True),
    st.lists(ids, min_size=1, max_size=4, unique=True),
    st.lists(ids, min_size=1, max_size=4, unique=True),
    st.lists(topics, min_size=1, max_size=3, unique=True),
)
def test_whatever_the_ids_each_release_has_a_name_a_file_and_topics_of_its_own(
    nodes: list[str], applications: list[str], connections: list[str], clouds: list[str]
) -> None:
    repo = with_nodes(nodes)
    asked = [(cloud, node) for node in nodes for cloud in [usual_cloud(nodes, node), *clouds]]
    placed = {id_: nodes[place % len(nodes)] for place, id_ in enumerate(applications)}
    apps = [application(id_, node=node, clouds=asked) for id_, node in placed.items()]
    ends = nodes[0], nodes[1]
    links = [
        connection(id_, ends=ends, topics=["/a"], targets=[f"/b{number}"])
        for number, id_ in enumerate(connections)
    ]
    (request,) = told([goal(apps, links)])

    taken = repo.take(request)

    if isinstance(taken, Refused):
        ids_of_topics = {*nodes, *applications}
        assert {fault.code for fault in taken.faults} == {"conflict"}
        assert len({*map(as_the_reference, ids_of_topics)}) < len(ids_of_topics), taken
        return
    places = {*placed.values()}
    brokers = repo.config.brokers.keys()
    derived = {
        (place, *topic)
        for place in places
        for topic in asked
        if topic[1] != place and {topic[1], place} & brokers
    }
    releases = len(places) * len(asked) + len(applications) + 2 * len(connections)
    releases += 2 * len(derived)
    assert len(taken.releases) == len({release.name for release in taken.releases}) == releases
    manifests = [*repo.rendered().values()]
    assert len(manifests) == releases
    names = [name for text in manifests for name in re.findall(r"nodeName: (\S+)", text)]
    assert len({*names}) == len(names), "a service and a watcher have one name"
    lowered = [path.lower() for path in taken.files]
    assert len(set(lowered)) == len(lowered), "a file system that ignores case would confuse them"
    assert all(len(part) <= 100 for path in taken.files for part in path.split("/"))
    for node in map(quoted, places):
        texts = [text for text in manifests if f"demandops/node: {node}" in text]
        produced = re.findall(r"(?:objectList|fusedObjectLists)Topic: (\S+)", "".join(texts))
        assert len(set(produced)) == len(produced)
        assert all(ROS_TOPIC.fullmatch(topic) for topic in produced)
    shutdown = repo.take({**request, "shutdown": True})
    assert isinstance(shutdown, Decision), shutdown
    assert repo.files == with_nodes(nodes).files


def usual_cloud(nodes: list[str], node: str) -> str:
    return f"/usual/cloud{nodes.index(node)}"


def with_nodes(nodes: list[str]) -> MemoryRepo:
    """Return a new repo with further nodes that have these ids, even invalid ones."""
    repo = MemoryRepo()
    config = repo.state.config
    (domain,) = config.domains.values()
    more = {
        id_: Node(
            id=id_,
            type="vehicle",
            cluster="c-its",
            selector={"any": "label"},
            topics={"point_cloud": usual_cloud(nodes, id_)},
        )
        for id_ in nodes
    }
    config = replace(
        config,
        nodes=MappingProxyType({**config.nodes, **more}),
        domain_of=MappingProxyType({**config.domain_of, **dict.fromkeys(more, domain)}),
    )
    repo.state = replace(repo.state, config=config)
    return repo


def quoted(text: str) -> str:
    """Return a text in quotes, in the way in which the templates quote it."""
    return json.dumps(text, ensure_ascii=False)
