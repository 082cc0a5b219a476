"""The example of docs/connections.md gives the result that the page shows."""

from __future__ import annotations

import json
import re
from pathlib import Path

import yaml
from demandops.connections.connection import ROUTE_OPTIONS
from demandops.connections.connection_types import CONNECTION_TYPES

from tests.kit.memory import MemoryRepo

ROOT = Path(__file__).parents[3]
EXAMPLE = ROOT / "examples" / "connections"
PAGE = (ROOT / "docs" / "connections.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


def test_the_example_gives_what_the_page_says() -> None:
    found = {str(path.relative_to(EXAMPLE)): path.read_text() for path in EXAMPLE.rglob("*.yaml")}
    request = yaml.safe_load(found.pop("demand.yaml"))
    books = MemoryRepo(found)
    decision = books.send(request)

    clients = books.objects("ConfigMap")
    bridge = json.loads((EXAMPLE / "zenoh-vehicle00.json").read_text())
    assert json.loads(clients["zenoh-vehicle00"]["data"]["config.json5"]) == bridge
    (warning,) = blocks("text")
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
