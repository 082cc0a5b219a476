"""The command line: text, JSON and exit codes of every command.

Exit codes: 0 done, 1 a fault that the user can fix, 2 wrong usage, 3 a fault of the program.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pygit2
import pytest
import yaml
from demandops import __version__
from demandops.cli.views import bookkeeping

from tests.kit.goals import (
    APP,
    CLOUD,
    EXPERIMENT,
    Goal,
    application,
    connection,
    goal,
    perception,
    put,
)
from tests.kit.repo import FORGER, git

SHA = re.compile(r"[0-9a-f]{40}")
FUSION = "of-edge-object-detection-fusion-cf7e0180a8bb"
SOURCE_END = "mqtt-vehicle01-edge-source-092a70a6cc97"
TARGET_END = "mqtt-vehicle01-edge-target-f918b3fb6980"
NO_REVISION = (
    "error: 'nope' is neither a commit of the state repo nor a time; write a branch, a tag or 4 to "
    "40 digits of an id, with ~N for the Nth commit before it, or a time like 2026-01-31T14:03, "
    "2026-01-31, 14:03 (all UTC) or 2h (two hours ago); `demandops log` lists the commits\n"
)
REQUEST_KEYS = ["index", "request", "outcome", "commit", "faults", "warnings", "not_held", "placed"]
NO_CARRIER = (
    "application 'edge/object_detection_fusion': no connection carries "
    "/vehicles/vehicle00/drivers/lidar/pointcloud (point_cloud) of 'vehicle00' to 'edge'"
)

Run = Callable[..., Any]


def cells_of(table: str) -> list[list[str]]:
    """Return the cells of each line of a table; the table has no empty cells."""
    return [re.split(r"\s{2,}", line) for line in table.splitlines()]


def text(*goals: Goal) -> str:
    return yaml.safe_dump_all(goals, sort_keys=False)


@pytest.fixture
def joined(request_json: Run, state: Any) -> Any:
    """Return a state repo in which ``perception()`` is booked."""
    assert request_json(perception()).code == 0
    return state


class TestInit:
    def test_a_bare_state_repo(self, demandops: Run, tmp_path: Path) -> None:
        folder = tmp_path / "new" / "state.git"
        ran = demandops("init", folder, "--bare")
        assert (ran.code, ran.err) == (0, "")
        repo = pygit2.Repository(str(folder))
        tip = repo.references["refs/heads/main"].target
        assert repo.is_bare
        assert repo.references["HEAD"].target == "refs/heads/main"
        assert ran.out.startswith(f"state repo in {folder}, first commit {str(tip)[:10]} on main\n")
        assert f"next: demandops serve --state-repo {folder}\n" in ran.out
        assert demandops("bookkeeping", "--state-repo", folder).code == 0

    def test_a_state_repo_to_edit(self, demandops: Run, tmp_path: Path) -> None:
        folder = tmp_path / "state"
        ran = demandops("init", folder, "--output", "json")
        found = ran.json()
        assert SHA.fullmatch(found.pop("commit"))
        assert found == {"directory": str(folder), "gitops": "flux", "bare": False}
        assert (folder / "inventory" / "nodes.yaml").is_file()
        assert not git(folder, "status", "--porcelain")
        assert demandops("check", folder).code == 0

    def test_a_state_repo_for_argo_cd(self, demandops: Run, tmp_path: Path) -> None:
        folder = tmp_path / "state"
        url = "https://git.example/own.git"
        ran = demandops("init", folder, "--gitops", "argocd", "--url", url, "--output", "json")
        assert ran.json()["gitops"] == "argocd"
        assert demandops("check", folder).code == 0
        assert not (folder / "demandops.argocd.yaml").exists()
        root = yaml.safe_load((folder / "demandops.yaml").read_text())
        assert (root["gitops"], root["argocd"]) == ("argocd", {"url": url})
        found = yaml.safe_load_all((folder / "bootstrap" / "c-its.yaml").read_text())
        kinds = [item["kind"] for item in found]
        assert kinds[-2:] == ["AppProject", "Application"]
        assert "GitRepository" not in kinds

    def test_without_a_url_no_cluster_can_follow_it(self, demandops: Run, tmp_path: Path) -> None:
        folder = tmp_path / "state"
        ran = demandops("init", folder)
        assert "kubectl" not in ran.out
        assert "no cluster can follow the state repo yet: set the url" in ran.out
        assert not (folder / "bootstrap").exists()
        root = folder / "demandops.yaml"
        root.write_text(
            root.read_text().replace("# url: https://git.example", "url: https://git.own")
        )
        ran = demandops("check", folder)
        assert ran.code == 0
        assert "write  bootstrap/c-its.yaml" in ran.out

    def test_argo_cd_needs_a_url(self, demandops: Run, tmp_path: Path) -> None:
        ran = demandops("init", tmp_path / "state", "--gitops", "argocd")
        assert (ran.code, ran.out) == (1, "")
        assert ran.err == (
            "error: --gitops argocd needs --url, because all manifests for Argo CD name the URL "
            "from which the clusters fetch the state repo: --url https://HOST/PATH or "
            "--url git@HOST:PATH\n"
        )
        assert not (tmp_path / "state").exists()

    def test_an_address_as_git_writes_it(self, demandops: Run, tmp_path: Path) -> None:
        folder = tmp_path / "state"
        ran = demandops("init", folder, "--url", "git@git.example:fleet/state.git")
        assert ran.code == 0
        assert f"git -C {folder} show main:bootstrap/c-its.yaml | kubectl apply -f -" in ran.out
        url = "ssh://git@git.example/fleet/state.git"
        assert yaml.safe_load((folder / "demandops.yaml").read_text())["flux"]["url"] == url
        assert url in (folder / "bootstrap" / "c-its.yaml").read_text()
        root = folder / "demandops.yaml"
        root.write_text(root.read_text().replace(url, "git@git.example:fleet/state.git"))
        assert demandops("check", folder).err == (
            "error: demandops.yaml:12: flux.url: 'git@git.example:fleet/state.git' is not a URL, "
            f"but the GitOps controllers need one; write {url}\n"
        )

    @pytest.mark.parametrize("gitops", ["flux", "argocd"])
    def test_an_empty_fleet(self, demandops: Run, tmp_path: Path, gitops: str) -> None:
        folder, url = tmp_path / "state", "https://git.example/own.git"
        options = ["--url", url, "--gitops", gitops, "--example", "none"]
        assert demandops("init", folder, *options).code == 0
        ran = demandops("check", folder)
        assert (ran.code, ran.err) == (0, "")
        assert [path.name for path in (folder / "appdefs").iterdir()] == ["charts"]
        for path in (folder / "inventory").iterdir():
            assert not yaml.safe_load(path.read_text())[path.stem]
        texts = "".join(
            path.read_text() for top in ("policy", "registry") for path in (folder / top).iterdir()
        )
        assert "perception" not in texts.replace("collective", "")
        assert list(
            yaml.safe_load((folder / "registry" / "images.yaml").read_text())["images"]
        ) == ["mqtt-client"]

    def test_an_empty_working_directory_is_used(
        self, demandops: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        folder = tmp_path / "state"
        (folder / "inner").mkdir(parents=True)
        monkeypatch.chdir(folder)
        assert demandops("init", "inner/..").code == 1
        monkeypatch.chdir(folder / "inner")
        ran = demandops("init", ".")
        assert (ran.code, ran.err) == (0, "")
        assert (folder / "inner" / "demandops.yaml").is_file()

    def test_a_folder_in_use_is_refused_and_left_alone(
        self, demandops: Run, tmp_path: Path
    ) -> None:
        folder = tmp_path / "state"
        folder.mkdir()
        (folder / "mine").write_text("precious")
        ran = demandops("init", folder)
        assert (ran.code, ran.out) == (1, "")
        assert ran.err == (
            f"error: {folder} exists and is not empty; name a new folder (nothing was changed)\n"
        )
        assert [path.name for path in tmp_path.iterdir() if path.name != "home"] == ["state"]
        assert [path.name for path in folder.iterdir()] == ["mine"]

    def test_a_file_in_the_way_is_the_users_to_mend(self, demandops: Run, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("precious")
        for place in ("file", "file/state"):
            ran = demandops("init", tmp_path / place)
            assert (ran.code, ran.out) == (1, "")
            assert ran.err.startswith("error: ")
            assert str(tmp_path / "file") in ran.err
            assert "is not empty" not in ran.err
        assert (tmp_path / "file").read_text() == "precious"


class TestRequest:
    def test_the_json_is_what_programs_rely_on(self, state: Any, request_json: Run) -> None:
        asked = goal([application(), application("other")], shutdown=True)
        goals = goal([application()], id="r"), goal([application(node="egde")], id="s"), asked
        before, given = state.tip, text(*goals)
        line = given[: given.index("egde")].count("\n") + 1
        ran = request_json(*goals)
        assert (ran.code, ran.err) == (1, "")
        booked, refused, released = ran.json()
        assert list(booked) == list(refused) == REQUEST_KEYS
        first = git(state, "rev-parse", "main~1")
        assert (first, git(state, "rev-parse", "main~2")) == (booked["commit"], before)
        assert booked == {
            "index": 0,
            "request": "r",
            "outcome": "booked",
            "commit": first,
            "faults": [],
            "warnings": [NO_CARRIER],
            "not_held": [],
            "placed": [],
        }
        assert (refused["outcome"], refused["commit"]) == ("refused", None)
        assert refused["faults"] == [
            {
                "code": "unknown-node",
                "file": "",
                "field": "apps[0].header.node_id",
                "message": "'egde' is not in inventory/nodes.yaml; did you mean 'edge'?",
                "line": line,
            }
        ]
        assert (released["outcome"], released["commit"]) == ("released", state.tip)
        assert released["not_held"] == ["application 'other' for vehicle00"]

    def test_the_text_tells_the_same(self, demandops: Run, state: Any) -> None:
        ran = demandops(
            "request", "-", "--state-repo", state.path,
            stdin=text(goal([application()], id="one"), goal([application(node="egde")], id="two"),
                       goal([application(), application("other")], id="one", shutdown=True)),
        )  # fmt: skip
        second, first, _ = log_of(demandops, state)
        assert ran.code == 1
        assert ran.out == (
            f"standard input: request 0 'one' booked in {first}\n"
            f"standard input: request 2 'one' released in {second}\n"
        )
        assert ran.err == (
            f"  warning: {NO_CARRIER}\n"
            "standard input: request 1 'two' refused\n"
            "  line 21: apps[0].header.node_id: 'egde' is not in inventory/nodes.yaml; did you "
            "mean 'edge'?\n"
            "  listed, but not held by the requester: application 'other' for vehicle00\n"
        )

    def test_files_and_documents_are_taken_in_order(
        self, demandops: Run, state: Any, tmp_path: Path
    ) -> None:
        for name in "ab":
            documents = (goal([], [connection(name)], id=f"{name}{number}") for number in (1, 2))
            (tmp_path / f"{name}.yaml").write_text(text(*documents))
        ran = demandops(
            "request", tmp_path / "b.yaml", "-", tmp_path / "a.yaml", "--state-repo", state.path,
            "--output", "json", stdin=text(goal([], [connection("c")], id="c1")),
        )  # fmt: skip
        rows = ran.json()
        assert [(row["index"], row["request"]) for row in rows] == [
            (0, "b1"),
            (1, "b2"),
            (2, "c1"),
            (3, "a1"),
            (4, "a2"),
        ]
        assert [row["commit"] for row in rows] == log_of(demandops, state)[:5][::-1]

    def test_what_documents_demand_is_released(self, demandops: Run, state: Any) -> None:
        where = ("--state-repo", state.path)
        link = {"id": "d/link", "type": "mqtt", "source": "vehicle00", "target": "edge"}
        link |= {"topics": [{"source": "/d"}]}
        ours = put("d", "vehicle00", applications=[], connections=[link], lease=600)
        given = text(perception(), ours)
        ran = demandops("request", "-", *where, stdin=given)
        assert ran.code == 0
        assert (
            ran.err == "  warning: lease: 600 is 600 seconds; write the unit, like 600s or 600m\n"
        )
        ran = demandops("request", "-", "--release", *where, "-o", "json", stdin=given)
        assert [row["outcome"] for row in ran.json()] == ["released", "released"]
        assert demandops("get", "claims", *where, "-o", "name").out.strip() == ""

    def test_empty_documents_are_passed_over(self, demandops: Run, state: Any) -> None:
        given = f"---\n---\n{text(perception())}\n---\n# nothing\n---\n{text(perception())}"
        ran = demandops("request", "-", "--state-repo", state.path, "--output", "json", stdin=given)
        assert [(row["index"], row["outcome"]) for row in ran.json()] == [
            (0, "booked"),
            (1, "unchanged"),
        ]

    def test_one_of_the_wrong_form_books_nothing_at_all(
        self, request_json: Run, state: Any
    ) -> None:
        before = state.tip
        ran = request_json(perception(id="1"), {"id": 5}, perception(id="3"))
        assert (ran.code, state.tip) == (1, before)
        rows = ran.json()
        assert [(row["index"], row["outcome"], row["commit"]) for row in rows] == [
            (index, "refused", None) for index in range(3)
        ]
        told = [[(each["field"], each["message"]) for each in row["faults"]] for row in rows]
        other = [("", "not booked, because another request of the same command cannot be parsed")]
        assert told == [other, [("id", "must be text, not 5; put it in quotes")], other]

    def test_a_file_that_does_not_parse_books_nothing_at_all(
        self, demandops: Run, state: Any, tmp_path: Path
    ) -> None:
        before = state.tip
        (tmp_path / "good.yaml").write_text(text(perception()))
        (tmp_path / "bad.yaml").write_text(f"{text(perception())}---\nid: [\n")
        files = (tmp_path / "good.yaml", tmp_path / "bad.yaml")
        ran = demandops("request", *files, "--state-repo", state.path, "--output", "json")
        (fault,) = ran.json()["faults"]
        assert (ran.code, fault["file"], state.tip) == (1, f"{tmp_path}/bad.yaml", before)
        assert ran.err.startswith(f"error: {tmp_path}/bad.yaml: line ")

    @pytest.mark.parametrize(
        "command",
        [
            ("bookkeeping",), ("decommission", "n"), ("diff", "a", "b"), ("get", "overrides"),
            ("get", "proposals"), ("log",), ("rollback", "r", "-m", "why"), ("status",),
            ("upgrade",), ("verify",), ("why", "n"),
        ],
    )  # fmt: skip
    def test_a_command_that_fails_prints_its_faults_as_json(
        self, demandops: Run, tmp_path: Path, command: tuple[str, ...]
    ) -> None:
        where = ("--state-repo", tmp_path / "none", "--output", "json")
        told, text = demandops(*command, *where), demandops(*command, *where[:2])
        (fault,) = told.json()["faults"]
        assert (told.code, text.code, text.out) == (1, 1, "")
        assert list(fault) == ["code", "field", "message", "file", "line"]
        assert told.err == text.err == f"error: {fault['message']}\n"

    def test_a_dry_run_shows_the_consequence_and_books_nothing(
        self, demandops: Run, state: Any, data_home: Path
    ) -> None:
        before = state.tip
        ran = demandops(
            "request", "-", "--dry-run", "--state-repo", state.path, stdin=text(perception(id="r"))
        )
        assert (ran.code, ran.err, state.tip) == (0, "", before)
        assert not list(data_home.rglob("outbox.jsonl"))
        lines = ran.out.splitlines()
        assert lines[0] == "Request 0: 'r' would be booked"
        assert "  + od-edge-vehicle00 (object-detection on edge for vehicle00)" in lines
        assert f"  + {FUSION} (object-fusion on edge for {APP})" in lines
        paths = [line.split()[-1] for line in lines if line.startswith("  write ")]
        assert demandops(
            "request", "-", "--state-repo", state.path, stdin=text(perception(id="r"))
        ).code == 0  # fmt: skip
        assert paths == sorted(changed_files(state))

    def test_a_dry_run_decides_each_on_top_of_the_one_before(
        self, request_json: Run, state: Any
    ) -> None:
        before = state.tip
        ran = request_json(
            perception(id="r"),
            perception(id="r"),
            goal([application(node="cloud")], id="x"),
            perception(id="r", shutdown=True),
            perception(id="r", shutdown=True),
            more=("--dry-run",),
        )
        assert [row["outcome"] for row in ran.json()] == [
            "booked",
            "unchanged",
            "refused",
            "released",
            "unchanged",
        ]
        keys = [*REQUEST_KEYS, "releases", "files"]
        assert all(list(row) == keys for row in ran.json() if row["outcome"] != "refused")
        assert [each["change"] for each in ran.json()[0]["releases"]] == ["start"] * 4
        assert (ran.code, state.tip) == (1, before)

    def test_the_experiments_files_as_they_are(self, demandops: Run, state: Any) -> None:
        ran = demandops("request", *EXPERIMENT, "--state-repo", state.path, "--output", "json")
        assert ran.code == 0
        assert [row["outcome"] for row in ran.json()] == ["booked"] * 4 + ["released"] * 4
        assert [row["warnings"] for row in ran.json()] == [[]] * 8
        assert demandops("bookkeeping", "--state-repo", state.path).out.count("(nothing)") == 2
        books = demandops("bookkeeping", "--state-repo", state.path, "--output", "json").json()
        assert (books["services"], books["connections"]) == ({}, {})


def log_of(demandops: Run, state: Any) -> list[str]:
    rows = demandops("log", "--state-repo", state.path, "--output", "json").json()
    return [row["commit"] for row in rows]


def changed_files(state: Any) -> list[str]:
    repo = pygit2.Repository(str(state.path))
    tip = repo[state.tip].peel(pygit2.Commit)
    return [patch.delta.new_file.path for patch in repo.diff(tip.parents[0], tip)]


class TestBookkeeping:
    def test_the_json_is_what_programs_rely_on(self, demandops: Run, joined: Any) -> None:
        ran = demandops("bookkeeping", "--state-repo", joined.path, "--output", "json")
        assert (ran.code, ran.err) == (0, "")
        assert ran.json() == {
            "services": {
                "od-edge-vehicle00": {
                    "applications": [APP],
                    "service": "object-detection",
                    "node": "edge",
                    "source": "vehicle00",
                    "source_topic": CLOUD[0],
                    "version": "0.1.0",
                    "application_version": None,
                    "versions_asked": {},
                    "parameters": {},
                    "inputs": {"point_cloud": {CLOUD[0]: ["vehicle00"]}},
                    "requesters": ["vehicle00"],
                },
                FUSION: {
                    "applications": [APP],
                    "service": "object-fusion",
                    "node": "edge",
                    "source": None,
                    "source_topic": None,
                    "version": "0.1.0",
                    "application_version": None,
                    "versions_asked": {},
                    "parameters": {},
                    "inputs": {
                        "ego_data": {},
                        "object_list": {"/vehicle00_local_objectlist": ["vehicle00"]},
                    },
                    "requesters": ["vehicle00"],
                },
            },
            "connections": {
                "vehicle00/edge": {
                    "type": "mqtt",
                    "source": "vehicle00",
                    "target": "edge",
                    "topics": {CLOUD[0]: ["vehicle00"]},
                    "requesters": ["vehicle00"],
                }
            },
            "demands": {
                "f55dfde4475a5cd804f0": {
                    "action": "DeploymentRequest",
                    "request": "request",
                    "requesters": ["vehicle00"],
                }
            },
            "commit": joined.tip,
        }

    def test_lists_are_sorted(self, demandops: Run, joined: Any, request_json: Run) -> None:
        request_json(
            goal(
                [application("a/first", who=["z", "a"])],
                [connection(who=["z", "a"], topics=["/z", "/a"])],
            )
        )
        found = demandops("bookkeeping", "--state-repo", joined.path, "--output", "json").json()
        detection = found["services"]["od-edge-vehicle00"]
        assert detection["applications"] == ["a/first", APP]
        assert detection["requesters"] == ["a", "vehicle00", "z"]
        entry = found["connections"]["vehicle00/edge"]
        assert [*entry["topics"]] == ["/a", CLOUD[0], "/z"]
        assert entry["requesters"] == ["a", "vehicle00", "z"]

    def test_the_text_is_a_table(self, demandops: Run, joined: Any) -> None:
        ran = demandops("bookkeeping", "--state-repo", joined.path)
        assert (ran.code, ran.err) == (0, "")
        cells = cells_of(ran.out)
        assert ["od-edge-vehicle00", "object-detection", "0.1.0", "edge", "vehicle00", CLOUD[0],
                "vehicle00"] in cells  # fmt: skip
        assert ["vehicle00/edge", "mqtt", "vehicle00", "edge", CLOUD[0], "vehicle00"] in cells
        assert ran.out.splitlines()[-1] == f"at {joined.tip}"


def test_an_id_is_shown_as_it_is(demandops: Run, state: Any, request_json: Run) -> None:
    ids = ["a:car:b", "[red]a[/red]", "[/]", "a\\[b"]
    assert request_json(*(goal([application(id)], [connection(id)]) for id in ids)).code == 0
    for command in (["bookkeeping"], ["log"], ["diff", "main~4", "main"], ["verify", "main~4.."]):
        ran = demandops(*command, "--state-repo", state.path)
        assert (ran.code, ran.err) == (0, "")
        assert [id for id in ids if id not in ran.out] == []


class TestLog:
    KEYS = (
        "commit", "time", "author", "summary", "why", "operation", "operation_id", "request",
        "demands", "requesters", "applications", "connections", "render_version",
    )  # fmt: skip

    def test_the_json_tells_all_that_the_trailers_say(self, demandops: Run, joined: Any) -> None:
        joined.commit({"inventory/README.md": "hello\n"})
        ran = demandops("log", "--state-repo", joined.path, "--output", "json")
        by_hand, join, init = ran.json()
        assert ran.code == 0
        for row in (by_hand, join, init):
            assert tuple(row) == self.KEYS
        assert (join["operation"], join["request"], join["author"]) == (
            "join",
            "request",
            "vehicle00 (requester)",
        )
        assert join["requesters"] == ["vehicle00"]
        assert (join["applications"], join["connections"]) == ([APP], ["vehicle00/edge"])
        assert len(join["demands"]) == 1
        assert init["operation"] == "init"
        assert (by_hand["operation"], by_hand["author"]) == (None, "A person")

    def test_the_text_is_a_table(self, demandops: Run, joined: Any) -> None:
        joined.commit({"inventory/README.md": "hello\n"})
        ran = demandops("log", "--state-repo", joined.path)
        _, *rows = cells_of(ran.out)
        assert [(row[0], *row[2:]) for row in rows] == [
            (joined.tip[:10], "By hand", "A person"),
            (rows[1][0], f"Join {APP}, vehicle00/edge", "vehicle00"),
            (rows[2][0], "Create the state repo", "DemandOps generator"),
        ]
        assert all(row[1].endswith(" ago") for row in rows)
        wide = cells_of(demandops("log", "-o", "wide", "--state-repo", joined.path).out)
        assert wide[2][5:] == ["join", "vehicle00 (requester)", "request"]

    def test_as_many_and_from_where_one_says(
        self, demandops: Run, state: Any, request_json: Run
    ) -> None:
        for number in range(3):
            request_json(goal([], [connection(f"c{number}")]))
        where = ("--state-repo", state.path, "--output", "json")
        commits = [row["commit"] for row in demandops("log", *where).json()]
        assert len(commits) == 4
        for args, wanted in (
            (["-n", "2"], commits[:2]),
            (["main~1"], commits[1:]),
            ([f"{commits[2]}..main"], commits[:2]),
            ([f"{commits[2]}.."], commits[:2]),
            (["main..main"], []),
        ):
            assert [row["commit"] for row in demandops("log", *args, *where).json()] == wanted


def test_a_revision_that_does_not_exist_is_told(demandops: Run, state: Any) -> None:
    for command in ("bookkeeping --at nope", "log nope", "log nope..main", "log main..nope",
                    "diff main nope", "verify nope"):  # fmt: skip
        assert demandops(*command.split(), "--state-repo", state.path) == (1, "", NO_REVISION)


class TestDiff:
    def test_the_text_tells_what_differs(
        self, demandops: Run, joined: Any, request_json: Run
    ) -> None:
        request_json(
            goal(
                [application(who=["vehicle01"], ego=[("/ego", "vehicle01")])],
                [connection("vehicle01/edge", who=["vehicle01"], topics=["/ego"])],
                id="further",
            )
        )
        ran = demandops("diff", "main~1", "main", "--state-repo", joined.path)
        assert (ran.code, ran.err) == (0, "")
        assert ran.out.splitlines() == [
            "~ service od-edge-vehicle00",
            "    + requester vehicle01",
            f"~ service {FUSION}",
            "    + requester vehicle01",
            "    + ego_data /ego",
            "+ connection vehicle01/edge for vehicle01",
            f"+ release {SOURCE_END} (MQTT source of connection vehicle01/edge on vehicle00)",
            f"+ release {TARGET_END} (MQTT target of connection vehicle01/edge on edge)",
            f"~ release {FUSION} (object-fusion on edge for {APP})",
            "    + ego_data /ego",
        ]
        back = demandops("diff", "main", "main~1", "--state-repo", joined.path)
        assert back.out.splitlines()[1] == "    - requester vehicle01"
        assert "- connection vehicle01/edge for vehicle01" in back.out.splitlines()
        assert back.out.splitlines()[-1].startswith(f"- release {TARGET_END} (")

    def test_who_holds_a_topic_no_longer_is_told(
        self, demandops: Run, state: Any, request_json: Run
    ) -> None:
        ego = [("/a", "vehicle00"), ("/b", "vehicle00")]
        link = {"id": "vehicle00/edge", "who": ["vehicle00", "station00"]}
        both = application(who=link["who"], ego=ego, clouds=[])
        request_json(goal([both], [connection(**link, topics=["/a", "/b"])]))
        one = application(who=["vehicle00"], ego=ego[:1], clouds=[])
        leaves = connection(**{**link, "who": ["vehicle00"]}, topics=["/a"])
        request_json(goal([one], [leaves], shutdown=True))
        ran = demandops("diff", "main~1", "main", "--state-repo", state.path)
        assert ran.out.splitlines() == [
            f"~ service {FUSION}",
            "    - ego_data /a for vehicle00",
            "~ connection vehicle00/edge",
            "    - topic /a for vehicle00",
            "no difference in releases",
        ]
        shown = demandops("bookkeeping", "--state-repo", state.path).out
        topics, requesters = "/a (station00), /b", "station00, vehicle00"
        assert [cells[-2:] for cells in cells_of(shown) if topics in cells] == [
            [topics, requesters],
            [topics, requesters],
        ]

    def test_the_json_tells_the_same(self, demandops: Run, joined: Any) -> None:
        ran = demandops("diff", "main~1", "main", "--state-repo", joined.path, "--output", "json")
        found = ran.json()
        assert found.keys() == {"bookkeeping", "releases", "other_files"}
        *services, made = found["bookkeeping"]
        assert [each["name"] for each in services] == ["od-edge-vehicle00", FUSION]
        assert made == {
            "kind": "connection",
            "name": "vehicle00/edge",
            "change": "added",
            "requesters": ["vehicle00"],
            "lost": [],
            "gained": [],
        }

    def test_no_difference(self, demandops: Run, joined: Any) -> None:
        ran = demandops("diff", "main", "main", "--state-repo", joined.path)
        assert (ran.code, ran.out) == (
            0,
            "no difference in bookkeeping\nno difference in releases\n",
        )


class TestVerify:
    def test_every_commit_of_the_experiment_holds(self, demandops: Run, state: Any) -> None:
        first = state.tip
        demandops("request", *EXPERIMENT, "--state-repo", state.path)
        ran = demandops("verify", f"{first}..main", "--state-repo", state.path)
        assert (ran.code, ran.err) == (0, "")
        assert ran.out.splitlines()[-1] == "8 of 8 commits are verified"
        rows = demandops(
            "verify", f"{first}..main", "--state-repo", state.path, "--output", "json"
        ).json()
        assert [row["holds"] for row in rows] == [True] * 8
        assert [row["commit"] for row in rows] == log_of(demandops, state)[:8][::-1]

    def test_what_was_tampered_with_does_not_hold(self, demandops: Run, joined: Any) -> None:
        (path,) = (path for path in joined.manifests() if "/od-" in path)
        changed = {path: joined.files()[path] + "# changed\n"}
        joined.commit(changed, "Forged\n\nOperation: join\nRender-Version: 2\n", FORGER)
        ran = demandops("verify", "--state-repo", joined.path)
        assert ran.code == 1
        assert ran.out.splitlines() == [
            f"{joined.tip[:10]} DIFFERS  Forged",
            f"    {path}",
            "0 of 1 commits are verified",
        ]
        (row,) = demandops("verify", "--state-repo", joined.path, "--output", "json").json()
        assert row == {
            "commit": joined.tip,
            "summary": "Forged",
            "holds": False,
            "skipped": None,
            "faults": [],
            "differing": [path],
            "touched": [],
            "signed": False,
            "signer": None,
            "signature": None,
        }

    def test_a_commit_of_a_person_is_skipped(self, demandops: Run, joined: Any) -> None:
        joined.commit({"inventory/README.md": "hello\n"})
        ran = demandops("verify", "--state-repo", joined.path)
        assert ran.code == 0
        assert ran.out.startswith(f"{joined.tip[:10]} skipped (made by a person)  By hand\n")


class TestStateRepo:
    """An option or the environment names the state repo; a wrong name is refused with a remedy."""

    def test_it_may_be_named_by_the_environment(
        self, demandops: Run, state: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        for command in ("bookkeeping", "log", "diff main main", "verify", "request -"):
            ran = demandops(*command.split(), stdin=text(perception()))
            assert (ran.code, ran.out) == (2, "")
            assert "--state-repo" in ran.err
        monkeypatch.setenv("DEMANDOPS_STATE_REPO", str(state.path))
        for command in ("bookkeeping", "request -"):
            assert demandops(*command.split(), stdin=text(perception())).code == 0

    def test_one_that_is_checked_out_is_not_written(self, demandops: Run, checkout: Path) -> None:
        for command in ("request -", "decommission edge", "rollback main -m why"):
            where = ("--state-repo", checkout)
            assert demandops(*command.split(), *where, stdin=text(perception())) == (
                1,
                "",
                f"error: {checkout} has 'main' checked out, so its files would become outdated; "
                f"use a bare clone: git clone --bare {checkout} {checkout}.git\n",
            )

    @pytest.mark.parametrize("command", ["bookkeeping", "request -"])
    def test_a_password_in_its_address_is_refused_and_not_shown(
        self, demandops: Run, data_home: Path, command: str
    ) -> None:
        url = "https://somebody:hunter2@127.0.0.1:1/x.git?hunter2"
        ran = demandops("-v", *command.split(), "--state-repo", url, stdin=text(perception()))
        assert (ran.code, ran.out) == (1, "")
        assert ran.err.startswith(
            "error: the state repo's address holds a password or token, which "
        )
        assert "hunter2" not in ran.err
        for path in data_home.rglob("*"):
            assert "hunter2" not in path.name
            assert not path.is_file() or "hunter2" not in path.read_text()

    def test_a_repository_of_something_else_is_told(self, demandops: Run, tmp_path: Path) -> None:
        folder = tmp_path / "other.git"
        repo = pygit2.init_repository(str(folder), bare=True, initial_head="main")
        who = pygit2.Signature("A person", "person@example.org", 1_770_000_000, 0)
        tree = repo.TreeBuilder().write()
        repo.create_commit("refs/heads/main", who, who, "Empty\n", tree, [])
        for command in (["bookkeeping"], ["request", "-"]):
            ran = demandops(*command, "--state-repo", folder, stdin=text(perception()))
            assert (ran.code, ran.out) == (1, "")
            assert ran.err == (
                "error: this is not a state repo, because it has no demandops.yaml; if the file "
                "was deleted, restore it; `demandops init DIR` makes a new state repo\n"
            )

    def test_a_newer_generators_state_repo_is_refused(self, demandops: Run, state: Any) -> None:
        root = state.files()["demandops.yaml"].replace("renderVersion: 2", "renderVersion: 99")
        newer = ("DemandOps generator", "generator@demandops.invalid", 1_770_000_000)
        state.commit({"demandops.yaml": root}, "Newer\n\nRender-Version: 99\n", newer)
        before = state.tip
        ran = demandops("request", "-", "--state-repo", state.path, stdin=text(perception()))
        assert (ran.code, state.tip) == (1, before)
        assert "update the generator" in ran.err

    def test_a_data_folder_that_cannot_be_made_is_the_users_to_mend(
        self, demandops: Run, state: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "file").write_text("")
        monkeypatch.setenv("DEMANDOPS_DATA_HOME", str(tmp_path / "file" / "home"))
        ran = demandops("request", "-", "--state-repo", state.path, stdin=text(perception()))
        assert (ran.code, ran.out) == (1, "")
        assert str(tmp_path / "file") in ran.err


class TestUsage:
    @pytest.mark.parametrize(
        "args",
        [
            ["nonsense"],
            ["request"],
            ["init"],
            ["init", "x", "--gitops", "helm"],
            ["diff", "main"],
            ["log", "-n", "0"],
            ["log", "-n", "many"],
            ["bookkeeping", "--output", "xml"],
            ["--nonsense"],
            ["verify", "a", "b"],
        ],
        ids=" ".join,
    )
    def test_wrong_usage_is_told(
        self, demandops: Run, state: Any, monkeypatch: pytest.MonkeyPatch, args: list[str]
    ) -> None:
        monkeypatch.setenv("DEMANDOPS_STATE_REPO", str(state.path))
        ran = demandops(*args)
        assert (ran.code, ran.out) == (2, "")
        assert ran.err.startswith("Usage: demandops ")

    def test_the_version_and_the_help(self, demandops: Run) -> None:
        assert demandops("--version").out == f"demandops, version {__version__}\n"
        for args in ([], ["init"], ["request"], ["bookkeeping"], ["log"], ["diff"], ["check"]):
            ran = demandops(*args, "--help")
            assert ran.code == 0
            assert ran.out.startswith("Usage: demandops")

    def test_a_fault_of_the_program_has_a_code_of_its_own(
        self, demandops: Run, state: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def broken(*args: object) -> None:
            raise RuntimeError("boom")

        monkeypatch.setattr(bookkeeping, "derive", broken)
        ran = demandops("bookkeeping", "--state-repo", state.path)
        assert (ran.code, ran.out) == (3, "")
        assert ran.err == (
            "error: a fault of demandops itself: RuntimeError: boom\n"
            "please report this error, and what the same command prints with -v: `demandops -v …`\n"
        )

    def test_the_process_ends_with_the_code(self, state: Any, data_home: Path) -> None:
        command = [sys.executable, "-m", "demandops.cli.main", "request", "-", "--output", "json"]
        ran = subprocess.run(
            [*command, "--state-repo", str(state.path)],
            input=text(perception(id="1"), goal(id="2")),
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert ran.returncode == 1
        assert [row["outcome"] for row in json.loads(ran.stdout)] == ["booked", "refused"]
        assert ran.stderr == ""


def test_a_command_in_a_hook_works_on_the_state_repo_and_not_on_the_hooks_repo(
    bare: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    git(tmp_path, "init", "--quiet", str(other))
    before = (other / ".git" / "config").read_text()
    done = subprocess.run(
        [sys.executable, "-m", "demandops.cli.main", "get", "nodes", "--state-repo", bare.as_uri()],
        env=os.environ
        | {"GIT_DIR": f"{other}/.git", "GIT_INDEX_FILE": "index", "GIT_QUARANTINE_PATH": "x"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout[:4]) == (0, "NODE"), done.stderr
    assert (other / ".git" / "config").read_text() == before


def test_a_machine_without_git_is_told_what_to_install(bare: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "demandops.cli.main", "get", "nodes", "--state-repo", str(bare)],
        env=os.environ | {"PATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    message = "get needs git, which is not installed; install it (Debian: apt-get install git)"
    assert (done.returncode, done.stderr) == (1, f"error: {message}\n")


def test_a_clone_has_the_state_repos_kind_of_ids_whatever_the_users_default_is(
    bare: Path, monkeypatch: pytest.MonkeyPatch, demandops: Run
) -> None:
    monkeypatch.setenv("GIT_DEFAULT_HASH", "sha256")
    assert demandops("get", "nodes", "--state-repo", bare.as_uri()).code == 0
