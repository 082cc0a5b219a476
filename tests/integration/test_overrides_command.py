"""The output of ``get overrides``, ``check``, ``bookkeeping`` and ``schema`` about overrides."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pygit2
import pytest
import yaml

from tests.kit.cli import Ran, Run
from tests.kit.config import override
from tests.kit.goals import perception
from tests.kit.repo import GitRepo


def text(select: dict[str, list[str]], **fields: Any) -> str:
    return override(select, **fields, reason="why")


@pytest.fixture
def overridden(state: GitRepo, request_json: Callable[..., Ran]) -> GitRepo:
    """A state repo with vehicle00's demand, and an override of each kind in effect."""
    request_json(perception())
    many = {
        "values": {"replicas": 2, "nodeSelector": None},
        "images": {"object-detection": {"tag": "x"}},
        "priority": 3,
    }
    state.commit(
        {
            "overrides/many.yaml": text({"services": ["object-detection"]}, **many),
            "overrides/closed.yaml": text({"connections": ["*"]}, deny=True),
            "overrides/off.yaml": text({"services": ["object-fusion"]}, deny=True),
            "overrides/lasting.yaml": text({"applications": ["edge/*"]}, keep=True),
            "overrides/idle.yaml": text({"nodes": ["cloud"]}, hold=True),
            "overrides/over.yaml": text(
                {"nodes": ["cloud"]}, keep=True, expires="2020-01-01T00:00:00Z"
            ),
        }
    )
    request_json(perception())
    return state


def test_overrides_are_listed_with_what_each_does(demandops: Run, overridden: GitRepo) -> None:
    listed = demandops("get", "overrides", "--state-repo", overridden.path, "--output", "json")
    assert listed.code == 0
    rows = {row["name"]: row for row in listed.json()["items"]}
    assert [*rows] == ["closed", "idle", "lasting", "many", "off", "over"]
    assert rows["many"] == {
        "name": "many",
        "file": "overrides/many.yaml",
        "state": "in force",
        "effects": {
            "values": {"replicas": 2, "nodeSelector": None},
            "images": {"object-detection": {"tag": "x"}},
        },
        "releases": [
            {
                "name": "od-edge-vehicle00",
                "what": "object-detection on edge for vehicle00",
                "cluster": "c-its",
                "domain": "perception",
                "namespace": "perception",
                "node": "edge",
                "file": "clusters/c-its/perception/edge/od-edge-vehicle00.yaml",
            }
        ],
        "claims": [],
        "priority": 3,
        "owner": "petra",
        "until": None,
        "reason": "why",
    }
    assert {name: row["state"] for name, row in rows.items()} == {
        "closed": "in force",
        "idle": "matches nothing",
        "lasting": "in force",
        "many": "in force",
        "off": "in force",
        "over": "expired",
    }
    (suspended,) = rows["closed"]["claims"]
    assert suspended["subject"] == {"kind": "connection", "id": "vehicle00/edge"}
    (kept,) = rows["lasting"]["claims"]
    assert kept["subject"] == {"kind": "application", "id": "edge/object_detection_fusion"}
    (off,) = rows["off"]["releases"]
    assert off["name"].startswith("of-edge-")
    table = demandops("get", "overrides", "--state-repo", overridden.path, "-o", "wide")
    for word in ("od-edge-vehicle00", "matches nothing", "2020-01-01 00:00:00", "petra"):
        assert word in table.out
    before = demandops("get", "overrides", "--state-repo", overridden.path, "--at", "main~2")
    assert before.out == "no overrides\n"


def test_bookkeeping_shows_what_is_suspended(demandops: Run, overridden: GitRepo) -> None:
    books = demandops("bookkeeping", "--state-repo", overridden.path, "--output", "json").json()
    (entry,) = books["suspended"]
    demand = entry.pop("demand")
    assert entry == {
        "kind": "connection",
        "id": "vehicle00/edge",
        "requesters": ["vehicle00"],
        "override": "overrides/closed.yaml",
        "reason": "why",
    }
    assert books["connections"] == {}
    table = demandops("bookkeeping", "--state-repo", overridden.path)
    assert demand in table.out
    assert "overrides/closed.yaml" in table.out


def test_check_says_what_an_override_would_do_and_warns_of_idle_ones(
    demandops: Run, state: GitRepo, request_json: Callable[..., Ran], tmp_path: Path
) -> None:
    request_json(perception())
    clone = tmp_path / "clone"
    pygit2.clone_repository(str(state.path), str(clone))
    folder = clone / "overrides"
    select = {"services": ["object-detection"]}
    (folder / "many.yaml").write_text(text(select, replicas=2))
    (folder / "idle.yaml").write_text(text({"nodes": ["nowhere"]}, hold=True, priority=1))
    (folder / "over.yaml").write_text(
        text(select, replicas=5, expires="2020-01-01T00:00:00Z", priority=9)
    )
    found = demandops("check", clone)
    assert found.code == 0
    assert found.err.splitlines() == [
        "warning: overrides/idle.yaml: has no effect now, because its field 'select' matches "
        "nothing, or nothing to which its effects apply; if it should have an effect, correct it",
        "warning: overrides/many.yaml: runs 2 replicas of object-detection, and each replica "
        "publishes every output; run only one, or set dividesWork: true in 'scaling' of the "
        "service's definition if the program divides its work among replicas",
        "warning: overrides/over.yaml: expired at 2020-01-01T00:00:00Z; remove the file, or write "
        "a later time",
    ]
    told = "  ~ od-edge-vehicle00 (object-detection on edge for vehicle00)"
    assert told in found.out.splitlines()
    (folder / "many.yaml").write_text(text(select, values={"replicas": "two"}))
    (folder / "idle.yaml").unlink()
    found = demandops("check", clone, "--output", "json")
    assert found.code == 1
    (fault,) = found.json()["faults"]
    assert (fault["file"], fault["field"]) == ("overrides/many.yaml", "values.replicas")


def test_a_dry_run_tells_of_a_denial_and_books_nothing(demandops: Run, overridden: GitRepo) -> None:
    tip = overridden.tip
    goal = yaml.safe_dump(perception(id="another"))
    ran = demandops("request", "-", "--state-repo", overridden.path, "--dry-run", stdin=goal)
    assert ran.code == 1
    assert "connections[0].id: is denied by overrides/closed.yaml: why; ask the" in ran.err
    assert overridden.tip == tip


def test_there_is_a_schema_for_overrides(demandops: Run) -> None:
    schema = json.loads(demandops("schema", "override").out)
    assert set(schema["required"]) == {"apiVersion", "kind", "reason", "owner", "select"}
    assert "name" not in schema["properties"]


def test_why_tells_what_overrides_do(demandops: Run, overridden: GitRepo) -> None:
    def why(name: str, *more: str) -> Any:
        where = ("--state-repo", overridden.path)
        return demandops("why", name, *where, *more)

    def asked(name: str) -> Any:
        return why(name, "--output", "json").json()

    shaped = asked("od-edge-vehicle00")
    (by,) = shaped["overrides"]
    assert by == {
        "name": "many",
        "file": "overrides/many.yaml",
        "effects": {
            "values": {"replicas": 2, "nodeSelector": None},
            "images": {"object-detection": {"tag": "x"}},
        },
        "priority": 3,
        "owner": "petra",
        "reason": "why",
        "until": None,
    }
    line = "  overrides/many.yaml: values, images (priority 3), of petra: why"
    assert line in why("od-edge-vehicle00").out.splitlines()
    (fusion,) = [
        release["name"]
        for entry in demandops(
            "get", "overrides", "--state-repo", overridden.path, "--output", "json"
        ).json()["items"]
        if entry["name"] == "off"
        for release in entry["releases"]
    ]
    denied = asked(fusion)
    assert (denied["runs"], denied["denied_by"]["file"]) == (False, "overrides/off.yaml")
    assert denied["stopped"]["operation"] == "follow"
    assert (
        "  denied by   overrides/off.yaml: deny (priority 0), of petra: why"
        in why(fusion).out.splitlines()
    )
    connection = asked("vehicle00/edge")
    assert connection["runs"] is False
    (claim,) = connection["claims"]
    assert claim["suspended_by"]["file"] == "overrides/closed.yaml"
    assert claim["kept_by"] is None
    told = why("vehicle00/edge").out.splitlines()
    assert "    suspended by overrides/closed.yaml: deny (priority 0), of petra: why" in told
    assert all(one["suspended_by"] is None for one in shaped["claims"])


def test_why_names_the_override_that_keeps_a_claim(
    demandops: Run, overridden: GitRepo, request_json: Callable[..., Ran]
) -> None:
    overridden.commit({"overrides/closed.yaml": None, "overrides/off.yaml": None})
    assert request_json(perception(), perception(shutdown=True)).code == 0
    where = ("--state-repo", overridden.path)
    (claim,) = demandops("why", "od-edge-vehicle00", *where, "--output", "json").json()["claims"]
    assert (claim["requesters"], claim["kept_by"]["file"]) == (["petra"], "overrides/lasting.yaml")
    told = demandops("why", "od-edge-vehicle00", *where).out.splitlines()
    assert "    kept by overrides/lasting.yaml: keep (priority 0), of petra: why" in told
    assert "    to release it: remove 'keep' from overrides/lasting.yaml by pull request" in told
