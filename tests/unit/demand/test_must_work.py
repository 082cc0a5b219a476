"""Demands that look odd and must work: ids near each other, long, foreign or full of syntax."""

from __future__ import annotations

import re
from itertools import combinations
from typing import Any

import pytest
import yaml

from tests.kit.config import FAST, brokers
from tests.kit.goals import CLOUD, EGO, STATION_CLOUD, application, connection, goal, perception
from tests.kit.memory import MemoryRepo

LABEL = re.compile(r"[a-z0-9]([-a-z0-9]*[a-z0-9])?")
ROS_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")

NEAR = [
    "edge/fusion", "edge_fusion", "edge-fusion", "Edge-Fusion", "edge fusion", "edge--fusion",
    "edge.fusion", "-edge-fusion-", "edge/fusion/", "EDGE_FUSION", "edge-fusión",
    "edge-fusion\u200b",
]  # fmt: skip

SYNTAX = {
    "quotes": """it's "quoted" `so`""",
    "a command substitution": "$(touch /tmp/demandops-was-here)",
    "backticks": "`touch /tmp/demandops-was-here`",
    "a Jinja expression": "{{ 7 * 7 }}",
    "a Jinja statement": "{% for i in range(9) %}x{% endfor %}",
    "a Jinja comment": "{# gone #}",
    "a Helm expression": '{{ .Values.image }}{{ fail "x" }}',
    "a Flux substitution": "${HOME}${undefined}",
    "a YAML mapping": "a: b",
    "a YAML comment": "a #b",
    "a YAML anchor": "&a",
    "a YAML alias": "*a",
    "a YAML tag": "!!python/object/apply:os.system",
    "a YAML list": "- a",
    "a YAML document": "---",
    "flow brackets": "[a, {b: c}]",
    "a backslash": "\\",
    "an escape": "\\n\\u0041\\x41",
    "a percent sign": "%s%n{0}",
    "rich markup": "[red]a[/red]",
    "an emoji code": ":car:",
    "a pipe": "a | b > c",
    "a git option": "--upload-pack=touch",
    "a trailer": "Operation: shutdown",
    "angle brackets": "<script>alert(1)</script>",
    "author crud": ".,:;<>\"\\'",
    "unicode": "véhicule-ü-车辆-🚗",
    "a combining mark": "e\u0301",
    "right to left": "מכונית",
    "an exponent": "1e3",
    "an octal": "0o7",
    "an old octal": "010",
    "a truth": "yes",
    "a null": "null",
    "a tilde": "~",
    "a sexagesimal": "12:30:45",
    "a hexadecimal": "0x1F",
    "a date": "2026-01-31",
    "a merge key": "<<",
    "an equals sign": "=",
    "an infinity": ".inf",
    "a grouped number": "1_000",
    "a slash": "/",
    "a dot": ".",
}


def services(books: MemoryRepo) -> dict[str, Any]:
    found: dict[str, Any] = books.books()["services"]
    return found


def assert_sound(books: MemoryRepo) -> None:
    """Every rendered object has a name that Kubernetes takes, at the path of its name."""
    for path, text in books.rendered().items():
        for document in yaml.load_all(text, Loader=FAST):
            name = document["metadata"]["name"]
            assert LABEL.fullmatch(name), name
            assert len(name) <= 53, name
            assert path.endswith(f"/{name}.yaml")


def test_ids_that_collide_after_slugging_stay_apart() -> None:
    books = MemoryRepo()
    books.send(
        goal(
            [application(id, who=[id]) for id in NEAR],
            [connection(id, who=[id]) for id in NEAR],
        )
    )
    assert_sound(books)
    fusions = {
        entry["applications"][0]: name
        for name, entry in services(books).items()
        if entry["service"] == "object-fusion"
    }
    assert sorted(fusions) == sorted(NEAR)
    assert len(set(fusions.values())) == len(NEAR)
    assert len(books.objects("Deployment")) == 2 * len(NEAR)
    assert sorted(books.books()["connections"]) == sorted(NEAR)


def test_derived_topics_and_clients_of_near_ids_stay_apart() -> None:
    books = MemoryRepo()
    books.send(
        goal(
            [application(id) for id in NEAR],
            [connection(id) for id in NEAR],
        )
    )
    releases = books.objects("HelmRelease").values()
    topics = [
        release["spec"]["values"]["fusion"]["fusedObjectListsTopic"]
        for release in releases
        if "fusion" in release["spec"]["values"]
    ]
    assert len(set(topics)) == len(NEAR)
    assert all(ROS_TOPIC.fullmatch(topic) for topic in topics)
    parameters = [
        yaml.safe_load(config["data"]["params.yaml"])["/**/*"]["ros__parameters"]
        for config in books.objects("ConfigMap").values()
    ]
    assert len({item["client"]["id"] for item in parameters}) == 2 * len(NEAR)
    channels = [
        mqtt["mqtt_topic"]
        for item in parameters
        for mqtt in [item["bridge"].get("ros2mqtt", {}).get(CLOUD[0])]
        if mqtt
    ]
    assert len(set(channels)) == len(NEAR)


def test_one_of_two_near_ids_goes_and_the_other_stays() -> None:
    books = MemoryRepo()
    for id in ("a/b", "a_b"):
        books.send(goal([application(id)], [connection(id)], id=id))
    before = books.rendered()
    books.send(goal([application("a/b")], [connection("a/b")], id="a/b", shutdown=True))
    kept = books.rendered()
    assert [entry["applications"] for entry in services(books).values()] == [["a_b"], ["a_b"]]
    assert list(books.books()["connections"]) == ["a_b"]
    assert all(before[path] == text for path, text in kept.items())


def test_nodes_whose_ids_collide_after_slugging_stay_apart() -> None:
    nodes = ["roof/lidar", "roof_lidar", "roof-lidar"]
    entries = "".join(
        f"  - {{id: {node}, type: station, cluster: c-its, selector: {{node_id: n{index}}}}}\n"
        for index, node in enumerate(nodes)
    )
    head = "apiVersion: demandops/v1\nkind: Nodes\nnodes:\n"
    rest = (
        "  - {id: edge, type: edge, cluster: c-its}\n  - {id: cloud, type: cloud, cluster: c-its}\n"
    )
    books = MemoryRepo({"inventory/nodes.yaml": head + entries + rest})
    books.send(
        goal(
            [application(clouds=[("/points", node) for node in nodes])],
            [connection(f"c{i}", ends=(node, "edge")) for i, node in enumerate(nodes)],
        )
    )
    assert_sound(books)
    detections = [
        entry["source"]
        for entry in services(books).values()
        if entry["service"] == "object-detection"
    ]
    assert sorted(detections) == sorted(nodes)
    folders = {path.split("/")[3] for path in books.rendered() if "source" in path}
    assert len(folders) == len(nodes)


@pytest.mark.parametrize("length", [54, 300, 1024])
def test_long_ids_work_and_stay_apart(length: int) -> None:
    ids = ["x" * length, "x" * (length - 1) + "y"]
    books = MemoryRepo()
    books.send(
        goal(
            [application(id, who=ids) for id in ids],
            [connection(id, who=ids) for id in ids],
            id=ids[0],
        )
    )
    assert_sound(books)
    assert len(books.objects("HelmRelease")) == 3
    assert len(books.objects("Deployment")) == 4
    assert all(len(part) <= 100 for path in books.files for part in path.split("/"))
    down = goal(
        [application(id, who=ids) for id in ids],
        [connection(id, who=ids) for id in ids],
        id=ids[0],
        shutdown=True,
    )
    books.send(down)
    assert books.rendered() == {}


@pytest.mark.parametrize("text", SYNTAX.values(), ids=SYNTAX)
def test_an_id_full_of_syntax_is_inert(text: str) -> None:
    books = MemoryRepo()
    plain = MemoryRepo()
    plain.send(goal([application("id", who=["who"])], [connection("id", who=["who"])], id="r"))
    books.send(goal([application(text, who=[text])], [connection(text, who=[text])], id=text))
    assert_sound(books)
    entry = books.books()["connections"]
    assert list(entry) == [text]
    assert entry[text]["requesters"] == [text]
    deployments = books.objects("Deployment").values()
    assert {item["metadata"]["annotations"]["demandops/connection"] for item in deployments} == {
        text
    }
    for mine, other in zip(
        sorted(deployments, key=_side), sorted(plain.objects("Deployment").values(), key=_side),
        strict=True,
    ):  # fmt: skip
        assert _shape(mine) == _shape(other), "an id changed more than values"


def _side(deployment: dict[str, Any]) -> str:
    return str(deployment["metadata"]["annotations"]["demandops/end"])


def _shape(value: Any) -> Any:
    """Return the structure of a document, without the texts in it."""
    if isinstance(value, dict):
        return {key: _shape(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_shape(item) for item in value]
    return type(value).__name__


def test_no_two_ids_full_of_syntax_share_a_name() -> None:
    books = MemoryRepo()
    texts = list(SYNTAX.values())
    books.send(goal([application(t) for t in texts], [connection(t) for t in texts]))
    fusions = [e for e in services(books).values() if e["service"] == "object-fusion"]
    assert len(fusions) == len(texts)
    assert len(books.objects("Deployment")) == 2 * len(texts)


def test_the_same_demand_twice_changes_nothing() -> None:
    books = MemoryRepo()
    assert books.send(perception()).outcome == "booked"
    before = dict(books.files)
    again = books.send(perception())
    assert (again.outcome, dict(again.files)) == ("unchanged", {})
    assert books.files == before


def test_the_same_demand_in_another_order_is_the_same_demand() -> None:
    books = MemoryRepo()
    who = ["vehicle00", "station00"]
    clouds = [CLOUD, STATION_CLOUD]
    books.send(goal([application(who=who, clouds=clouds)]))
    turned = goal([application(who=[*who[::-1], *who], clouds=[*clouds[::-1], *clouds])])
    assert books.send(turned).outcome == "unchanged"
    turned["shutdown"] = True
    books.send(turned)
    assert services(books) == {}


def test_a_second_point_cloud_of_one_source_runs_beside_the_first() -> None:
    books = MemoryRepo()
    rear = ("/vehicles/vehicle00/drivers/rear/pointcloud", "vehicle00")
    books.send(goal([application(clouds=[CLOUD])], id="1"))
    first = books.rendered()
    books.send(goal([application(clouds=[rear])], id="2"))
    detections = {
        entry["source_topic"]: name
        for name, entry in services(books).items()
        if entry["service"] == "object-detection"
    }
    assert detections.keys() == {CLOUD[0], rear[0]}
    assert detections[CLOUD[0]] == "od-edge-vehicle00"
    assert all(books.rendered()[path] == text for path, text in first.items() if "/od-" in path)
    outputs = {
        release["spec"]["values"]["detection"]["objectListTopic"]
        for release in books.objects("HelmRelease").values()
        if "detection" in release["spec"]["values"]
    }
    assert len(outputs) == 2
    (fusion,) = (entry for entry in services(books).values() if entry["service"] == "object-fusion")
    assert set(fusion["inputs"]["object_list"]) == outputs


def test_names_do_not_depend_on_who_came_first() -> None:
    clouds = [CLOUD, ("/vehicles/vehicle00/drivers/rear/pointcloud", "vehicle00"), STATION_CLOUD]
    demands = [goal([application(clouds=[cloud])], id=cloud[0]) for cloud in clouds]
    ends = []
    for order in (demands, demands[::-1]):
        books = MemoryRepo()
        for demand in order:
            books.send(demand)
        ends.append(books.rendered())
    assert ends[0] == ends[1]


def test_two_clouds_of_one_topic_name_from_two_sources_stay_apart() -> None:
    books = MemoryRepo()
    clouds = [("/points", "vehicle01"), ("/points", "vehicle02")]
    books.send(goal([application(clouds=clouds)]))
    found = [e for e in services(books).values() if e["service"] == "object-detection"]
    assert sorted(entry["source"] for entry in found) == ["vehicle01", "vehicle02"]


class TestOpenBroker:
    """The requested one, one on the target node, one on the source node, the only one."""

    @staticmethod
    def hosts(books: MemoryRepo) -> set[str]:
        return {
            yaml.safe_load(config["data"]["params.yaml"])["/**/*"]["ros__parameters"]["broker"][
                "host"
            ]
            for config in books.objects("ConfigMap").values()
        }

    @pytest.mark.parametrize(
        ("there", "requested", "ends", "chosen"),
        [
            (("cloud", "edge", "vehicle00"), "cloud", ("vehicle00", "edge"), "cloud"),
            (("edge",), "edge", ("vehicle00", "cloud"), "edge"),
            (("cloud", "edge", "vehicle00"), "", ("vehicle00", "edge"), "edge"),
            (("cloud", "vehicle00"), "", ("vehicle00", "edge"), "vehicle00"),
            (("cloud",), "", ("vehicle00", "edge"), "cloud"),
        ],
        ids=["the requested", "the requested, which is the only one", "the target's",
             "the source's", "the only one"],
    )  # fmt: skip
    def test_the_broker_is_chosen_by_rule(
        self, there: tuple[str, ...], requested: str, ends: tuple[str, str], chosen: str
    ) -> None:
        books = MemoryRepo(brokers(*there))
        books.send(goal([], [connection(broker=requested, ends=ends)]))
        assert self.hosts(books) == {f"broker-{chosen}"}

    def test_a_request_that_names_the_only_brokers_neighbour_is_refused(self) -> None:
        """With one broker the reference ignores which one is requested."""
        books = MemoryRepo(brokers("cloud"))
        assert len(books.faults(goal([], [connection(broker="edge")]))) == 1

    def test_a_broker_left_open_and_one_named_for_one_connection_agree(self) -> None:
        books = MemoryRepo()
        books.send(goal([], [connection(broker="")], id="1"))
        assert books.send(goal([], [connection(broker="cloud")], id="2")).outcome == "booked"
        assert self.hosts(books) == {"service-mqtt-broker-cloud"}
        books.send(goal([], [connection(broker="cloud")], id="2", shutdown=True))
        assert self.hosts(books) == {"service-mqtt-broker-edge"}


def test_a_connection_whose_topics_are_all_released_is_gone() -> None:
    books = MemoryRepo()
    topics = ["/a", "/b", "/c"]
    books.send(goal([], [connection(topics=topics)]))
    for index, topic in enumerate(topics):
        left = books.books()["connections"]["vehicle00/edge"]["topics"]
        assert left == topics[index:]
        assert len(books.objects("Deployment")) == 2
        books.send(goal([], [connection(topics=[topic])], shutdown=True))
    assert books.books()["connections"] == {}
    assert books.rendered() == {}
    assert not any(path.startswith("ledger/con") and "READ" not in path for path in books.files)


def test_a_connection_is_released_whole_where_no_topic_is_listed() -> None:
    books = MemoryRepo()
    books.send(goal([], [connection(topics=["/a", "/b"])]))
    books.send(goal([], [connection(topics=[])], shutdown=True))
    assert books.rendered() == {}


def test_an_application_is_released_whole_where_no_topic_is_listed() -> None:
    books = MemoryRepo()
    books.send(goal([application(ego=[EGO])]))
    books.send(goal([application(clouds=[])], shutdown=True))
    assert books.rendered() == {}


def test_a_running_connection_takes_further_topics_on() -> None:
    books = MemoryRepo()
    books.send(goal([], [connection(topics=["/a"])], id="1"))
    books.send(goal([], [connection(topics=["/b"], who=["vehicle01"])], id="2"))
    assert books.books()["connections"]["vehicle00/edge"] == {
        "source": "vehicle00",
        "target": "edge",
        "topics": ["/a", "/b"],
        "requesters": ["vehicle00", "vehicle01"],
    }


def test_a_shutdown_of_what_does_not_run_creates_nothing() -> None:
    books = MemoryRepo()
    before = dict(books.files)
    books.faults(perception(shutdown=True))
    assert books.files == before


def test_a_join_repeated_counts_once_and_one_leave_releases_it() -> None:
    for repetitions in (1, 2, 3):
        books = MemoryRepo()
        for _ in range(repetitions):
            books.send(perception())
        books.send(perception(shutdown=True))
        assert books.books() == {"services": {}, "connections": {}}


def test_a_topic_without_its_leading_slash_is_the_same_topic() -> None:
    books = MemoryRepo()
    books.send(goal([application(clouds=[CLOUD])], [connection(topics=[CLOUD[0]])]))
    bare = CLOUD[0].removeprefix("/")
    again = goal([application(clouds=[(bare, "vehicle00")])], [connection(topics=[bare])])
    assert books.send(again).outcome == "unchanged"


def test_absent_fields_take_the_defaults_of_ros() -> None:
    books = MemoryRepo()
    books.send(perception())
    asked = {
        "id": "request",
        "shutdown": True,
        "apps": [
            {
                "header": {"id": "edge/object_detection_fusion"},
                "type": 1,
                "object_detection_fusion_app": {"requester_ids": ["vehicle00"]},
            }
        ],
        "connections": [{"id": "vehicle00/edge", "type": 1, "requester_ids": ["vehicle00"]}],
    }
    assert books.send(asked).outcome == "released"
    assert books.rendered() == {}


def test_every_pair_of_odd_requesters_makes_its_own_demand() -> None:
    texts = ["a", "a,b", "b", "a b", '["a"]', "a\\", "\\a", '"']
    books = MemoryRepo()
    for pair in combinations(texts, 2):
        books.send(goal([application(who=pair)]))
    demands = {claim.demand for claim in books.state.ledger}
    assert len(demands) == len(list(combinations(texts, 2)))


FIELDS = [
    ("id",),
    ("apps", 0, "header", "id"),
    ("apps", 0, "header", "node_id"),
    ("apps", 0, "object_detection_fusion_app", "requester_ids", 0),
    ("apps", 0, "object_detection_fusion_app", "pointcloud_topics", 0, "topic_name"),
    ("apps", 0, "object_detection_fusion_app", "pointcloud_topics", 0, "source_node_id"),
    ("apps", 0, "object_detection_fusion_app", "pointcloud_topics", 0, "type"),
    ("connections", 0, "id"),
    ("connections", 0, "broker_node_id"),
    ("connections", 0, "requester_ids", 0),
    ("connections", 0, "source_node_id"),
    ("connections", 0, "source_topics", 0),
    ("connections", 0, "target_node_id"),
    ("connections", 0, "target_topics", 0),
]
FREE = {"id", "requester_ids", "type"}
EVIL = 'it\'s "so" $(touch /tmp/demandops-was-here) {{ 7 * 7 }} `id` ${HOME}'


@pytest.mark.parametrize("field", FIELDS, ids=lambda field: ".".join(map(str, field)))
@pytest.mark.parametrize("text", [EVIL, f"{EVIL}\n{EVIL}"], ids=["one line", "two lines"])
def test_in_every_field_text_is_inert_or_refused_by_its_name(
    field: tuple[str | int, ...], text: str
) -> None:
    asked: Any = perception()
    inner = asked
    for part in field[:-1]:
        inner = inner[part]
    inner[field[-1]] = text
    books = MemoryRepo()
    names = [part for part in field if isinstance(part, str)]
    if names[-1] in FREE and "\n" not in text:
        assert books.send(asked).outcome == "booked"
        assert_sound(books)
        for content in books.rendered().values():
            assert "7 * 7" not in content or "{{ 7 * 7 }}" in content
            for document in yaml.load_all(content, Loader=FAST):
                texts = [item for item in leaves(document) if "touch" in item]
                assert all(item == text for item in texts if "$" in item), texts
        return
    path = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in field)[1:]
    found = books.faults(asked)
    assert {message.split(": ")[0] for message in found} == {path}


def leaves(value: Any) -> list[str]:
    """Return every text in a document, keys included."""
    if isinstance(value, dict):
        return [text for pair in value.items() for item in pair for text in leaves(item)]
    if isinstance(value, list):
        return [text for item in value for text in leaves(item)]
    return [value] if isinstance(value, str) else []
