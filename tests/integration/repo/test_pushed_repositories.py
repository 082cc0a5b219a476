"""A state repo on this disk with hooks or settings of its own is left as by `git push`."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.kit import rig
from tests.kit.cli import Run
from tests.kit.goals import EXPERIMENT
from tests.kit.repo import Person, git, tip


@pytest.fixture(params=[0o077, 0o022])
def mask(request: pytest.FixtureRequest) -> Iterator[int]:
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


@pytest.mark.parametrize(
    ("shared", "file", "folder"),
    [("group", 0o440, 0o770), ("world", 0o444, 0o775), ("0640", 0o440, 0o750)],
)
def test_a_shared_repository_stays_shared(
    bare: Path, demandops: Run, mask: int, person: Person, shared: str, file: int, folder: int
) -> None:
    git(bare, "config", "core.sharedRepository", shared)
    git(bare, "config", "core.logAllRefUpdates", "always")
    written = {bare / "refs" / "heads" / "main"}
    for step in EXPERIMENT[:2]:
        before = {*bare.rglob("*")} - written
        assert demandops("request", step, "--state-repo", bare).code == 0
        for path in {*bare.rglob("*")} - before:
            least = folder if path.is_dir() else file
            assert stat.S_IMODE(path.stat().st_mode) & least == least, path
        person.policy(approval="required")  # the next one becomes a branch
        written.clear()
    assert (bare / "refs" / "heads" / "demand").is_dir()
    rig.assert_sound(bare)


@pytest.mark.parametrize("hook", ["pre-receive", "update"])
def test_a_hook_refuses_a_demand_in_its_own_words(bare: Path, demandops: Run, hook: str) -> None:
    file = rig.hook(bare, hook, "echo 'frozen until Monday, ask Ada' >&2; exit 1")
    before = tip(bare)
    ran = demandops("request", EXPERIMENT[0], "--state-repo", bare)
    assert (ran.code, tip(bare)) == (1, before)
    assert "frozen until Monday, ask Ada" in ran.err
    file.chmod(0o644)  # git runs no such file
    assert demandops("request", EXPERIMENT[0], "--state-repo", bare).code == 0


@pytest.mark.parametrize("hook", ["post-receive", "post-update", "reference-transaction"])
@pytest.mark.parametrize("folder", ["hooks", "our-own"])
def test_a_hook_learns_of_each_commit(bare: Path, demandops: Run, hook: str, folder: str) -> None:
    rig.hook(bare, hook, 'echo "$@" >> told; cat >> told').parent.rename(bare / folder)
    git(bare, "config", "core.hooksPath", folder)
    assert demandops("request", EXPERIMENT[0], "--state-repo", bare).code == 0
    assert "refs/heads/main" in (bare / "told").read_text()
    assert not list(bare.glob("objects/pack/*.keep"))
