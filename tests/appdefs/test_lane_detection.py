"""The example `examples/lane-detection` does what its page says."""

from __future__ import annotations

import json
import re
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.kit.config import skeleton
from tests.kit.goals import CLOUD, application, goal
from tests.kit.memory import MemoryRepo

EXAMPLE = Path(__file__).parents[2] / "examples" / "lane-detection"
PAGE = (EXAMPLE / "README.md").read_text()


def blocks(language: str) -> dict[str, str]:
    """Return the page's code blocks of one language, keyed by their first line without `# `."""
    found = re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)
    return {text.partition("\n")[0].lstrip("# "): text for text in found}


DEMAND = yaml.safe_load(blocks("yaml")["demand.yaml"])
RELEASE = {key: text for key, text in DEMAND.items() if key != "applications"}
RELEASE |= {"operation": "release"}


@pytest.fixture
def books() -> MemoryRepo:
    files = {
        path.relative_to(EXAMPLE).as_posix(): path.read_text()
        for path in EXAMPLE.rglob("*")
        if path.is_file() and path.suffix != ".md"
    }
    for title, text in blocks("yaml").items():
        path, _, more = title.partition(", ")
        if more:
            files[path] = skeleton()[path] + text
    return MemoryRepo(files)


def running(books: MemoryRepo) -> dict[str, list[str]]:
    by_node: dict[str, list[str]] = defaultdict(list)
    for entry in books.books()["services"].values():
        source = f" for {entry['source']}" if entry["source"] else ""
        by_node[entry["node"]].append(entry["service"] + source)
    return {node: sorted(names) for node, names in sorted(by_node.items())}


def carried(books: MemoryRepo) -> dict[str, list[str]]:
    return {id: [*one["topics"]] for id, one in books.books()["connections"].items()}


def test_what_the_page_says_runs_and_ends_with_the_demand(books: MemoryRepo) -> None:
    assert books.send(DEMAND).warnings == ()
    (shown,) = blocks("json").values()
    assert {"services": running(books), "connections": carried(books)} == json.loads(shown)
    books.send(RELEASE)
    assert (running(books), carried(books)) == ({}, {})


def test_its_object_detection_is_that_of_init_but_for_the_driver() -> None:
    folder = "appdefs/object-detection-fusion"
    path, template = f"{folder}/appdef.yaml", f"{folder}/values/object-detection.yaml.j2"
    expected = yaml.safe_load(skeleton()[path])
    expected["uses"] = {"lidar-driver": {"packets": "point_cloud"}}
    of_driver = {"each": "cloud", "inputs": {"cloud": "lidar-driver.points"}}
    expected["services"]["object-detection"] |= of_driver
    assert yaml.safe_load((EXAMPLE / path).read_text()) == expected
    changed = skeleton()[template].replace("source_topic", "inputs.cloud[0].topic")
    assert (EXAMPLE / template).read_text() == changed


def of_lidars(books: MemoryRepo) -> dict[str, Any]:
    services = books.books()["services"].items()
    return {name: one for name, one in services if one["service"] == "lidar-driver"}


def test_object_detection_reads_the_driver_that_lane_detection_has(books: MemoryRepo) -> None:
    books.send(DEMAND)
    before = of_lidars(books)
    join = goal([application("edge/fusion", who=["operator"], clouds=[CLOUD])])
    assert books.send(join).warnings == ()
    assert of_lidars(books).keys() == before.keys()
    shared = of_lidars(books)["lidar-vehicle00-vehicle00"]
    assert shared["applications"] == ["edge/fusion", "edge/lanes"]
    assert shared["parameters"] == {"rate_hz": 20}
    releases = books.objects("HelmRelease").items()
    (detection,) = (one["spec"]["values"] for name, one in releases if name.startswith("od-"))
    assert detection["detection"]["pointCloudTopic"] == "/vehicle00_points"

    books.send(RELEASE)
    ((name, left),) = of_lidars(books).items()
    assert (name, left["parameters"]) == ("lidar-vehicle00-vehicle00", {"rate_hz": 10})
