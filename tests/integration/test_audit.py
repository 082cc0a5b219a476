"""The program and plain git tell an auditor what ran when, for whom, and who booked it."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from demandops.cli.main import run as run_command
from demandops.model.config.override import format_time
from demandops.model.ledger.claim_file import read

from tests.kit.goals import APP, EXPERIMENT, application, connection, goal, perception, put
from tests.kit.golden import GOLDEN, requests_of
from tests.kit.repo import FORGER, git

Run = Callable[..., Any]

ROOT = Path(__file__).parents[2]
DETECTION = "od-edge-vehicle00"
FUSION = "of-edge-object-detection-fusion-cf7e0180a8bb"
PATH = f"clusters/c-its/perception/edge/{DETECTION}.yaml"


@pytest.fixture(scope="session")
def _played(bare_template: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A state repo after six steps of the experiment: four vehicles joined, two of them left."""
    folder = Path(shutil.copytree(bare_template, tmp_path_factory.mktemp("played") / "state.git"))
    assert run_command(["request", *map(str, EXPERIMENT[:6]), "--state-repo", str(folder)]) == 0
    git(folder, "repack", "-adq")
    return folder


@pytest.fixture
def played(_played: Path, state: Any) -> Any:
    shutil.rmtree(state.path)
    shutil.copytree(_played, state.path)
    return state


@pytest.fixture
def ask(demandops: Run, state: Any) -> Run:
    """Return a function that runs a command with JSON output and returns the data."""

    def call(*args: str) -> Any:
        ran = demandops(*args, "--state-repo", state.path, "--output", "json")
        assert (ran.code, ran.err) == (0, "")
        return ran.json()

    return call


def test_git_finds_commits_as_the_docs_say(played: Any) -> None:
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


class TestWhy:
    def test_a_release_that_runs(self, ask: Run, played: Any) -> None:
        found = ask("why", FUSION)
        assert (found["runs"], found["kind"], found["commit"]) == (True, "release", played.tip)
        assert (found["node"], found["cluster"]) == ("edge", "c-its")
        assert (found["namespace"], found["domain"]) == ("perception", "perception")
        assert found["file"] == f"clusters/c-its/perception/edge/{FUSION}.yaml"
        assert found["requesters"] == ["station00", "vehicle02", "vehicle03"]
        files = played.files("ledger/")
        for claim in found["claims"]:
            booked = read(files[claim["file"]], claim["file"])
            assert claim["requesters"] == list(booked.requesters)
            assert claim["demand"] == booked.demand
            assert claim["since"] == format_time(booked.booked)
            assert claim["release_by"] == (
                f"send request '{booked.request}' again with shutdown: true"
            )
        assert len(found["claims"]) == 2
        shaping = {one["file"]: one for one in found["shaped_by"]}
        assert set(shaping) == {
            "demandops.yaml",
            "appdefs/object-detection-fusion/appdef.yaml",
            "appdefs/object-detection-fusion/values/object-fusion.yaml.j2",
            "registry/charts.yaml",
            "registry/images.yaml",
            "inventory/nodes.yaml",
            "policy/access-domains.yaml",
        }
        assert set(shaping) <= set(played.files())
        assert shaping["registry/charts.yaml"]["what"].startswith("version 0.1.0 from folder ")
        assert found["overrides"] == []

    def test_its_commits_are_those_that_git_tells(self, ask: Run, played: Any) -> None:
        found = ask("why", FUSION)
        said = git(played, "log", "--format=%H", "main", "--", found["file"]).splitlines()
        assert [one["commit"] for one in [*found["changes"], found["started"]]] == said
        assert (found["stopped"], found["more_changes"]) == (None, 0)
        assert found["started"]["author"] == "vehicle00, station00 (requesters)"
        bounded = ask("why", FUSION, "-n", "1")
        assert [one["commit"] for one in bounded["changes"]] == said[:1]
        assert bounded["more_changes"] == len(said) - 2
        assert bounded["started"]["commit"] == said[-1]

    def test_a_release_that_stopped(self, ask: Run, played: Any) -> None:
        found = ask("why", DETECTION)
        stopped, started = git(played, "log", "--format=%H", "main", "--", PATH).splitlines()
        assert (found["runs"], found["file"]) == (False, PATH)
        assert (found["stopped"]["commit"], found["started"]["commit"]) == (stopped, started)
        assert found["stopped"]["operation"] == "shutdown"
        assert found["stopped"]["why"].endswith("in the name of vehicle00, station00.")
        assert ask("why", PATH)["stopped"] == found["stopped"]
        assert ask("why", DETECTION[:-1])["name"] == DETECTION

    def test_what_ran_before(self, ask: Run, played: Any) -> None:
        found = ask("why", DETECTION, "--at", "main~2")
        assert found["runs"]
        assert found["requesters"] == ["station00", "vehicle00"]

    def test_a_connection_and_an_application(self, ask: Run, played: Any) -> None:
        found = ask("why", "vehicle02/edge")
        assert (found["kind"], found["runs"]) == ("connection", True)
        assert {one["node"] for one in found["releases"]} == {"vehicle02", "edge"}
        assert ask("why", APP)["requesters"] == ["station00", "vehicle02", "vehicle03"]
        gone = ask("why", "vehicle00/edge")
        assert (gone["kind"], gone["runs"]) == ("connection", False)
        assert gone["stopped"]["requesters"] == ["vehicle00", "station00"]

    def test_an_application_definition_a_requester_and_an_override(
        self, ask: Run, played: Any, demandops: Run
    ) -> None:
        found = ask("why", "object-detection-fusion")
        assert (found["kind"], found["runs"]) == ("appdef", True)
        assert found["file"] == "appdefs/object-detection-fusion/appdef.yaml"
        assert FUSION in [one["name"] for one in found["releases"]]
        assert {one["subject"]["id"] for one in found["claims"]} == {APP}
        found = ask("why", "vehicle02", "--kind", "requester")
        assert found["runs"]
        assert {who for one in found["claims"] for who in one["requesters"]} >= {"vehicle02"}
        select = ["--service", "object-fusion", "--replicas", "0", "-m", "a test"]
        where = ("--state-repo", played.path)
        assert demandops("override", "create", "quiet", *select, *where).code == 0
        found = ask("why", "quiet")
        assert (found["kind"], found["file"]) == ("override", "overrides/quiet.yaml")
        assert [one["name"] for one in found["releases"]] == [FUSION]
        out = demandops("why", "quiet", *where).out
        assert out.startswith(f"override quiet is not rendered yet at {played.tip[:10]}\n")

    def test_a_claim_by_its_file(self, ask: Run, played: Any) -> None:
        path = next(p for p in played.files("ledger/connections/"))
        found = ask("why", path)
        assert (found["kind"], found["file"], found["runs"]) == ("claim", path, True)
        played.commit({path: None}, "Nobody needs it\n")
        gone = ask("why", path)
        assert (gone["runs"], gone["stopped"]["author"]) == (False, "A person")

    @pytest.mark.parametrize("case", ["zenoh", "ros"])
    def test_every_release_of_other_carriers(
        self, demandops: Run, ask: Run, state: Any, case: str
    ) -> None:
        overlay = GOLDEN / case / "state-repo"
        state.commit(
            {
                file.relative_to(overlay).as_posix(): file.read_text()
                for file in overlay.rglob("*")
                if file.is_file()
            }
        )
        assert demandops("request", requests_of(case)[0], "--state-repo", state.path).code == 0
        clients = [path for path in state.manifests() if "/_" not in path]
        assert clients
        for path in clients:
            found = ask("why", path.rsplit("/", 1)[-1].removesuffix(".yaml"))
            assert (found["runs"], found["file"]) == (True, path)
            assert found["claims"]
            assert {claim["file"] for claim in found["claims"]} <= set(state.files("ledger/"))
            assert found["started"]["operation"] == "join"

    def test_what_a_person_changed_is_named(self, ask: Run, played: Any, request_json: Run) -> None:
        images = played.files()["registry/images.yaml"].replace("2025-04", "2025-05")
        by_hand = played.commit({"registry/images.yaml": images}, "Newer images\n")
        request_json(goal([], [connection("another")]))
        change = ask("why", FUSION)["changes"][0]
        assert change["operation"] == "follow"
        (behind,) = change["carries_out"]
        told = (behind["commit"], behind["author"], behind["summary"])
        assert told == (by_hand, "A person", "Newer images")
        assert behind == ask("log", "--operation", "by-hand", "-n", "1")[0]

    def test_an_application_and_a_connection_of_one_id(
        self, demandops: Run, ask: Run, state: Any, request_json: Run
    ) -> None:
        request_json(goal([application("twin")], [connection("twin")]))
        ran = demandops("why", "twin", "--state-repo", state.path)
        assert (ran.code, ran.out) == (1, "")
        assert ran.err == (
            "error: 'twin' names several things: application, connection; choose one with --kind\n"
        )
        assert ask("why", "twin", "--kind", "connection")["kind"] == "connection"

    def test_a_near_miss(self, demandops: Run, played: Any) -> None:
        for name, hint in (
            ("od-edge-vehicle09", DETECTION),  # it ran once
            ("vehicle02/edgy", "vehicle02/edge"),
            (f"{FUSION[:-1]}x", FUSION),
            ("fuson", "fusion"),  # part of a release's name is enough
        ):
            at = f"up to commit {played.tip[:10]}"
            told = f"error: nothing called '{name}' runs or ran {at}; did you mean '{hint}'?\n"
            assert demandops("why", name, "--state-repo", played.path) == (1, "", told)

    def test_a_name_of_another_kind(self, demandops: Run, played: Any) -> None:
        for name, remedy in (
            (FUSION, "leave out --kind"),
            ("fusion", "leave out --kind"),
            ("cloudd", "did you mean 'cloud'?"),
        ):
            ran = demandops("why", name, "--kind", "node", "--state-repo", played.path)
            told = f"error: no node is called '{name}'; {remedy}\n"
            assert (ran.code, ran.err) == (1, told)

    def test_a_demand_in_a_history_that_was_made_anew(
        self, demandops: Run, request_json: Run, state: Any, tmp_path: Any
    ) -> None:
        request_json(put("patrol-7"))
        git(state, "branch", "anew", git(state, "commit-tree", "-m", "All", "main^{tree}"))
        git(tmp_path, "clone", "--quiet", "--bare", "--single-branch", "--branch", "anew",
            str(state.path), "anew.git")  # fmt: skip
        git(tmp_path / "anew.git", "branch", "-m", "anew", "main")
        ran = demandops("why", "patrol-7", "--state-repo", tmp_path / "anew.git")
        assert (ran.code, ran.err) == (0, "")
        assert ran.out.startswith("demand patrol-7 holds claims at ")

    def test_rubbish(self, demandops: Run, played: Any) -> None:
        for name in ("", "-", "..", "*", ":(glob)**", "clusters/", "clusters/../x", "ledger//x",
                     "\x1b[1m"):  # fmt: skip
            ran = demandops("why", "--state-repo", played.path, "--", name)
            assert ran.code in (0, 1)
            assert "\x1b" not in ran.err

    def test_a_file_that_people_broke_is_told_and_does_not_hide_the_answer(
        self, demandops: Run, played: Any
    ) -> None:
        played.commit({"inventory/nodes.yaml": "nodes: [\n"})
        ran = demandops("why", FUSION, "--state-repo", played.path)
        assert ran.code == 0
        assert ran.err.startswith("warning: inventory/nodes.yaml: ")
        assert ran.out.startswith(f"release {FUSION} runs at ")

    def test_the_text(self, demandops: Run, played: Any) -> None:
        out = demandops("why", DETECTION, "--state-repo", played.path).out.splitlines()
        assert out[0] == f"release {DETECTION} does not run at {played.tip[:10]}"
        assert out[1] == f"  file        {PATH}"
        assert [line for line in out if not line.startswith(" ")][1:] == [
            "stopped by",
            "started by",
        ]


class TestLogFilters:
    def test_what_fits(self, ask: Run, played: Any) -> None:
        for filters, operations in (
            ("--requester vehicle01", ["shutdown", "join"]),
            ("--requester vehicle01 --operation join", ["join"]),
            ("--requester vehicle01 main~6", []),
            ("--connection vehicle03/edge", ["join"]),
            (f"--application {APP} -n 3", ["shutdown", "shutdown", "join"]),
            ("--operation init", ["init"]),
            (f"--release {DETECTION}", ["shutdown", "join"]),
            (f"--release {PATH} main~2", ["join"]),
            (f"--release {DETECTION} main~3..main", ["shutdown"]),
            ("--node vehicle03", ["join"]),
            ("--node vehicle00", ["shutdown", "join"]),
            ("--node cloud", []),
            ("--since 1h --operation shutdown", ["shutdown", "shutdown"]),
            ("--until 2020-01-01", []),
            ("--operation by-hand", []),
        ):
            found = [row["operation"] for row in ask("log", *filters.split())]
            assert found == operations, filters

    def test_by_demand(self, ask: Run, played: Any) -> None:
        rows = ask("log")
        assert [row["commit"] for row in ask("log", "--demand", rows[0]["demands"][0])] == [
            row["commit"] for row in rows if row["demands"] == rows[0]["demands"]
        ]

    def test_a_node_that_only_a_claim_names(self, ask: Run, played: Any, request_json: Run) -> None:
        """The second demand needs what already runs, so its commit changes only the ledger."""
        request_json(perception(id="first"))
        before = played.tip
        request_json(perception(id="second"))
        assert git(played, "diff", "--name-only", before, "main", "--", "clusters") == ""
        assert ask("log", "--node", "vehicle00", f"{before}..main")[0]["request"] == "second"

    def test_no_time_and_nothing_that_fits(self, demandops: Run, played: Any) -> None:
        ran = demandops("log", "--since", "soon", "--state-repo", played.path)
        assert ran.code == 2
        assert "'soon' is not a time; write it like 2026-01-31T14:03" in ran.err
        ran = demandops("log", "--requester", "vehicle01", "main~6", "--state-repo", played.path)
        assert (ran.code, ran.out) == (0, "no commit matches\n")

    def test_what_no_commit_is_about_is_refused(self, demandops: Run, played: Any) -> None:
        options = ("--requester", "vehicle1", "--node", "egde", "--application", "nothing")
        ran = demandops("log", *options, "--state-repo", played.path)
        assert (ran.code, ran.out) == (1, "")
        assert ran.err == (
            "error: --requester: no commit is about 'vehicle1'; did you mean 'vehicle01'?\n"
            f"error: --application: no commit is about 'nothing'; known: {APP}\n"
            "error: --node: there is no node 'egde'; did you mean 'edge'?\n"
        )
        ran = demandops("log", "--operation", "joyn", "--state-repo", played.path)
        assert ran.code == 2
        assert "'joyn' is not one of 'join', 'shutdown'" in ran.err


def test_bookkeeping_at_a_time(ask: Run, played: Any) -> None:
    """The first commit has a date in January; all other commits are made during the test."""
    first = git(played, "rev-list", "--max-parents=0", "main")
    assert ask("bookkeeping", "--at", "2026-01-31")["commit"] == first
    assert ask("bookkeeping", "--at", "1d")["commit"] == first
    assert ask("bookkeeping", "--at", "0s")["commit"] == played.tip


def test_one_thing_has_the_documented_keys_in_every_command(
    ask: Run, played: Any, demandops: Run
) -> None:
    page = (ROOT / "docs" / "json.md").read_text()
    rows = dict(re.findall(r"^\| (\S[^|]*) \| (`[^|]*) \|$", page, re.MULTILINE))
    keys = {thing: re.findall(r"`(\w+)`", names) for thing, names in rows.items()}
    told, changed = ask("why", APP), ask("diff", "main~1", "main")
    back = ask("rollback", "main~1", "--dry-run")
    failed = demandops("log", "nothing", "--state-repo", played.path, "--output", "json")
    assert keys["commit"] == [*ask("log")[0]] == list(told["started"])[:-1]
    assert keys["claim"] == [*back["restored"][0]] == [*told["claims"][0]][:-4]
    assert keys["subject"] == [*told["subject"]] == [*told["claims"][0]["subject"]]
    assert keys["release"] == [*told["releases"][0]] == [*ask("status")["releases"][0]][:-9]
    assert keys["changed release"] == [*changed["releases"][0]] == [*back["releases"][0]]
    assert keys["changed entry of the bookkeeping"] == [*changed["bookkeeping"][0]]
    assert keys["fault"] == [*failed.json()["faults"][0]]


class TestDiff:
    def test_a_newer_image_changes_releases_and_no_books(
        self, ask: Run, played: Any, request_json: Run
    ) -> None:
        images = played.files()["registry/images.yaml"].replace("2025-04", "2025-05")
        played.commit({"registry/images.yaml": images})
        request_json(goal([], [connection("another")]))
        found = ask("diff", "main~2", "main~1")
        assert found["bookkeeping"] == []
        details = {one["name"]: one["details"] for one in found["releases"]}
        assert any("'2025-04' → '2025-05'" in line for line in details[FUSION])

    def test_a_release_that_moved(self, ask: Run, state: Any, request_json: Run) -> None:
        before, after = (put("a", node=node, connect="none") for node in ("edge", "cloud"))
        assert request_json(before, after).code == 0
        found = ask("diff", "main~1", "main")["releases"]
        (moved,) = [one for one in found if one["change"] == "change"]
        assert moved["name"].startswith("of-edge-a-")
        assert moved["file"].startswith("clusters/c-its/perception/cloud/")
        assert any(
            line.startswith("- clusters/c-its/perception/edge/") for line in moved["details"]
        )


class TestRollback:
    def roll(self, demandops: Run, state: Any, *args: str) -> Any:
        return demandops("rollback", *args, "--state-repo", state.path, "--output", "json")

    def test_books_and_files_are_what_they_were(
        self, demandops: Run, ask: Run, played: Any
    ) -> None:
        wanted = git(played, "rev-parse", "main~2:ledger", "main~2:clusters")
        ran = self.roll(demandops, played, "main~2", "-m", "they left\nby mistake")
        found = ran.json()
        assert (ran.code, found["outcome"], found["commit"]) == (0, "restored", played.tip)
        assert git(played, "rev-parse", "main:ledger", "main:clusters") == wanted
        assert (found["dropped"], found["changed_back"]) == ([], [])
        assert {tuple(one["requesters"]) for one in found["restored"]} == {
            ("station00", "vehicle00"),
            ("station00", "vehicle01"),
        }
        assert f"+ {DETECTION}" in git(played, "log", "-1", "--format=%b", "main")
        form = "%(trailers:key=Operation,key=Restores,key=Reason,valueonly,separator=%x2C)"
        said = git(played, "log", "-1", f"--format={form}", "main")
        assert said == f"rollback,{found['to']},they left by mistake"
        assert [row["commit"] for row in ask("log", "--operation", "rollback")] == [played.tip]
        assert demandops("verify", "--state-repo", played.path).code == 0

    def test_who_did_it_is_the_author(self, demandops: Run, played: Any) -> None:
        config = played.path / "config"
        config.write_text(
            config.read_text() + "[user]\n\tname = Ada <A>\n\temail = ada@example.org\n"
        )
        assert self.roll(demandops, played, "main~1", "-m", "why not").code == 0
        assert git(played, "log", "-1", "--format=%an|%ae", "main") == "Ada (A)|ada@example.org"

    def test_a_rollback_past_newer_claims_is_refused_and_lists_them(
        self, demandops: Run, played: Any
    ) -> None:
        before = played.tip
        ran = self.roll(demandops, played, "main~4", "-m", "x")
        found = ran.json()
        assert (ran.code, found["outcome"], played.tip) == (1, "refused", before)
        assert {error["file"] for error in found["faults"]} >= {
            path for path, text in played.files("ledger/").items() if "- vehicle02" in text
        }
        dropping = self.roll(demandops, played, "main~4", "-m", "x", "--drop-newer").json()
        assert {tuple(one["requesters"]) for one in dropping["dropped"]} == {
            ("station00", "vehicle02"),
            ("station00", "vehicle03"),
        }

    def test_a_dry_run_tells_the_same_and_changes_nothing(
        self, demandops: Run, played: Any
    ) -> None:
        before = played.tip
        dry = self.roll(demandops, played, "main~2", "--dry-run").json()
        assert (played.tip, dry["commit"]) == (before, None)
        done = self.roll(demandops, played, "main~2", "-m", "x").json()
        assert {**done, "commit": None} == dry

    def test_what_people_configured_since_stays(
        self, demandops: Run, played: Any, request_json: Run
    ) -> None:
        images = played.files()["registry/images.yaml"].replace("2025-04", "2025-05")
        played.commit({"registry/images.yaml": images})
        ran = demandops("rollback", "main~3", "-m", "x", "--state-repo", played.path)
        assert ran.code == 0
        assert ran.out.splitlines()[-1] == "  registry/images.yaml"
        assert played.files()["registry/images.yaml"] == images
        assert "2025-05" in played.files()[PATH]
        assert demandops("verify", "--state-repo", played.path).code == 0

    def test_it_wants_a_reason_and_something_to_do(self, demandops: Run, played: Any) -> None:
        ran = demandops("rollback", "main", "-m", "x", "--state-repo", played.path)
        assert ran.code == 0
        assert ran.out.endswith("nothing to roll back\n")
        ran = demandops("rollback", "main~1", "-m", "  ", "--state-repo", played.path)
        assert ran.code == 2
        assert "give the reason: -m TEXT" in ran.err

    def test_a_commit_that_is_not_of_this_history(self, demandops: Run, played: Any) -> None:
        git(played, "config", "user.name", "x")
        git(played, "config", "user.email", "x@example.org")
        other = git(played, "commit-tree", "-m", "other", f"{played.tip}^{{tree}}")
        ran = self.roll(demandops, played, other, "-m", "x")
        assert ran.code == 1
        assert ran.json()["faults"][0]["message"] == (
            f"commit {other} is not in the history of the state repo; roll back to one that is"
        )

    def test_no_request_file_rolls_back(self, request_json: Run, played: Any) -> None:
        before = played.tip
        made = {"apiVersion": "demandops/v1", "kind": "Rollback", "to": before,
                "dropNewer": True, "reason": "x", "by": ["x", "x"]}  # fmt: skip
        ran = request_json(made)
        assert (ran.code, played.tip) == (1, before)


class TestVerifyByDifferences:
    """`verify` checks a range of commits by the differences between them."""

    FORGED = "Forged\n\nOperation: join\nDemand-Id: none\nRender-Version: 2\n"

    def verdicts(self, demandops: Run, state: Any) -> dict[str, Any]:
        """Return the rows of `verify` by commit, after a check that `--whole` gives the same."""
        where = ("verify", "main~4..main", "--state-repo", state.path, "--output", "json")
        ran = demandops(*where)
        assert demandops(*where, "--whole") == ran
        rows = {row["commit"]: row for row in ran.json()}
        assert ran.code == (0 if all(row["holds"] for row in rows.values()) else 1)
        return rows

    def surrounded(self, state: Any, request_json: Run, changed: Callable[[], str]) -> str:
        """Book demands before and after `changed` makes a commit; return that commit."""
        request_json(goal([], [connection("before-1")]), goal([], [connection("before-2")]))
        made = changed()
        request_json(goal([], [connection("after")]))
        return made

    def test_a_file_that_should_not_have_been_touched(
        self, demandops: Run, played: Any, request_json: Run
    ) -> None:
        path = f"clusters/c-its/perception/edge/{FUSION}.yaml"
        changed = {path: played.files()[path] + "# changed\n"}
        made = self.surrounded(
            played, request_json, lambda: played.commit(changed, self.FORGED, FORGER)
        )
        rows = self.verdicts(demandops, played)
        assert rows[made]["differing"] == [path]
        assert next(row["commit"] for row in rows.values() if not row["holds"]) == made

    def test_a_file_that_should_have_been_touched(
        self, demandops: Run, played: Any, request_json: Run
    ) -> None:
        """A forged commit removes a claim, but not the files that only this claim needed."""
        path = next(p for p, t in played.files("ledger/connections/").items() if "vehicle02/" in t)
        text = self.FORGED.replace("none", read(played.files()[path], path).demand)
        made = self.surrounded(
            played, request_json, lambda: played.commit({path: None}, text, FORGER)
        )
        rows = self.verdicts(demandops, played)
        assert len(rows[made]["differing"]) == 2
        assert all("vehicle02" in left for left in rows[made]["differing"])
        assert not rows[made]["touched"]

    def test_changed_configuration_holds(
        self, demandops: Run, played: Any, request_json: Run
    ) -> None:
        images = played.files()["registry/images.yaml"].replace("2025-04", "2025-05")
        changed = {"registry/images.yaml": images}
        self.surrounded(played, request_json, lambda: played.commit(changed))
        assert all(row["holds"] for row in self.verdicts(demandops, played).values())

    def test_a_persons_file_that_stood_in_place_of_a_folder_holds(
        self, demandops: Run, played: Any, request_json: Run
    ) -> None:
        def replace() -> str:
            return played.commit({**dict.fromkeys(played.files("ledger/")), "ledger": "a file\n"})

        self.surrounded(played, request_json, replace)
        assert all(row["holds"] for row in self.verdicts(demandops, played).values())

    def test_what_is_not_the_generators_to_write(
        self, demandops: Run, played: Any, request_json: Run
    ) -> None:
        for path in (
            "policy/access-domains.yaml",
            "ledger/connections/00/x-0/y-0.yaml",
            "overrides/a",
        ):
            changed = {path: played.files().get(path, "# nothing\n") + "# more\n"}
            forge = partial(played.commit, changed, self.FORGED, FORGER)
            made = self.surrounded(played, request_json, forge)
            row = self.verdicts(demandops, played)[made]
            assert (row["holds"], row["touched"]) == (False, [path])

    def test_a_claim_that_is_not_written_as_it_should_be(
        self, demandops: Run, played: Any, request_json: Run
    ) -> None:
        path = next(iter(played.files("ledger/connections/")))
        text = played.files()[path]
        message = self.FORGED.replace("none", read(text, path).demand)
        made = self.surrounded(
            played,
            request_json,
            lambda: played.commit({path: text + "# a note\n"}, message, FORGER),
        )
        assert self.verdicts(demandops, played)[made]["touched"] == [path]
