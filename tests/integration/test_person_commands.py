"""Commands that a person runs in their own name, such as `override`, `suspend` and `approve`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from demandops.base import naming
from demandops.cli.actions.override import name_of

from tests.kit.cli import Ran, Run
from tests.kit.dialogue import CTRL_C, Dialogue
from tests.kit.generator import running, wait_until
from tests.kit.goals import APP, perception
from tests.kit.repo import GitRepo, Person, branches, git

pytestmark = pytest.mark.usefixtures("git_environment")


@pytest.fixture
def joined(request_json: Callable[..., Ran], state: GitRepo) -> GitRepo:
    """A state repo with one demand, by vehicle00."""
    assert request_json(perception()).code == 0
    return state


@pytest.fixture(params=["folder", "url"])
def where(request: pytest.FixtureRequest, joined: GitRepo) -> tuple[str, str]:
    """The option that names the state repo. Each test runs twice: with the path and with a URL."""
    address = str(joined.path) if request.param == "folder" else joined.path.as_uri()
    return "--state-repo", address


def carried_out(state: GitRepo) -> None:
    """Run a generator until it has followed what people committed."""
    made = state.tip
    with running(state.path, fetch_interval=0.05):
        wait_until(lambda: state.tip != made, "the generator follows")


class TestOverride:
    def test_one_is_created_and_ended_in_ones_own_name(
        self, demandops: Run, joined: GitRepo, where: tuple[str, str]
    ) -> None:
        options = ("--service", "object-fusion", "--replicas", "0", "-m", "Measured\nwithout it")
        ran = demandops("override", "create", "idle", *options, *where)
        assert (ran.code, ran.err) == (
            0,
            "Create override idle (overrides/idle.yaml)\n"
            "  affects of-edge-object-detection-fusion-cf7e0180a8bb (object-fusion on edge for "
            f"{APP})\n",
        )
        assert f"Create override idle: commit {joined.tip} on main" in ran.out
        assert git(joined, "log", "-1", "--format=%an <%ae>|%cn|%s|%b") == (
            "Petra Platform <petra@example.org>|Petra Platform|Create override idle|"
            "Measured without it\n"
        )
        assert yaml.safe_load(joined.files()["overrides/idle.yaml"]) == {
            "apiVersion": "demandops/v1",
            "kind": "Override",
            "reason": "Measured without it",
            "owner": "Petra Platform",
            "select": [{"services": ["object-fusion"]}],
            "replicas": 0,
        }
        again = demandops("override", "create", "idle", *options, *where)
        assert again.err.endswith(
            "error: overrides/idle.yaml: exists already; end it first, or choose another name\n"
        )
        ended = demandops("override", "end", "idle", "-m", "Done", *where, "-o", "json").json()
        assert (ended["outcome"], ended["commit"]) == ("committed", joined.tip)
        assert "overrides/idle.yaml" not in joined.files()
        typo = demandops("override", "end", "idel", *where)
        assert typo.err == "error: there is no override 'idel'\n"

    def test_one_that_was_never_valid_is_not_said_to_be_missing(
        self, demandops: Run, joined: GitRepo, where: tuple[str, str]
    ) -> None:
        joined.commit({"overrides/idle.yaml": "kind: Override\n"})
        ran = demandops("override", "end", "idle", *where)
        assert (ran.code, ran.err) == (
            1,
            "error: overrides/idle.yaml: is not valid, so nothing is overridden; correct or remove "
            "the file with git\n",
        )

    def test_a_dry_run_changes_nothing(
        self, demandops: Run, joined: GitRepo, where: tuple[str, str]
    ) -> None:
        before = joined.tip
        options = ("--node", "cloud", "--hold", "-m", "why", "--expires", "2h", "--dry-run")
        ran = demandops("override", "create", "calm", *options, *where)
        assert (ran.code, joined.tip) == (0, before)
        assert "calm.yaml has no effect on anything that is demanded now\n" in ran.err
        assert "    hold: true\n" in ran.out

    def test_who_is_unknown_to_git_is_told_how_to_change_that(
        self, demandops: Run, joined: GitRepo, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        for name in ("GIT_AUTHOR_NAME", "GIT_AUTHOR_EMAIL"):
            monkeypatch.delenv(name)
        ran = demandops(
            "override",
            "create",
            "calm",
            "--node",
            "edge",
            "--hold",
            "-m",
            "x",
            "--state-repo",
            joined.path,
        )
        assert ran.code == 0
        assert "warning: git does not know who you are, so the commit's author is " in ran.err
        assert 'git config --global user.name "Your Name"' in ran.err

    def test_it_may_be_proposed(
        self, demandops: Run, joined: GitRepo, where: tuple[str, str], person: Person
    ) -> None:
        before = joined.tip
        options = ("--node", "edge", "--hold", "-m", "Demonstration", "--propose")
        ran = demandops("override", "create", "calm", *options, *where, "-o", "json").json()
        assert (ran["outcome"], ran["branch"], joined.tip) == ("proposed", "override/calm", before)
        assert git(joined, "rev-parse", "override/calm") == ran["commit"]
        again = demandops("override", "create", "calm", *options, *where)
        assert again.err.splitlines()[-1] == (
            "error: the branch override/calm exists already; merge or delete it first"
        )
        person.merge("override/calm")
        assert demandops("get", "overrides", *where, "-o", "name").out == "calm\n"

    def test_an_invalid_override_is_refused_and_nothing_committed(
        self, demandops: Run, joined: GitRepo
    ) -> None:
        before, where = joined.tip, ("--state-repo", joined.path)
        for options, told in (
            ((), "give the reason: -m TEXT"),
            (("-m", "why"), "select what the override applies to, for example --node edge"),
            (("-m", "why", "--node", "edge"), "has no effect; give at least one of values"),
            (("-m", "why", "--node", "edge", "--hold", "--deny"), "with 'deny', nothing runs"),
            (("-m", "why", "--node", "edge", "--hold", "--expires", "soon"), "'soon' is not a"),
        ):
            ran = demandops("override", "create", "calm", *options, *where)
            assert ran.code != 0
            assert told in ran.err
        assert joined.tip == before

    def test_somebody_elses_mistake_does_not_prevent_it(
        self, demandops: Run, joined: GitRepo
    ) -> None:
        joined.commit({"overrides/wrong.yaml": "kind: nothing\n"})
        options = ("--requester", "vehicle00", "-m", "why", "--state-repo", joined.path)
        ran = demandops("suspend", *options)
        assert ran.code == 0, ran.err


class TestSuspend:
    def test_suspended_demands_run_again_after_a_resume(
        self, demandops: Run, joined: GitRepo, where: tuple[str, str]
    ) -> None:
        files = joined.manifests()
        assert demandops("suspend", "--requester", "vehicle00", "-m", "Sold", *where).code == 0
        carried_out(joined)
        assert len(joined.manifests()) < len(files)
        (demand,) = demandops("get", "demands", *where, "-o", "json").json()["items"]
        assert demand["state"] == "suspended"
        assert demandops("resume", "--requester", "vehicle00", *where).code == 0
        carried_out(joined)
        assert joined.manifests() == files

    def test_a_resume_ends_no_suspension_of_another_selection_with_the_same_name(
        self, demandops: Run, joined: GitRepo, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(naming, "MOST_DIGITS", 1)
        where, name = ("--state-repo", joined.path), name_of({"requesters": ("vehicle00",)})
        patterns = ("vehicle00" + "*" * number for number in range(100))
        rival = next(one for one in patterns if name_of({"nodes": (one,)}) == name)
        assert demandops("suspend", "--requester", "vehicle00", "-m", "Sold", *where).code == 0
        before = joined.tip
        assert demandops("suspend", "--node", rival, "-m", "Sold", *where).code != 0
        assert demandops("resume", "--node", rival, *where).code != 0
        assert joined.tip == before
        assert demandops("resume", "--requester", "vehicle00", *where).code == 0

    def test_a_lock_that_a_killed_program_left_is_told_with_the_remedy(
        self, demandops: Run, joined: GitRepo
    ) -> None:
        lock, before = joined.path / "refs/heads/main.lock", joined.tip
        lock.write_text("")
        command = ("suspend", "--requester", "vehicle00", "-m", "Sold", "--state-repo", joined.path)
        ran = demandops(*command)
        assert (ran.code, joined.tip) == (1, before)
        assert ran.err.splitlines()[-1] == (
            f"error: another program locks main of {joined.path}, so nothing was changed; try "
            "again; if no program writes there, remove refs/heads/main.lock in it"
        )
        lock.unlink()
        assert demandops(*command).code == 0

    def test_a_suspended_demand_that_is_sent_again_is_told(
        self, demandops: Run, joined: GitRepo, where: tuple[str, str]
    ) -> None:
        assert demandops("suspend", "--application", APP, "-m", "Sold", *where).code == 0
        ran = demandops("request", "-", *where, stdin=yaml.safe_dump(perception()))
        assert "suspend-edge-object-detection-fusion" in ran.out + ran.err


class TestProposals:
    @pytest.fixture
    def proposed(self, demandops: Run, state: GitRepo, person: Person) -> str:
        person.policy(approval="required")
        goal = yaml.safe_dump(perception(id="visit"))
        assert demandops("request", "-", "--state-repo", state.path, stdin=goal).code == 0
        (branch,) = branches(state.path)
        return branch

    @pytest.mark.parametrize("scheme", ["", "file://"])
    def test_one_is_approved_in_ones_own_name(
        self, demandops: Run, state: GitRepo, proposed: str, scheme: str
    ) -> None:
        where = ("--state-repo", f"{scheme}{state.path}")
        assert demandops("approve", "nothing", "--commit", "0" * 40, *where).err == (
            f"error: no proposal fits 'nothing'; known: {proposed}\n"
        )
        commit = ("--commit", git(state, "rev-parse", proposed))
        ran = demandops("approve", "visit", "-m", "Agreed #1", *commit, *where)
        assert ran.code == 0, ran.err
        assert ran.out == f"approved: {proposed} is merged in {state.tip}\n"
        assert git(state, "log", "-1", "--format=%an|%b") == "Petra Platform|Agreed #1\n"
        assert git(state, "rev-parse", "main^2") == git(state, "rev-parse", proposed)
        with running(state.path, fetch_interval=0.05):
            wait_until(lambda: not branches(state.path), "the generator removes the branch")
        (demand,) = demandops("get", "demands", *where, "-o", "json").json()["items"]
        assert demand["requests"] == ["visit"]
        assert demandops("verify", "main~1..main", *where).code == 0

    def test_one_that_no_longer_fits_is_left_to_the_generator(
        self, demandops: Run, state: GitRepo, proposed: str
    ) -> None:
        path = git(state, "diff", "--name-only", "main", proposed, "--", "ledger").split("\n")[0]
        state.commit({path: "mine\n"})
        before = state.tip
        commit = ("--commit", git(state, "rev-parse", proposed))
        ran = demandops("approve", "visit", *commit, "--state-repo", state.path)
        assert (ran.code, state.tip) == (1, before)
        assert "wait until a running generator has made the branch anew, then try again" in ran.err

    @pytest.mark.parametrize("scheme", ["", "file://"])
    def test_one_is_turned_down(
        self, demandops: Run, state: GitRepo, proposed: str, scheme: str
    ) -> None:
        before, where = state.tip, ("--state-repo", f"{scheme}{state.path}")
        ran = demandops("reject", proposed, *where)
        assert (ran.code, ran.out) == (0, f"turned down: {proposed} is deleted\n")
        assert (branches(state.path), state.tip) == ([], before)
        assert demandops("get", "proposals", *where).out == "no proposals\n"


@pytest.mark.parametrize(
    "command",
    [
        "decommission vehicle00 -m Sold",
        pytest.param("rollback main~1 --drop-newer -m Wrong", marks=pytest.mark.nightly),
    ],
)
def test_a_person_sees_the_consequence_and_is_asked(joined: GitRepo, command: str) -> None:
    before, asked = joined.tip, (*command.split(), "--state-repo", joined.path)
    for typed, code in (("n\n", 1), (CTRL_C, 130)):
        with Dialogue(*asked) as doubting:
            doubting.read_until("Continue? [y/N]:")
            assert "vehicle00/edge" in doubting.text
            doubting.type(typed)
            assert (doubting.end(), joined.tip) == (code, before)
    assert doubting.text.endswith("^C\ninterrupted\n")
    with Dialogue(*asked) as sure:
        sure.read_until("Continue? [y/N]:")
        sure.type("y\n")
        assert (sure.end(), git(joined, "rev-parse", "main~1")) == (0, before)
    assert f"Reason: {command.rsplit(maxsplit=1)[-1]}" in git(joined, "log", "-1", "--format=%b")


def test_a_script_is_not_asked(demandops: Run, joined: GitRepo, tmp_path: Path) -> None:
    ran = demandops("decommission", "vehicle00", "--state-repo", joined.path)
    assert ran.code == 0
    assert "is decommissioned in" in ran.out


def test_a_fleet_is_watched_live(demandops: Run, joined: GitRepo) -> None:
    with Dialogue("watch", "--state-repo", joined.path) as watching:
        watching.read_until("Join ")
        joined.commit({"inventory/README.md": "hello\n"}, "A note on the fleet\n")
        watching.read_until("A note on the fleet")
        valid = joined.files()["inventory/nodes.yaml"]
        joined.commit({"inventory/nodes.yaml": "nodez: []\n"}, "A slip\n")
        watching.read_until("not well, last valid state: inventory/nodes.yaml: ")
        joined.commit({"inventory/nodes.yaml": valid}, "Mended\n")
        watching.read_until("Mended")
        watching.type(CTRL_C)
        assert watching.end() == 0
    ran = demandops("watch", "--state-repo", joined.path)
    assert ran.code == 2
    assert "watch needs a terminal; use `demandops get KIND --watch` instead" in ran.err
