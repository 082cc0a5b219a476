"""Further types of applications need only folders of YAML and templates, and no code.

``tests/scenarios/a-second-type-of-application.yaml`` has a story of them.
"""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from tests.kit import plain_yaml
from tests.kit.config import skeleton
from tests.kit.goals import CLOUD
from tests.kit.memory import NOW, MemoryRepo
from tests.scenarios.running import configuration

ADDITIONS = {
    path: text
    for path, text in configuration(["recorder", "monitor"]).items()
    if path not in skeleton() or path.startswith("registry/")
}
"""The files that a platform engineer adds to a state repo: the appdefs and two registry files."""


def test_no_python_of_the_generator_knows_it() -> None:
    for path in (Path(__file__).parents[2] / "generator").rglob("*.py"):
        text = path.read_text().lower()
        assert "recorder" not in text, path
        assert "object-fusion" not in text, path


def merged(name: str, given: list[object]) -> object:
    """Return what the recorder gets if demands, one after the other, give these values."""
    repo = MemoryRepo(ADDITIONS)
    cloud = {"point_cloud": [{"topic": CLOUD[0], "source": CLOUD[1]}]}
    app = {"id": "edge/record", "type": "recorder", "node": "edge", "inputs": cloud}
    for minute, value in enumerate(given):
        item: dict[str, Any] = app | {"parameters": {} if value is None else {name: value}}
        demand = {"kind": "Demand", "demand": f"d{minute}", "requesters": [f"who{minute}"]}
        repo.send(demand | {"applications": [item]}, NOW + timedelta(minutes=minute))
    releases = repo.objects("HelmRelease").items()
    (found,) = (one["spec"]["values"][name] for id, one in releases if id.startswith("rec-"))
    return found


@pytest.mark.parametrize("case", plain_yaml.beside(__file__), ids=str)
def test_the_definition_says_how_values_of_several_demands_merge(case: dict[str, Any]) -> None:
    assert repr(merged(case["name"], case["given"])) == repr(case["merged"])
    if case["name"] != "title":  # of several titles, the last one counts
        assert merged(case["name"], case["given"][::-1]) == case["merged"]
