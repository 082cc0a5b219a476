"""Bad input through ``demandops request``: what goes wrong in the reference, and attacks in YAML.

Each defect of the reference has a test named after what must happen instead, on a real bare state
repo. Whatever is refused leaves no commit and nothing in the outbox, and the next demand works.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.cli.repo.schema import SCHEMAS
from demandops.cluster.access import AccessFile

from tests.kit.config import FAST, brokers
from tests.kit.goals import (
    BODY,
    CLOUD,
    EGO,
    STATION_CLOUD,
    application,
    connection,
    goal,
    perception,
)
from tests.kit.mutations import Form, mutations
from tests.kit.repo import git
from tests.kit.rich import CONFIG_MODELS, GOAL_MODELS, own_goal, reference_goal

EXPERIMENT = Path(__file__).parents[2] / "examples" / "experiment"

Send = Callable[..., Any]


@pytest.fixture(autouse=True)
def _nothing_is_left_behind(data_home: Path) -> Iterator[None]:
    yield
    for journal in data_home.rglob("outbox.jsonl"):
        lines = [yaml.safe_load(line) for line in journal.read_text().splitlines()]
        done = {line["done"] for line in lines if "done" in line}
        assert not [line for line in lines if "done" not in line and line["operation"] not in done]


def one(ran: Any) -> dict[str, Any]:
    """Return the one answer of a command."""
    (row,) = ran.json()
    assert row.keys() == {
        "index",
        "request",
        "outcome",
        "commit",
        "faults",
        "warnings",
        "not_held",
    }
    found: dict[str, Any] = row
    return found


def refused(ran: Any) -> list[tuple[str, str]]:
    """Return the faults of a refused request."""
    row = one(ran)
    assert (ran.code, row["outcome"], row["commit"]) == (1, "refused", None)
    return [(error["field"], error["message"]) for error in row["faults"]]


def booked(ran: Any) -> str:
    """Return the commit of a booked request."""
    row = one(ran)
    assert (ran.code, row["outcome"], row["faults"]) == (0, "booked", [])
    return str(row["commit"])


@pytest.fixture
def bookkeeping(demandops: Send, state: Any) -> Callable[[], dict[str, Any]]:
    def read() -> dict[str, Any]:
        found: dict[str, Any] = demandops(
            "bookkeeping", "--state-repo", state.path, "--output", "json"
        ).json()
        return found

    return read


class TestDefectsOfTheReference:
    """Facts §5, by number."""

    def test_01_a_goal_that_cannot_be_honoured_fails(self, demandops: Send, state: Any) -> None:
        """Here the remote rejects every push: no success that hides it in a text."""
        hook = state.path / "hooks" / "pre-receive"
        hook.parent.mkdir(exist_ok=True)
        hook.write_text("#!/bin/sh\necho 'closed for today' >&2\nexit 1\n")
        hook.chmod(0o755)
        before, url = state.tip, f"file://{state.path}"
        given = yaml.safe_dump(perception())
        ran = demandops("request", "-", "--state-repo", url, "--output", "json", stdin=given)
        ((field, message),) = refused(ran)
        assert (field, state.tip) == ("", before)
        assert message.startswith(f"{url} rejects the push: ")

    def test_02_several_brokers_and_none_that_matches_is_a_message(
        self, request_json: Send, state: Any
    ) -> None:
        before = state.tip
        asked = goal([], [connection(broker="", ends=("vehicle00", "vehicle01"))])
        assert refused(request_json(asked)) == [
            (
                "connections[0].broker_node_id",
                "is not given, and no broker runs on 'vehicle01' or 'vehicle00'; name one of: "
                "cloud, "
                "edge",
            )
        ]
        assert state.tip == before

    def test_02_the_requested_broker_is_not_ignored_where_there_is_one(
        self, request_json: Send, state: Any
    ) -> None:
        state.commit(brokers("cloud"))
        assert refused(request_json(goal([], [connection(broker="edge")]))) == [
            (
                "connections[0].broker_node_id",
                "no broker runs on 'edge'; name one of: cloud",
            )
        ]

    @pytest.mark.parametrize(
        ("asked", "field"),
        [
            (goal([], [connection(type=0, broker="")]), "connections[0].type"),
            (goal([], [connection(type=2, broker="")]), "connections[0].type"),
            (goal([], [connection(type=7)]), "connections[0].type"),
            (goal([application(type=7)]), "apps[0].type"),
        ],
        ids=["ROS", "Zenoh", "an unknown connection", "an unknown application"],
    )
    def test_03_a_type_that_is_not_carried_out_is_refused(
        self, request_json: Send, state: Any, asked: dict[str, Any], field: str
    ) -> None:
        before = state.tip
        assert field in [place for place, _ in refused(request_json(asked))]
        assert state.tip == before
        booked(request_json(perception()))

    def test_03_one_unknown_application_keeps_its_neighbours_from_being_booked(
        self, request_json: Send, state: Any
    ) -> None:
        before = state.tip
        faults = refused(request_json(goal([application(), application("b", type=7)])))
        assert [field for field, _ in faults] == ["apps[1].type"]
        assert state.tip == before

    def test_04_the_content_of_a_request_is_checked(self, request_json: Send) -> None:
        asked = goal([application("..", who=[], node="egde")], [connection(topics=["/a b"])])
        assert sorted(field for field, _ in refused(request_json(asked))) == [
            "apps[0].header.id",
            "apps[0].header.node_id",
            f"{BODY}.requester_ids",
            "connections[0].source_topics[0]",
            "connections[0].target_topics[0]",
        ]

    def test_05_a_shutdown_of_what_does_not_run_creates_nothing(
        self, request_json: Send, state: Any
    ) -> None:
        before = state.tip
        assert refused(request_json(perception(shutdown=True))) == [
            (
                "apps[0].header.id",
                "nothing that the shutdown lists is held; similar claims: none",
            )
        ]
        assert state.tip == before

    def test_06_ids_that_look_alike_get_names_of_their_own(
        self, request_json: Send, state: Any, bookkeeping: Send
    ) -> None:
        ids = ["vehicle_00/x", "vehicle/00/x", "vehicle-00-x", "Vehicle_00/X", "vehicle00" * 40]
        for id in ids:
            booked(request_json(goal([application(id)], [connection(id)], id=id)))
        books = bookkeeping()
        assert sorted(books["connections"]) == sorted(ids)
        fusions = [e for e in books["services"].values() if e["service"] == "object-fusion"]
        assert sorted(entry["applications"][0] for entry in fusions) == sorted(ids)
        for path in state.manifests():
            assert len(path.rsplit("/", 1)[1]) <= 53 + len(".yaml")

    def test_07_a_second_point_cloud_of_a_node_does_not_replace_the_first(
        self, request_json: Send, bookkeeping: Send
    ) -> None:
        rear = ("/vehicles/vehicle00/drivers/rear/pointcloud", "vehicle00")
        booked(request_json(goal([application(clouds=[CLOUD, rear])])))
        found = [
            entry["source_topic"]
            for entry in bookkeeping()["services"].values()
            if entry["service"] == "object-detection"
        ]
        assert sorted(found) == sorted([CLOUD[0], rear[0]])

    def test_08_text_of_a_demand_reaches_no_shell(
        self, request_json: Send, state: Any, tmp_path: Path
    ) -> None:
        trace = tmp_path / "trace"
        evil = f"$(touch {trace});`id`'\"{{{{ 7*7 }}}}"
        booked(request_json(goal([application(evil, who=[evil])], [connection(evil)], id=evil)))
        for text in state.manifests().values():
            for document in yaml.load_all(text, Loader=FAST):
                for container in containers(document):
                    words = [*container.get("command", ()), *container.get("args", ())]
                    assert "-c" not in words
                    assert not [word for word in words if set(word) & set("$`;'\"{}()*")]
        assert not trace.exists()

    def test_09_a_topic_arrives_under_its_other_name(self, request_json: Send, state: Any) -> None:
        topics, targets = ["/b/points", "/a/points"], ["/x", "/y"]
        booked(request_json(goal([], [connection(topics=topics, targets=targets)])))
        by_mqtt: dict[str, dict[str, str]] = {"ros2mqtt": {}, "mqtt2ros": {}}
        for parameters in mqtt_parameters(state).values():
            for way, bridge in parameters["bridge"].items():
                for name, entry in bridge.items():
                    if way == "ros2mqtt" and name != "ros_topics":
                        by_mqtt[way][entry["mqtt_topic"]] = name
                    elif way == "mqtt2ros" and name != "mqtt_topics":
                        by_mqtt[way][name] = entry["ros_topic"]
        carried = {
            source: by_mqtt["mqtt2ros"][mqtt] for mqtt, source in by_mqtt["ros2mqtt"].items()
        }
        assert carried == dict(zip(topics, targets, strict=True))

    def test_10_no_client_is_rendered_without_a_topic(self, request_json: Send, state: Any) -> None:
        topics = ["/a", "/b"]
        booked(request_json(goal([], [connection(topics=topics)], id="1")))
        booked(request_json(goal([], [connection("second", topics=topics)], id="2")))
        assert len(mqtt_parameters(state)) == 4
        for parameters in mqtt_parameters(state).values():
            for bridge in parameters["bridge"].values():
                assert bridge.get("ros_topics") or bridge.get("mqtt_topics")
        request_json(goal([], [connection(topics=topics)], id="1", shutdown=True))
        assert len(mqtt_parameters(state)) == 2

    def test_11_a_running_connection_takes_new_topics(
        self, request_json: Send, state: Any, bookkeeping: Send
    ) -> None:
        booked(request_json(goal([], [connection(topics=["/a"])], id="1")))
        booked(request_json(goal([], [connection(topics=["/b"])], id="2")))
        assert bookkeeping()["connections"]["vehicle00/edge"]["topics"] == ["/a", "/b"]
        (source,) = (p for p in mqtt_parameters(state).values() if "ros2mqtt" in p["bridge"])
        assert source["bridge"]["ros2mqtt"]["ros_topics"] == ["/a", "/b"]

    def test_11_a_running_service_takes_a_new_image(
        self, request_json: Send, state: Any, demandops: Send
    ) -> None:
        booked(request_json(perception()))
        path = "registry/images.yaml"
        state.commit({path: state.files()[path].replace("tag: 2025-04", "tag: 2026-01")})
        row = one(request_json(perception()))
        assert row["outcome"] == "unchanged"
        (detection,) = (t for p, t in state.manifests().items() if "/od-" in p)
        assert yaml.safe_load(detection)["spec"]["values"]["image"]["tag"] == "2026-01"
        assert demandops("verify", "--state-repo", state.path).code == 0

    def test_12_an_unknown_requester_on_shutdown_changes_nothing(
        self, request_json: Send, state: Any, bookkeeping: Send
    ) -> None:
        booked(request_json(perception()))
        before, books = state.tip, bookkeeping()
        asked = goal([application(who=["vehicle00"])], [connection(who=["nobody"])], shutdown=True)
        row = one(request_json(asked))
        assert (row["outcome"], row["not_held"]) == (
            "released",
            ["connection 'vehicle00/edge' for nobody"],
        )
        refused(request_json(goal([], [connection(who=["nobody"])], shutdown=True)))
        assert bookkeeping()["connections"] == books["connections"]
        assert len(state.commits()) == 3
        assert state.tip != before

    def test_13_a_request_sent_again_counts_once(
        self, request_json: Send, state: Any, bookkeeping: Send
    ) -> None:
        commit = booked(request_json(perception()))
        for _ in range(2):
            ran = request_json(perception())
            assert (ran.code, one(ran)["outcome"], one(ran)["commit"]) == (0, "unchanged", commit)
        assert len(state.commits()) == 2
        assert one(request_json(perception(shutdown=True)))["outcome"] == "released"
        books = bookkeeping()
        assert (books["services"], books["connections"]) == ({}, {})

    def test_14_requests_that_arrive_together_are_all_booked(
        self, request_json: Send, state: Any, bookkeeping: Send
    ) -> None:
        goals = [goal([], [connection(f"c{i}")], id=f"r{i}") for i in range(20)]
        rows = request_json(*goals).json()
        assert [row["outcome"] for row in rows] == ["booked"] * 20
        assert len({row["commit"] for row in rows}) == 20
        assert len(state.commits()) == 21
        assert len(bookkeeping()["connections"]) == 20

    def test_15_a_broken_book_is_told_and_not_taken_for_an_empty_one(
        self, request_json: Send, state: Any, demandops: Send
    ) -> None:
        booked(request_json(perception()))
        (path, *_) = sorted(p for p in state.files("ledger/") if p.endswith(".yaml"))
        state.commit({path: state.files()[path][:60]})
        ran = demandops("bookkeeping", "--state-repo", state.path, "--output", "json")
        assert ran.code == 1
        assert {each["file"] for each in ran.json()["faults"]} == {path}
        assert ran.err.startswith(f"error: {path}: ")
        booked(request_json(perception(id="another")))
        assert path in state.files("ledger/")

    def test_16_scaling_and_access_domains_are_in_the_code(
        self, request_json: Send, state: Any
    ) -> None:
        """What the paper describes; ``tests/appdefs`` shows scaling, this one access domains."""
        text = "apiVersion: demandops/v1\nkind: AccessDomains\ndomains:\n  - name: fleet\n"
        nodes = '    namespace: fleet\n    serviceAccount: fleet\n    nodes: ["vehicle*"]\n'
        state.commit({"policy/access-domains.yaml": text + nodes})
        assert refused(request_json(perception())) == [
            (
                field,
                "'edge' is not in any access domain; a platform engineer adds it to "
                "policy/access-domains.yaml",
            )
            for field in ("apps[0].header.node_id", "connections[0].target_node_id")
        ]

    def test_17_an_input_that_no_connection_carries_is_a_warning(self, request_json: Send) -> None:
        asked = yaml.safe_load((EXPERIMENT / "1-vehicle00-joins.yaml").read_text())
        for connection_ in asked["connections"]:
            if connection_["id"] == "station00/edge":
                connection_["target_topics"] = list(connection_["source_topics"])
        row = one(request_json(asked))
        assert row["outcome"] == "booked"
        assert row["warnings"] == [
            "application 'edge/object_detection_fusion': no connection carries point_cloud "
            "/stations/station00/pointcloud of 'station00' to 'edge'"
        ]

    def test_17_the_experiment_as_shipped_has_no_warning(self, request_json: Send) -> None:
        asked = yaml.safe_load((EXPERIMENT / "1-vehicle00-joins.yaml").read_text())
        assert one(request_json(asked))["warnings"] == []


def containers(document: dict[str, Any]) -> list[dict[str, Any]]:
    if document["kind"] != "Deployment":
        return []
    found: list[dict[str, Any]] = document["spec"]["template"]["spec"]["containers"]
    return found


def mqtt_parameters(state: Any) -> dict[str, dict[str, Any]]:
    """Return the parameters of every MQTT client by the path of its file."""
    found = {}
    for path, text in state.manifests().items():
        for document in yaml.load_all(text, Loader=FAST):
            if document["kind"] == "ConfigMap" and "params.yaml" in document["data"]:
                parameters = yaml.safe_load(document["data"]["params.yaml"])
                found[path] = parameters["/**/*"]["ros__parameters"]
    return found


DETECTION = "appdefs/object-detection-fusion/charts/object-detection"


class TestWhatPeopleBreak:
    """An invalid file keeps its last valid version in force and is reported; demands go on."""

    @pytest.mark.parametrize(
        ("path", "text"),
        [
            ("inventory/nodes.yaml", "nodes: ["),
            ("registry/images.yaml", "apiVersion: demandops/v1\nkind: Images\nimages: {}\n"),
            ("appdefs/object-detection-fusion/appdef.yaml", "kind: ApplicationDefinition\n"),
            ("appdefs/object-detection-fusion/values/object-detection.yaml.j2", "{% if %}"),
            ("appdefs/object-detection-fusion/values/object-detection.yaml.j2", "replicas: many"),
            (f"{DETECTION}/values.schema.json", "{"),
            (f"{DETECTION}/values.schema.json", '{"type": 5}'),
            (f"{DETECTION}/values.yaml", "a: ["),
        ],
        ids=["a node list", "images", "an appdef", "a template", "values", "no JSON", "no schema",
             "defaults"],
    )  # fmt: skip
    def test_the_last_valid_version_stays_in_force(
        self,
        request_json: Send,
        state: Any,
        caplog: pytest.LogCaptureFixture,
        path: str,
        text: str,
    ) -> None:
        state.commit({path: text})
        booked(request_json(perception()))
        assert any("/od-" in manifest for manifest in state.manifests())
        assert state.files()[path] == text, "what people wrote is not touched"
        assert path in caplog.text


class TestRefusals:
    """No commit, nothing lost, the next demand works."""

    @pytest.mark.parametrize(
        ("valid", "model"), list(zip((reference_goal, own_goal), GOAL_MODELS, strict=True))
    )
    def test_a_mistake_anywhere_in_a_goal_changes_nothing(
        self, request_json: Send, state: Any, data_home: Path, valid: Any, model: Any
    ) -> None:
        """A sample; ``tests/unit/demand/test_mistakes_in_goals.py`` tries every mistake."""
        form, before = Form(model.model_json_schema()), state.tip
        wrong = [m for m in mutations(valid()) if form.forbids(m.document)]
        for mutation in wrong[:: len(wrong) // 10]:
            fields = [field for field, _ in refused(request_json(mutation.document))]
            assert any(map(mutation.is_at, fields)), (mutation.place, mutation.kind, fields)
            assert state.tip == before
        booked(request_json(perception()))
        assert list(data_home.rglob("outbox.jsonl")), "the journal, which the fixture reads"

    def test_the_schemas_of_files_and_goals_are_the_tried_ones(self) -> None:
        shown = {model for model, _ in SCHEMAS.values()} - {AccessFile}
        assert shown == {*CONFIG_MODELS.values(), *GOAL_MODELS}

    def test_two_contradicting_requests_of_one_call_are_judged_in_order(
        self, request_json: Send, state: Any
    ) -> None:
        other = goal([application(node="cloud", who=["vehicle01"])], id="other")
        ran = request_json(perception(), other)
        assert [row["outcome"] for row in ran.json()] == ["booked", "refused"]
        assert len(state.commits()) == 2

    @pytest.mark.parametrize("who", ["\\", "\\\\", ".", "<>", '"', "'", "#", "-"])
    def test_a_requester_with_an_odd_name_can_be_the_author_of_a_commit(
        self, request_json: Send, state: Any, bookkeeping: Send, who: str
    ) -> None:
        booked(request_json(goal([], [connection(who=[who])])))
        assert bookkeeping()["connections"]["vehicle00/edge"]["requesters"] == [who]
        assert f"\nRequester: {who}\n" in state.commits()[0]

    def test_no_id_forges_a_trailer(self, request_json: Send, state: Any, demandops: Send) -> None:
        forged = "x Operation: shutdown Requester: somebody"
        booked(request_json(goal([application(forged, who=[forged])], id=forged)))
        (entry, _) = demandops("log", "--state-repo", state.path, "--output", "json").json()
        assert (entry["operation"], entry["requesters"], entry["request"]) == (
            "join",
            [forged],
            forged,
        )

    def test_long_foreign_and_full_names_go_in_and_out_again(
        self, request_json: Send, state: Any, bookkeeping: Send, demandops: Send
    ) -> None:
        ids = ["é" * 300, "车辆/🚗", "a\"b'c`$(d){{ e }}", "yes", "1e3", "~", "x" * 1024]
        apps = [application(id, who=[id], clouds=[CLOUD, STATION_CLOUD], ego=[EGO]) for id in ids]
        connections = [connection(id, who=[id]) for id in ids]
        for id in ids:
            booked(request_json(goal([application(id, who=[id])], [connection(id)], id=id)))
        booked(request_json(goal(apps, connections)))
        assert sorted(bookkeeping()["connections"]) == sorted(ids)
        assert demandops("verify", "main~3..main", "--state-repo", state.path).code == 0
        for id in ids:
            down = goal([application(id, who=[id])], [connection(id)], id=id, shutdown=True)
            assert one(request_json(down))["outcome"] == "released"
        assert one(request_json(goal(apps, connections, shutdown=True)))["outcome"] == "released"
        books = bookkeeping()
        assert (books["services"], books["connections"]) == ({}, {})
        left = [path for path in state.files("ledger/") if path.endswith(".yaml")]
        assert left == []
        git(state, "fsck", "--strict", "--full")


# the file, and how the message starts: the words of libyaml and pydantic are left out
ATTACKS: dict[str, tuple[str | bytes, str]] = {
    "empty": ("", "error: no request in {file}\n"),
    "only a comment": ("# nothing\n", "error: no request in {file}\n"),
    "empty documents": ("---\n---\n...\n", "error: no request in {file}\n"),
    "a list": (
        "- id: a\n",
        "{file}: request 0 '' refused\n"
        "  a request is a mapping with id, apps, connections and shutdown\n",
    ),
    "a text": (
        "hello\n",
        "{file}: request 0 '' refused\n"
        "  a request is a mapping with id, apps, connections and shutdown\n",
    ),
    "a key twice": (
        "id: a\napps: []\nid: b\n",
        "error: {file}: line 3, column 1: not valid YAML: the key 'id' appears twice\n",
    ),
    "a key twice, deep down": (
        "apps:\n- header:\n    id: a\n    id: b\n",
        "error: {file}: line 4, column 5: not valid YAML: the key 'id' appears twice\n",
    ),
    "an anchor": (
        "id: &a x\n",
        "error: {file}: line 1: anchors and aliases (& and *) are not allowed; write the value "
        "out\n",
    ),
    "an alias of itself": (
        "id: x\napps: &a [*a]\n",
        "error: {file}: line 2: anchors and aliases (& and *) are not allowed; write the value "
        "out\n",
    ),
    "a billion laughs": (
        "a: &a [x, x]\n"
        + "".join(
            f"{b}: &{b} [*{a}, *{a}]\n"
            for a, b in zip("abcdefghijklmnopqrstuvwxy", "bcdefghijklmnopqrstuvwxyz", strict=True)
        ),
        "error: {file}: line 1: anchors and aliases (& and *) are not allowed; write the value "
        "out\n",
    ),
    "binary": (bytes(range(256)), "error: {file}: is not UTF-8 text\n"),
    "UTF-16": ("id: a\n".encode("utf-16"), "error: {file}: is not UTF-8 text\n"),
    "a picture": (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "error: {file}: is not UTF-8 text\n"),
    "a tab": (
        "id: a\n\tapps: []\n",
        "error: {file}: line 2, column 1: not valid YAML: ",
    ),
    "an open quote": (
        'id: "a\n',
        "error: {file}: line 2, column 1: not valid YAML: ",
    ),
    "an open bracket": (
        "apps: [\n",
        "error: {file}: line 2, column 1: not valid YAML: ",
    ),
    "a tag of Python": (
        'id: !!python/object/apply:os.system ["touch {trace}"]\n',
        "error: {file}: line 1, column 5: not valid YAML: ",
    ),
    "half of a character": (
        'id: "\\ud800"\n',
        "error: {file}: line 1, column 8: not valid YAML: ",
    ),
    "a list for a key": (
        "? [a, b]\n: c\n",
        "error: {file}: line 1, column 3: not valid YAML: the key ['a', 'b'] must be text; put it "
        "in quotes\n",
    ),
    "a number that YAML 1.1 reads into a time": (
        "id: 12:30:45\n",
        "{file}: request 0 '' refused\n  id: must be text, not 45045; put it in quotes\n",
    ),
    "a number beyond a byte": (
        "connections: [{id: c, type: " + "9" * 4000 + "}]\n",
        "{file}: request 0 '' refused\n  connections[0].type: ",
    ),
    "an infinite number": (
        "connections: [{id: c, type: .inf}]\n",
        "{file}: request 0 '' refused\n  connections[0].type: must be a whole number, not inf\n",
    ),
}


class TestYamlAttacks:
    """A clear message with the file and the place, exit code 1, nothing booked, no traceback."""

    @pytest.mark.parametrize("name", ATTACKS)
    def test_a_file_is_refused_with_its_name_and_the_place(
        self, demandops: Send, state: Any, tmp_path: Path, name: str
    ) -> None:
        content, expected = ATTACKS[name]
        file = tmp_path / "request.yaml"
        if isinstance(content, str):
            content = content.replace("{trace}", str(tmp_path / "trace")).encode()
        file.write_bytes(content)
        before = state.tip
        ran = demandops("request", file, "--state-repo", state.path)
        assert (ran.code, ran.out) == (1, "")
        assert ran.err.startswith(expected.format(file=file))
        assert state.tip == before
        assert not (tmp_path / "trace").exists()

    def test_whatever_stands_in_a_file_ends_in_a_message(
        self, demandops: Send, state: Any, tmp_path: Path
    ) -> None:
        contents = [
            "~: x\n",
            "5: x\n",
            "true: x\n",
            "1.5: x\n",
            "apps: [{header: {~: x}}]\n",
            "connections: [{id: c, type: 0x" + "f" * 5000 + "}]\n",
            "id: 0x" + "f" * 5000 + "\n",
            "id: " + "9" * 5000 + "\n",
            "id: 0b" + "1" * 20000 + "\n",
            "id: !!binary aGVsbG8=\n",
            "id: !!binary '='\n",
            "id: !!int x\n",
            "id: !!float x\n",
            "id: !!bool x\n",
            "id: !!timestamp x\n",
            "apps: !!set {a, b}\n",
            "apps: !!omap [a: b]\n",
            "apps: !!pairs [a: b]\n",
            "id: !<tag:yaml.org,2002:str> [x]\n",
            "!!map [a]\n",
            "<<: {id: x}\n",
            "<<: 5\n",
            "id: =\n",
            "id: 1:99999999999999999999:1\n",
            "id: 2026-99-99\n",
            "id: -.inf\n",
            "id: .nan\n",
            "%YAML 9.9\n---\nid: a\n",
            "%TAG ! !foo\n---\nid: a\n",
            "apps: " + "[" * 900 + "]" * 900 + "\n",
            "apps: " + "{a: " * 900 + "}" * 900 + "\n",
            "".join(" " * depth + "a:\n" for depth in range(1500)),
            "- " * 1500 + "a\n",
            "a\0b\n",
            "\ufeffid: 5\n",
            "id: a\u2028: b\n",
            "a" * 100_000,
            "? " * 500,
            "\n" * 10_000 + "&a b",
        ]
        file = tmp_path / "request.yaml"
        before = state.tip
        for content in contents:
            file.write_text(content)
            start = time.monotonic()
            ran = demandops("request", file, "--state-repo", state.path)
            taken_s, shown = time.monotonic() - start, repr(content[:24])
            assert (ran.code, ran.out) == (1, ""), (shown, ran.err)
            assert str(file) in ran.err, shown
            assert "fault of" not in ran.err, f"{shown} is the user's to fix"
            assert len(ran.err) < 5000, f"{shown}: a message that nobody reads"
            assert state.tip == before, shown
            assert taken_s < 5, shown

    @pytest.mark.parametrize("bracket", ["[]", "{}"])
    def test_brackets_without_end_crash_nothing(
        self, state: Any, tmp_path: Path, data_home: Path, bracket: str
    ) -> None:
        """In a process of its own, for a parser may overrun the stack and end the process."""
        file = tmp_path / "request.yaml"
        opening = bracket[0] if bracket == "[]" else "{a: "
        file.write_text("apps: " + opening * 40_000 + bracket[1] * 40_000)
        command = [sys.executable, "-m", "demandops.cli.main", "request", str(file)]
        ran = subprocess.run(
            [*command, "--state-repo", str(state.path)],
            capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip
        assert ran.returncode == 1, f"exit code {ran.returncode}: {ran.stderr}"
        assert ran.stderr.startswith(f"error: {file}: ")
        assert "nested" in ran.stderr

    def test_a_request_with_the_traps_of_yaml_in_quotes_is_taken_as_text(
        self, demandops: Send, state: Any, tmp_path: Path, bookkeeping: Send
    ) -> None:
        texts = ["yes", "null", "~", "1e3", "0o7", "010", "12:30:45", "2026-01-31", "0x1F", "<<"]
        items = [
            f'- {{id: "{text}", type: 1, requester_ids: ["{text}"], source_node_id: vehicle00, '
            "target_node_id: edge, source_topics: [/a], target_topics: [/a]}"
            for text in texts
        ]
        file = tmp_path / "request.yaml"
        file.write_text("id: x\nconnections:\n" + "\n".join(items))
        ran = demandops("request", file, "--state-repo", state.path, "--output", "json")
        booked(ran)
        connections = bookkeeping()["connections"]
        assert {id: entry["requesters"] for id, entry in connections.items()} == {
            text: [text] for text in texts
        }

    def test_a_date_without_quotes_is_text(
        self, demandops: Send, state: Any, bookkeeping: Send
    ) -> None:
        text = yaml.safe_dump(goal([], [connection("DATE")])).replace("DATE", "2026-01-31")
        ran = demandops("request", "-", "--state-repo", state.path, "--output", "json", stdin=text)
        booked(ran)
        assert list(bookkeeping()["connections"]) == ["2026-01-31"]

    def test_a_missing_file_is_named(self, demandops: Send, state: Any, tmp_path: Path) -> None:
        ran = demandops("request", tmp_path / "none.yaml", "--state-repo", state.path)
        assert (ran.code, ran.out) == (1, "")
        assert (
            ran.err == f"error: {tmp_path}/none.yaml: cannot be read: No such file or directory\n"
        )

    def test_a_folder_for_a_file_is_named(
        self, demandops: Send, state: Any, tmp_path: Path
    ) -> None:
        ran = demandops("request", tmp_path, "--state-repo", state.path)
        assert (ran.code, ran.out) == (1, "")
        assert ran.err == f"error: {tmp_path}: cannot be read: Is a directory\n"

    def test_binary_on_standard_input_is_told(self, state: Any, data_home: Path) -> None:
        command = [sys.executable, "-m", "demandops.cli.main", "request", "-"]
        ran = subprocess.run(
            [*command, "--state-repo", str(state.path)],
            input=bytes(range(256)), capture_output=True, check=False,
        )  # fmt: skip
        assert ran.returncode == 1
        assert ran.stderr.decode() == "error: standard input: is not UTF-8 text\n"

    def test_no_control_character_of_a_file_reaches_the_terminal(
        self, demandops: Send, state: Any, tmp_path: Path
    ) -> None:
        file = tmp_path / "request.yaml"
        file.write_text('"\\e[31mred\\a": 1\nid: "\\e]0;title\\a"\napps: [{"\\b\\b": 1}]\n')
        ran = demandops("request", file, "--state-repo", state.path)
        assert ran.code == 1
        assert ran.err.replace("\n", "").isprintable(), repr(ran.err)
