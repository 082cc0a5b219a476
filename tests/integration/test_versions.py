"""Demands that ask for a version, on the command line.

The tests look at the output of commands, at the approval of an update, and at a channel that gets a
new version.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.kit.cli import Ran, Run
from tests.kit.goals import APP, CLOUD
from tests.kit.repo import GitRepo, Person, branches, git

APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
VERSIONS = "registry/versions.yaml"
DETECTION = "od-edge-vehicle00"
Send = Callable[..., Ran]


def listed(**channels: str) -> str:
    """Return a ``registry/versions.yaml`` with these channels; it pins the detection's image."""
    versions = {
        v: {"images": {"object-detection": {"tag": v}}} for v in ("1.0.0", "1.1.0", "2.0.0")
    }
    entry = {"default": "1.0.0", "channels": channels, "versions": versions}
    head = {"apiVersion": "demandops/v1", "kind": "Versions"}
    return yaml.safe_dump(head | {"applications": {"object-detection-fusion": entry}})


@pytest.fixture
def send(demandops: Run, state: GitRepo, person: Person) -> Send:
    """Return a function that sends a demand for a version, in a repo with ``versions: update``."""
    text = person.read(APPDEF).replace("inputs:\n", "versions: update\ninputs:\n", 1)
    person.push({APPDEF: text, VERSIONS: listed(testing="1.1.0")})

    def call(demand: str, version: str = "", *more: str, operation: str = "put") -> Ran:
        inputs = {"point_cloud": [{"topic": CLOUD[0], "source": CLOUD[1]}]}
        app = {"id": APP, "type": "object-detection-fusion", "node": "edge", "inputs": inputs}
        app |= {"connect": "none"} | ({"version": version} if version else {})
        goal: dict[str, Any] = {"kind": "Demand", "demand": demand, "requesters": [demand]}
        goal |= {"applications": [app]} if operation == "put" else {"operation": operation}
        return demandops("request", "-", "--state-repo", state.path, *more, stdin=json.dumps(goal))

    return call


def tag(state: GitRepo) -> str:
    (text,) = [t for p, t in state.files("clusters").items() if p.endswith(f"/{DETECTION}.yaml")]
    (release,) = yaml.safe_load_all(text)
    return str(release["spec"]["values"]["image"]["tag"])


def test_the_views_show_the_running_and_the_demanded_version(
    send: Send, demandops: Run, state: GitRepo
) -> None:
    send("first")
    dry = send("second", "testing", "--dry-run")
    assert "      + version 1.1.0\n      + image object-detection 1.1.0\n" in dry.out
    assert send("second", "testing").code == 0
    where = ("--state-repo", state.path)
    told = demandops("bookkeeping", *where).out
    assert told.count("  1.1.0, testing requested by second  ") == 2
    versions = {
        "version": "0.1.0",
        "application_version": "1.1.0",
        "versions_asked": {"testing": ["second"]},
    }
    books = demandops("bookkeeping", *where, "--output", "json").json()["services"][DETECTION]
    rows = demandops("status", *where, "--output", "json").json()["releases"]
    (row,) = [each for each in rows if each["name"] == DETECTION]
    assert {key: books[key] for key in versions} == {key: row[key] for key in versions} == versions
    assert "testing requested by second" in demandops("status", *where).out
    why = demandops("why", DETECTION, *where).out
    assert "    demand second, request 'second', version testing\n" in why
    assert "  registry/versions.yaml applications.object-detection-fusion.versions.1.1.0:" in why
    assert "docker.io/rwthika/robotkube-object-detection:1.1.0\n" in why
    assert demandops("verify", "main~2..main", *where).code == 0


def test_an_upgrade_waits_for_a_person_and_its_end_does_not(
    send: Send, state: GitRepo, person: Person
) -> None:
    send("first")
    assert "awaiting approval" in send("second", "2.0.0").out
    assert tag(state) == "1.0.0"
    (branch,) = branches(state.path)
    person.merge(branch)
    assert " booked in " in send("third", "2.0.0").out, "a version that runs must need no approval"
    assert tag(state) == "2.0.0"
    assert send("second", operation="release").code == 0
    assert tag(state) == "2.0.0"
    assert send("third", operation="release").code == 0
    assert tag(state) == "1.0.0"
    assert git(state, "log", "-1", "--format=%B").count("+ version 1.0.0") == 1


def test_a_channel_that_a_person_moves_updates_what_asks_for_it(
    send: Send, demandops: Run, state: GitRepo, person: Person, tmp_path: Path
) -> None:
    send("first", "testing")
    folder = tmp_path / "pull-request"
    git(tmp_path, "clone", "-q", str(state.path), str(folder))
    (folder / VERSIONS).write_text(listed(testing="2.0.0"))
    checked = demandops("check", folder)
    assert (checked.code, checked.err) == (0, "")
    assert "      - version 1.1.0\n" in checked.out
    assert "      + version 2.0.0\n" in checked.out
    person.push({VERSIONS: listed(testing="2.0.0")})
    send("second")
    assert tag(state) == "2.0.0"
