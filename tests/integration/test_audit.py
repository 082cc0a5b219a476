"""The program and plain git tell an auditor what ran when, for whom, and who booked it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.golden.cases import GOLDEN, requests_of
from tests.integration.conftest import On
from tests.kit.goals import APP, EXPERIMENT
from tests.kit.repo import GitRepo, git

ROOT = Path(__file__).parents[2]
DETECTION = "od-edge-vehicle00"
FUSION = "of-edge-object-detection-fusion-cf7e0180a8bb"
EDGE = "clusters/c-its/perception/edge"
PATH = f"{EDGE}/{DETECTION}.yaml"
IMAGES = "registry/images.yaml"


@pytest.fixture
def played(on: On, state: GitRepo) -> GitRepo:
    """A state repo after six steps of the experiment: four vehicles joined, two of them left."""
    assert on("request", *EXPERIMENT[:6]).code == 0
    return state


def test_git_finds_commits_as_the_docs_say(played: GitRepo) -> None:
    """The git commands of ``docs/audit.md`` find commits by author, trailer, message and path."""

    def log(*args: str) -> list[str]:
        return git(played, "log", *args).splitlines()

    subjects = f"{APP}, vehicle00/edge, station00/edge"
    assert log("--author=vehicle00", "--format=%an: %s", "main") == [
        f"vehicle00, station00 (requesters): Release {subjects}",
        f"vehicle00, station00 (requesters): Join {subjects}",
    ]
    requesters = log("--format=%(trailers:key=Requester,valueonly,separator=%x2C )", "main")
    assert requesters[:2] == ["vehicle01, station00", "vehicle00, station00"]
    assert len(requesters) == 6  # the commit of init has none
    for pattern, count in (
        ("^Operation: shutdown$", 2),
        ("^Requester: vehicle02$", 1),
        (f"^Application: {APP}$", 6),
        ("^Connection: vehicle03/edge$", 1),
    ):
        assert len(log(f"--grep={pattern}", "--format=%h", "main")) == count, pattern
    operation = "--format=%(trailers:key=Operation,valueonly,separator=)"
    assert log(operation, "main", "--", PATH) == ["shutdown", "join"]
    deleted = ("--diff-filter=D", "--name-only", "--format=%s", "main", "--")
    assert log(*deleted, f":(glob)clusters/**/{DETECTION}.yaml")[-1] == PATH
    path = next(p for p, text in played.files("ledger/").items() if "- vehicle02" in text)
    said = git(played, "blame", "--line-porcelain", "main", "--", path)
    authors = {line for line in said.splitlines() if line.startswith("author ")}
    assert authors == {"author vehicle02, station00 (requesters)"}


@pytest.mark.parametrize("case", ["zenoh", "ros"])
def test_why_explains_every_release_of_other_carriers(on: On, state: GitRepo, case: str) -> None:
    overlay = GOLDEN / case / "state-repo"
    files = [file for file in overlay.rglob("*") if file.is_file()]
    state.commit({file.relative_to(overlay).as_posix(): file.read_text() for file in files})
    assert on("request", requests_of(case)[0]).code == 0
    clients = [path for path in state.manifests() if "/_" not in path]
    assert clients
    for path in clients:
        found = on.json("why", Path(path).stem)
        assert (found["runs"], found["file"]) == (True, path)
        assert {claim["file"] for claim in found["claims"]} <= set(state.files("ledger/"))
        assert found["claims"] and found["started"]["operation"] == "join"


def test_one_thing_has_the_documented_keys_in_every_command(on: On, played: GitRepo) -> None:
    page = (ROOT / "docs" / "json.md").read_text()
    rows = dict(re.findall(r"^\| (\S[^|]*) \| (`[^|]*) \|$", page, re.MULTILINE))
    keys = {thing: re.findall(r"`(\w+)`", names) for thing, names in rows.items()}
    told, changed = on.json("why", APP), on.json("diff", "main~1", "main")
    back = on.json("rollback", "main~1", "--dry-run")
    failed = on("log", "nothing", "--output", "json")
    assert keys["commit"] == [*on.json("log")[0]] == list(told["started"])[:-1]
    assert keys["claim"] == [*back["restored"][0]]
    assert {*keys["claim"]} <= {*told["claims"][0]}
    assert keys["subject"] == [*told["subject"]] == [*told["claims"][0]["subject"]]
    for release in (told["releases"][0], on.json("status")["releases"][0]):  # and its health
        assert keys["release"] == [*release][: len(keys["release"])]
    assert keys["changed release"] == [*changed["releases"][0]] == [*back["releases"][0]]
    assert keys["changed entry of the bookkeeping"] == [*changed["bookkeeping"][0]]
    assert keys["fault"] == [*failed.json()["faults"][0]]
