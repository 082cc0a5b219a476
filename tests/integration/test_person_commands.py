"""Commands that a person runs in their own name, such as `override`, `suspend` and `watch`."""

from __future__ import annotations

from typing import Any

import pytest
import yaml
from demandops.base import naming
from demandops.cli.actions.override import name_of

from tests.integration.conftest import On
from tests.kit.cli import Ran, Run
from tests.kit.dialogue import CTRL_C, Dialogue
from tests.kit.generator import running, wait_until
from tests.kit.goals import APP, perception
from tests.kit.repo import GitRepo, Person, git

pytestmark = pytest.mark.usefixtures("git_environment")
IDLE = "overrides/idle.yaml"


@pytest.fixture
def joined(on: On, state: GitRepo) -> GitRepo:
    """A state repo with one demand, by vehicle00."""
    on.book(perception())
    return state


class At(On):
    """Runs commands with ``--state-repo`` and an address, which may be a URL."""

    address: Any

    def __call__(self, *args: Any, stdin: str | bytes = "") -> Ran:
        return self._run(*args, "--state-repo", self.address, stdin=stdin)


@pytest.fixture(params=["folder", "url"])
def at(request: pytest.FixtureRequest, demandops: Run, joined: GitRepo) -> At:
    at = At(demandops, joined)
    at.address = joined.path if request.param == "folder" else joined.path.as_uri()
    return at


def carried_out(state: GitRepo) -> None:
    """Run a generator until it has followed what people committed."""
    made = state.tip
    with running(state.path, fetch_interval=0.05):
        wait_until(lambda: state.tip != made, "the generator follows")


class TestOverride:
    def test_one_is_created_and_ended_in_ones_own_name(self, at: At, joined: GitRepo) -> None:
        create = ("override", "create", "idle", "--service", "object-fusion", "--replicas", "0")
        create += ("-m", "Measured\nwithout it")
        ran = at(*create)
        affected = f"of-edge-object-detection-fusion-cf7e0180a8bb (object-fusion on edge for {APP})"
        told = f"Create override idle ({IDLE})\n  affects {affected}\n"
        assert (ran.code, ran.err) == (0, told)
        assert f"Create override idle: commit {joined.tip} on main" in ran.out
        assert git(joined, "log", "-1", "--format=%an <%ae>|%cn|%s|%b") == (
            "Petra Platform <petra@example.org>|Petra Platform|Create override idle|"
            "Measured without it\n"
        )
        assert yaml.safe_load(joined.files()[IDLE]) == {
            "apiVersion": "demandops/v1",
            "kind": "Override",
            "reason": "Measured without it",
            "owner": "Petra Platform",
            "select": [{"services": ["object-fusion"]}],
            "replicas": 0,
        }
        assert f"error: {IDLE}: exists already; " in at.refused(*create)
        ended = at.json("override", "end", "idle", "-m", "Done")
        assert (ended["outcome"], ended["commit"]) == ("committed", joined.tip)
        assert IDLE not in joined.files()
        assert at.refused("override", "end", "idel") == "error: there is no override 'idel'\n"
        joined.commit({IDLE: "kind: Override\n"})
        told = at.refused("override", "end", "idle")
        assert told.startswith(f"error: {IDLE}: is not valid, so nothing is overridden; ")

    def test_a_dry_run_changes_nothing(self, at: At, joined: GitRepo) -> None:
        before = joined.tip
        options = ("--node", "cloud", "--hold", "-m", "why", "--expires", "2h", "--dry-run")
        ran = at("override", "create", "calm", *options)
        assert (ran.code, joined.tip) == (0, before)
        assert "calm.yaml has no effect on anything that is demanded now\n" in ran.err
        assert "    hold: true\n" in ran.out

    def test_who_is_unknown_to_git_is_told_how_to_change_that(
        self, on: On, joined: GitRepo, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        for name in ("GIT_AUTHOR_NAME", "GIT_AUTHOR_EMAIL"):
            monkeypatch.delenv(name)
        ran = on("override", "create", "calm", "--node", "edge", "--hold", "-m", "x")
        assert ran.code == 0
        assert "warning: git does not know who you are, so the commit's author is " in ran.err
        assert 'git config --global user.name "Your Name"' in ran.err

    def test_it_may_be_proposed(self, at: At, joined: GitRepo, person: Person) -> None:
        before = joined.tip
        propose = ("override", "create", "calm", "--node", "edge", "--hold", "-m", "x", "--propose")
        ran = at(*propose, "-o", "json").json()
        assert (ran["outcome"], ran["branch"], joined.tip) == ("proposed", "override/calm", before)
        assert git(joined, "rev-parse", "override/calm") == ran["commit"]
        assert "error: the branch override/calm exists already; " in at.refused(*propose)
        person.merge("override/calm")
        assert at("get", "overrides", "-o", "name").out == "calm\n"

    def test_an_invalid_override_is_refused_and_nothing_committed(
        self, on: On, joined: GitRepo
    ) -> None:
        before = joined.tip
        for options, told in (
            ("", "give the reason: -m TEXT"),
            ("-m why", "select what the override applies to, for example --node edge"),
            ("-m why --node edge", "has no effect; give at least one of values"),
            ("-m why --node edge --hold --deny", "with 'deny', nothing runs"),
            ("-m why --node edge --hold --expires soon", "'soon' is not a"),
        ):
            ran = on("override", "create", "calm", *options.split())
            assert ran.code != 0 and told in ran.err
        assert joined.tip == before
        joined.commit({"overrides/wrong.yaml": "kind: nothing\n"})  # somebody else's mistake
        assert on("suspend", "--requester", "vehicle00", "-m", "why").code == 0


class TestSuspend:
    SUSPEND = ("suspend", "--requester", "vehicle00", "-m", "Sold")

    def test_suspended_demands_run_again_after_a_resume(self, at: At, joined: GitRepo) -> None:
        files = joined.manifests()
        assert at(*self.SUSPEND).code == 0
        carried_out(joined)
        assert len(joined.manifests()) < len(files)
        (demand,) = at.json("get", "demands")["items"]
        assert demand["state"] == "suspended"
        ran = at("request", "-", stdin=yaml.safe_dump(perception()))
        assert "suspend-vehicle00" in ran.out + ran.err
        assert at("resume", "--requester", "vehicle00").code == 0
        carried_out(joined)
        assert joined.manifests() == files

    def test_a_resume_ends_no_suspension_of_another_selection_with_the_same_name(
        self, on: On, joined: GitRepo, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(naming, "MOST_DIGITS", 1)
        name = name_of({"requesters": ("vehicle00",)})
        patterns = ("vehicle00" + "*" * number for number in range(100))
        rival = next(one for one in patterns if name_of({"nodes": (one,)}) == name)
        assert on(*self.SUSPEND).code == 0
        before = joined.tip
        assert on("suspend", "--node", rival, "-m", "Sold").code != 0
        assert on("resume", "--node", rival).code != 0
        assert joined.tip == before
        assert on("resume", "--requester", "vehicle00").code == 0

    def test_a_lock_that_a_killed_program_left_is_told_with_the_remedy(
        self, on: On, joined: GitRepo
    ) -> None:
        lock = joined.path / "refs/heads/main.lock"
        lock.write_text("")
        told = on.refused(*self.SUSPEND).splitlines()[-1]
        assert "another program locks main of" in told
        assert told.endswith(" if no program writes there, remove refs/heads/main.lock in it")
        lock.unlink()
        assert on(*self.SUSPEND).code == 0


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


def test_a_script_is_not_asked(on: On, joined: GitRepo) -> None:
    assert "is decommissioned in" in on("decommission", "vehicle00").out


def test_a_fleet_is_watched_live(on: On, joined: GitRepo) -> None:
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
    assert "watch needs a terminal; use `demandops get KIND --watch`" in on.refused("watch", code=2)
