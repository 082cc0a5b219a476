"""When clients restart, what is never rendered for them, and what their programs declare.

``tests/scenarios/clients-carry-what-is-demanded.yaml`` and ``tests/golden`` have what they carry.
The repo in memory takes no configuration with a field that its schema lacks, so the schemas are
compared with ``declared.yaml``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.base.errors import InvalidInput
from demandops.base.settings import data_folder
from demandops.connections import connection_types
from demandops.connections.connection import ROUTE_OPTIONS, Route
from demandops.connections.connection_types import CONNECTION_TYPES
from demandops.decide.state import State, rendered_files

from tests.kit import plain_yaml
from tests.kit.config import skeleton
from tests.kit.connections import REACHABLE, SPEAKS, TYPED, WAN, demand, routes, state
from tests.kit.goals import connection, goal
from tests.kit.memory import MemoryRepo

CASES = plain_yaml.beside(__file__)
NODES: dict[str, dict[str, Any]] = {"vehicle00": SPEAKS | TYPED, "edge": REACHABLE | WAN}


def booked(*demands: dict[str, Any], before: State | None = None) -> MemoryRepo:
    repo = MemoryRepo(state=before or state(**NODES))
    for one in demands:
        repo.send(routes(one))
    return repo


def configurations(repo: MemoryRepo) -> dict[str, dict[str, Any]]:
    """Return each client's configuration, by the client's name."""
    texts = {name: one["data"].values() for name, one in repo.objects("ConfigMap").items()}
    return {name: yaml.safe_load(text) for name, (text,) in texts.items()}


def pods(repo: MemoryRepo) -> dict[str, dict[str, Any]]:
    return {name: one["spec"]["template"] for name, one in repo.objects("Deployment").items()}


@pytest.mark.parametrize(("kind", "options", "restarted"), CASES["restarted"])
def test_a_further_topic_restarts_who_cannot_read_it_and_a_further_requester_nobody(
    kind: str, options: dict[str, Any], restarted: list[str]
) -> None:
    repo = booked(demand("zenoh", {"/z": "/z"}, id="other", source="edge", target="vehicle00"))
    repo.send(routes(demand(kind)))
    before = pods(repo), configurations(repo)
    repo.send(routes(demand(kind, requesters=["vehicle01"])))
    assert (pods(repo), configurations(repo)) == before
    repo.send(routes(demand(kind, {"/b": options}, requesters=["station00"])))
    assert sorted(n for n, pod in pods(repo).items() if pod != before[0][n]) == restarted
    assert sum(one != before[1][name] for name, one in configurations(repo).items()) == 2


def test_what_is_not_configured_is_left_out_and_an_ipv6_host_becomes_part_of_a_url() -> None:
    brokers = skeleton()["inventory/brokers.yaml"] + "    tls: {}\n"
    brokers = brokers.replace("host: service-mqtt-broker-edge.default.svc", 'host: "2001:db8::1"')
    repo = MemoryRepo({"inventory/brokers.yaml": brokers, "registry/clients.yaml": None})
    repo.send(goal([], [connection()]))
    for name, whole in configurations(repo).items():
        broker = whole["/**/*"]["ros__parameters"]["broker"]
        assert broker == {"host": "[2001:db8::1]", "port": 1993, "tls": {"enabled": True}}
        spec = pods(repo)[name]["spec"]
        assert [volume["name"] for volume in spec["volumes"]] == ["config"], "no CA of its own"
        assert spec["containers"][0]["args"][3] == "standalone.launch.xml", "as the image has it"


@pytest.mark.parametrize("case", CASES["changed in Git"], ids=itemgetter("told"))
def test_what_people_change_in_git_so_that_the_type_cannot_carry_it_is_told(
    case: dict[str, Any],
) -> None:
    repo = booked(demand(case["kind"]))
    (claim,) = repo.state.ledger.connection_claims("c")
    route = Route(**{"source": "/a", "target": "/a"} | case.get("route", {}))
    held = replace(claim.connection, topics=(route,))
    ledger = repo.state.ledger.replace(claim.key, replace(claim, held=held))
    with pytest.raises(InvalidInput) as refused:
        rendered_files(replace(state(**(NODES | case.get("lost", {}))), ledger=ledger))
    found = refused.value.faults[0]
    assert (found.field, found.message[: len(case["told"])]) == (case["field"], case["told"])


# ---- what the clients' programs declare ----

DECLARED = plain_yaml.beside(__file__, "declared")
TYPES = {"string": "str", "integer": "int", "boolean": "bool", "number": "float"}


def leaves(schema: Any, definitions: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield (path, name of the Python type) for each value that a schema allows."""
    if "$ref" in schema:
        schema = definitions[schema["$ref"].rpartition("/")[2]]
    if schema.get("type") == "array":
        items = schema["items"]
        for item in items if isinstance(items, list) else [items]:
            yield from leaves(item, definitions, f"{path}[]")
    elif schema.get("type") == "object":
        assert schema["additionalProperties"] is False, path
        patterns = [("{}", part) for part in schema.get("patternProperties", {}).values()]
        for name, part in (*schema.get("properties", {}).items(), *patterns):
            yield from leaves(part, definitions, f"{path}.{name}" if path else name)
    else:
        values = schema.get("enum", [schema.get("const")])
        yield path, TYPES[schema["type"]] if "type" in schema else type(values[0]).__name__


@pytest.mark.parametrize("program", DECLARED, ids=lambda one: f"{one['program']} {one['version']}")
def test_a_program_declares_all_that_its_clients_are_told(program: dict[str, Any]) -> None:
    file = data_folder("templates") / "connections" / program["type"] / "schema.json"
    schema = json.loads(file.read_text())
    prefix = "/**/*.ros__parameters."  # for all nodes of a ROS program
    told = {
        (path.removeprefix(prefix), name) for path, name in leaves(schema, schema["definitions"])
    }
    assert len(told) > 5
    assert told - {*program["reads"].items()} == set()


def test_there_is_a_program_for_each_connection_type() -> None:
    words = {known.word for known in connection_types.CONNECTION_TYPES}
    assert {program["type"] for program in DECLARED} == words


# ---- the example of docs/connections.md ----


ROOT = Path(__file__).parents[3]
EXAMPLE = ROOT / "examples" / "connections"
PAGE = (ROOT / "docs" / "connections.md").read_text()


def test_the_example_gives_what_the_page_says() -> None:
    found = {str(path.relative_to(EXAMPLE)): path.read_text() for path in EXAMPLE.rglob("*.yaml")}
    request = yaml.safe_load(found.pop("demand.yaml"))
    books = MemoryRepo(found)
    decision = books.send(request)

    clients = books.objects("ConfigMap")
    bridge = json.loads((EXAMPLE / "zenoh-vehicle00.json").read_text())
    assert json.loads(clients["zenoh-vehicle00"]["data"]["config.json5"]) == bridge
    (warning,) = re.findall(r"```text\n(.*?)```", PAGE, re.DOTALL)
    assert decision.warnings == (warning.strip(),)
    (station,) = (item for name, item in clients.items() if "-source-" in name)
    parameters = yaml.safe_load(station["data"]["params.yaml"])["/**/*"]["ros__parameters"]
    assert parameters["bridge"]["ros2mqtt"]["ros_topics"] == ["/warnings"]
    assert parameters["broker"]["tls"]["enabled"] is True


def test_every_field_of_a_route_is_explained_with_the_types_that_honour_it() -> None:
    rows = re.findall(r"^\| `(\w+)`[^|]*\|[^|]*\| ([^|]*) \|$", PAGE, re.MULTILINE)
    told = {name: row for name, row in rows if name in ROUTE_OPTIONS}
    assert told.keys() == {*ROUTE_OPTIONS}
    honoured = frozenset().union(*(kind.options for kind in CONNECTION_TYPES))
    assert honoured == {*ROUTE_OPTIONS} - {"type", "reverse"}, "each does something in some client"
    for kind in CONNECTION_TYPES:
        label = {"MQTT": "MQTT", "ZENOH": "Zenoh", "ROS": "ROS"}[kind.name]
        listed = {name for name, row in told.items() if label in row and name != "type"}
        assert listed == kind.options
