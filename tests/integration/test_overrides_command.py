"""What commands say of overrides and do with them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.integration.conftest import On
from tests.kit.cli import Run
from tests.kit.config import override
from tests.kit.goals import perception
from tests.kit.repo import GitRepo, git

FUSION = "clusters/c-its/perception/edge/of-edge-object-detection-fusion-cf7e0180a8bb.yaml"
CLIENT = "clusters/c-its/perception/vehicle00/mqtt-vehicle00-edge-source-d3ca91c2df6c.yaml"
EFFECTS = {
    "values": {"replicas": 2, "nodeSelector": None},
    "images": {"object-detection": {"tag": "x"}},
}
OVER = "2020-01-01T00:00:00Z"


@pytest.fixture
def overridden(on: On, state: GitRepo) -> GitRepo:
    """A state repo with vehicle00's demand, and an override of each kind in effect."""
    on.book(perception())
    texts = {
        "many": override({"services": ["object-detection"]}, **EFFECTS, priority=3),
        "closed": override({"connections": ["*"]}, deny=True),
        "off": override({"services": ["object-fusion"]}, deny=True),
        "lasting": override({"applications": ["edge/*"]}, keep=True),
        "idle": override({"nodes": ["cloud"]}, hold=True),
        "over": override({"nodes": ["cloud"]}, keep=True, expires=OVER),
    }
    state.commit({f"overrides/{name}.yaml": text for name, text in texts.items()})
    on.book(perception())
    return state


@pytest.fixture
def clone(on: On, state: GitRepo, tmp_path: Path) -> Path:
    on.book(perception())
    git(tmp_path, "clone", "--quiet", str(state.path), "clone")
    return tmp_path / "clone"


@pytest.mark.usefixtures("overridden")
class TestOverridden:
    def test_overrides_are_listed_with_what_each_does(self, on: On) -> None:
        rows = {row["name"]: row for row in on.json("get", "overrides")["items"]}
        assert {name: row["state"] for name, row in rows.items()} == {
            "closed": "in force",
            "idle": "matches nothing",
            "lasting": "in force",
            "many": "in force",
            "off": "in force",
            "over": "expired",
        }
        (release,) = rows["many"].pop("releases")
        assert (release["name"], release["node"]) == ("od-edge-vehicle00", "edge")
        by = {"name": "many", "file": "overrides/many.yaml", "effects": EFFECTS, "priority": 3,
              "owner": "petra", "until": None, "reason": "a field test"}  # fmt: skip
        assert rows["many"] == by | {"state": "in force", "claims": []}
        assert on.json("why", "od-edge-vehicle00")["overrides"] == [by]
        (suspended,) = rows["closed"]["claims"]
        assert suspended["subject"] == {"kind": "connection", "id": "vehicle00/edge"}
        (kept,) = rows["lasting"]["claims"]
        assert kept["subject"] == {"kind": "application", "id": "edge/object_detection_fusion"}
        (off,) = rows["off"]["releases"]
        assert off["name"] == Path(FUSION).stem
        assert on("get", "overrides", "--at", "main~2").out == "no overrides\n"

    def test_bookkeeping_shows_what_is_suspended(self, on: On) -> None:
        books = on.json("bookkeeping")
        (entry,) = books["suspended"]
        assert entry == {
            "kind": "connection",
            "id": "vehicle00/edge",
            "demand": entry["demand"],
            "requesters": ["vehicle00"],
            "override": "overrides/closed.yaml",
            "reason": "a field test",
        }
        assert books["connections"] == {}

    def test_a_dry_run_tells_of_a_denial_and_books_nothing(self, on: On) -> None:
        given = yaml.safe_dump(perception(id="another"))
        told = on.refused("request", "-", "--dry-run", stdin=given)
        assert "connections[0].id: is denied by overrides/closed.yaml: a field test" in told

    def test_why_tells_what_overrides_do(self, on: On) -> None:
        denied = on.json("why", Path(FUSION).stem)
        assert (denied["runs"], denied["denied_by"]["file"]) == (False, "overrides/off.yaml")
        assert denied["stopped"]["operation"] == "follow"
        link = on.json("why", "vehicle00/edge")
        (claim,) = link["claims"]
        assert (link["runs"], claim["kept_by"]) == (False, None)
        assert claim["suspended_by"]["file"] == "overrides/closed.yaml"
        (claim, *_) = on.json("why", "od-edge-vehicle00")["claims"]
        assert claim["suspended_by"] is None
        for name, line in (
            ("od-edge-vehicle00", "  overrides/many.yaml: values, images (priority 3), of petra"),
            (Path(FUSION).stem, "  denied by   overrides/off.yaml: deny (priority 0), of petra"),
            (
                "vehicle00/edge",
                "    suspended by overrides/closed.yaml: deny (priority 0), of petra",
            ),
        ):
            assert f"{line}: a field test" in on("why", name).out.splitlines()

    def test_why_names_the_override_that_keeps_a_claim(self, on: On, state: GitRepo) -> None:
        state.commit({"overrides/closed.yaml": None, "overrides/off.yaml": None})
        on.book(perception(), perception(shutdown=True))
        (claim,) = on.json("why", "od-edge-vehicle00")["claims"]
        assert claim["requesters"] == ["petra"]
        assert claim["kept_by"]["file"] == "overrides/lasting.yaml"
        told = on("why", "od-edge-vehicle00").out
        assert "    kept by overrides/lasting.yaml: keep (priority 0), of petra: " in told
        assert "    to release it: remove 'keep' from overrides/lasting.yaml by pull " in told


def test_check_says_what_an_override_would_do_and_warns_of_idle_ones(
    demandops: Run, clone: Path
) -> None:
    def put(name: str, select: dict[str, list[str]], **effects: Any) -> None:
        (clone / "overrides" / f"{name}.yaml").write_text(override(select, **effects))

    detection = {"services": ["object-detection"]}
    put("many", detection, replicas=2)
    put("idle", {"nodes": ["nowhere"]}, hold=True, priority=1)
    put("over", detection, replicas=5, expires=OVER, priority=9)
    ran = demandops("check", clone)
    assert ran.code == 0
    idle, many, over = ran.err.splitlines()
    assert idle.startswith("warning: overrides/idle.yaml: has no effect now")
    assert many.startswith("warning: overrides/many.yaml: runs 2 replicas of object-detection")
    assert over.startswith(f"warning: overrides/over.yaml: expired at {OVER}")
    told = "  ~ od-edge-vehicle00 (object-detection on edge for vehicle00)"
    assert told in ran.out.splitlines()
    put("many", detection, values={"replicas": "two"})
    (clone / "overrides" / "idle.yaml").unlink()
    marker = clone / "ledger" / "overrides" / "race.yaml"
    marker.parent.mkdir()
    marker.write_text("a: b\n")
    ran = demandops("check", clone, "--output", "json")
    assert ran.code == 1
    assert {(fault["file"], fault["field"]) for fault in ran.json()["faults"]} == {
        ("overrides/many.yaml", "values.replicas"),
        ("ledger/overrides/race.yaml", ""),
    }


def test_there_is_a_schema_for_overrides(demandops: Run) -> None:
    schema = json.loads(demandops("schema", "override").out)
    assert set(schema["required"]) == {"apiVersion", "kind", "reason", "owner", "select"}
    assert "name" not in schema["properties"]


VALUES = [("domainId: 0", "domainId: 7"), ("replicas: 1", "replicas: 3")]


@pytest.mark.parametrize(
    ("path", "replaced", "gitops"),
    [
        (FUSION, VALUES, "flux"),
        (FUSION, VALUES, "argocd"),
        (CLIENT, [("mqtt-client:2025-04", "mqtt-client:2026-01")], "flux"),
    ],
    ids=["values-and-replicas", "with-argocd", "image-of-a-client"],
)
def test_the_override_suggested_gives_the_file_that_was_edited_by_hand(
    on: On, demandops: Run, clone: Path, path: str, replaced: list[tuple[str, str]], gitops: str
) -> None:
    def check() -> Any:
        return json.loads(demandops("check", clone, "--output", "json").out)

    assert on("upgrade", "--gitops", gitops).code == 0
    git(clone, "pull", "--quiet")
    text = (clone / path).read_text()
    for old, new in replaced:
        assert old in text
        text = text.replace(old, new)
    (clone / path).write_text(text)
    (suggested,) = check()["suggestions"]
    git(clone, "checkout", "--quiet", ".")
    (clone / suggested["file"]).parent.mkdir(exist_ok=True)
    (clone / suggested["file"]).write_text(suggested["text"])
    found = check()
    assert (found["faults"], [one["file"] for one in found["files"]]) == ([], [path])
    git(clone, "add", "--all")
    git(clone, "commit", "--quiet", "-m", "Override instead")
    git(clone, "push", "--quiet", "origin", "main")
    on.book(perception(id="second"))
    written = on.state.files()[path]
    assert [*yaml.safe_load_all(written)] == [*yaml.safe_load_all(text)]


class TestUpgrade:
    def test_a_release_that_is_held_keeps_the_controller_from_being_changed(
        self, on: On, state: GitRepo
    ) -> None:
        on.book(perception())
        hold = override({"services": ["object-fusion"]}, hold=True)
        state.commit({"overrides/race.yaml": hold})
        told = on.refused("upgrade", "--gitops", "argocd")
        assert told.startswith("error: overrides/race.yaml: hold: keeps the file of of-edge-")
        state.commit({"overrides/race.yaml": None})
        assert on("upgrade", "--gitops", "argocd").code == 0

    def test_it_honours_a_persons_commit_that_no_generator_has_followed(
        self, on: On, state: GitRepo
    ) -> None:
        """The commit deletes an application's claims; its override keeps the application."""
        on.book(perception())
        keep = override({"applications": ["*"]}, keep=True)
        claims = dict.fromkeys(state.files("ledger/applications/"))
        state.commit({"overrides/race.yaml": keep, **claims})
        assert on("upgrade", "--gitops", "argocd").code == 0
        assert FUSION in state.files()
        rows = on.json("verify")
        assert [(row["holds"], row["skipped"]) for row in rows] == [(True, None)]
        tip = state.tip
        on.book(perception())
        assert FUSION in state.files()
        assert state.files("ledger/applications/")
        assert state.tip != tip
