"""A checked-out state repo: its files, and the commit that an edit started from."""

from __future__ import annotations

import os
import stat
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import pygit2
from pygit2 import Commit, Repository

from demandops.config.config import CONFIG_ROOTS
from demandops.decision import State
from demandops.errors import Fault, InvalidInput, StateRepoError, fault
from demandops.ledger import claim_file
from demandops.plan.release import Release
from demandops.plan.release_keys import ReleaseKey
from demandops.quoting import quoted
from demandops.render.changes import merge_preview
from demandops.runtime import REAL
from demandops.settings import GENERATED_ROOTS, MAIN_BRANCH, NOTES_ROOT
from demandops.staterepo.git import tree as trees
from demandops.staterepo.git.repository import reading, unopened
from demandops.staterepo.history import revisions
from demandops.staterepo.load import state_in_effect

_ROOTS = (*CONFIG_ROOTS, claim_file.LEDGER_ROOT, *GENERATED_ROOTS, NOTES_ROOT)
_DEFAULTS = (f"refs/remotes/origin/{MAIN_BRANCH}", f"refs/heads/{MAIN_BRANCH}")
# A fleet of 20,000 nodes has fewer; more would fill the memory of the machine that checks.
_MOST_BYTES = 16 << 20
_MOST_BYTES_IN_ALL = 1 << 30
_MOST_FILES = 500_000
_SHALLOW = (
    "this clone is shallow and lacks the commit that the edit started from; fetch all commits: "
    "git fetch --unshallow origin (in a pipeline, set fetch-depth: 0 or GIT_DEPTH: 0)"
)


@dataclass(frozen=True, slots=True)
class Base:
    commit: str
    files: Mapping[str, str]
    # in effect at this commit, with last valid versions; None if there never was a valid state
    state: State | None
    # whether all files of the commit are valid
    valid: bool
    # the merge target as git names it, such as ``origin/main``, if there is one
    target: str = ""
    # how many commits of the merge target the checkout lacks
    newer: int = 0
    # the merge target's generated files, if the checkout lacks commits of it
    merged: Mapping[str, str] = field(default_factory=dict)

    def releases(self) -> dict[ReleaseKey, Release]:
        return merge_preview.planned_releases(self.state) if self.state else {}


def files_of(folder: Path) -> tuple[dict[str, str], list[Fault]]:
    """Return the state repo's files as path → text, and a fault for each entry that is not read."""
    # The author of a pull request may be hostile, so only plain files inside of the folder are
    # read, and no other code of the check reads the checkout.
    if not os.path.lexists(folder / "demandops.yaml"):  # is_file follows a link, and may fail
        if (folder / "HEAD").is_file():
            raise StateRepoError(
                f"{folder} is a bare repository, which has no files to edit; clone it, and use the "
                f"clone: git clone {folder}"
            )
        raise StateRepoError(
            f"{folder} is not a state repo, because it has no demandops.yaml; name a checkout of "
            "one, or make one with `demandops init`"
        )
    files, faults, size = dict[str, str](), list[Fault](), 0
    waiting = [folder / root for root in reversed(_ROOTS)]
    while waiting:
        path = waiting.pop()
        parts = path.relative_to(folder)
        name = os.fsencode(parts).decode("utf-8", "backslashreplace")
        try:
            status = path.lstat()
            if message := _why_not_read(path.name, len(parts.parts), status):
                faults.append(fault("", message).within(name))
            elif stat.S_ISDIR(status.st_mode):
                waiting += sorted(path.iterdir(), reverse=True)
            else:
                files[name] = path.read_bytes().decode("utf-8", "replace")
                size += status.st_size
        except FileNotFoundError:  # one of _ROOTS
            continue
        except OSError as error:
            raise StateRepoError(f"{path} cannot be read: {error.strerror}") from None
        if size > _MOST_BYTES_IN_ALL or len(files) + len(waiting) > _MOST_FILES:
            raise StateRepoError(
                f"{folder} has more than {_MOST_FILES:,} files or {_MOST_BYTES_IN_ALL >> 20} MiB "
                "to check; take some out"
            )
    return files, faults


def _why_not_read(name: str, depth: int, status: os.stat_result) -> str:
    if stat.S_ISLNK(status.st_mode):  # it may point to a file that the report must not show
        return "is a symbolic link, which is not followed; replace it by a file"
    if not (stat.S_ISDIR(status.st_mode) or stat.S_ISREG(status.st_mode)):
        return "is neither a file nor a folder; remove it"
    if name.lower() == ".git":  # some file systems do not tell .GIT from .git
        return "belongs to another Git repository, whose files are not read; remove it"
    if stat.S_ISDIR(status.st_mode):
        deep = f"is more than {trees.MAX_DEPTH} folders deep; move it up"
        return deep if depth > trees.MAX_DEPTH else ""
    large = f"has more than {_MOST_BYTES >> 20} MiB; make it smaller"
    return large if status.st_size > _MOST_BYTES else ""


def base_of(folder: Path, revision: str | None) -> Base | None:
    """Return the commit that an edit is compared with, if the folder is a checkout with a commit.

    ``revision`` is the merge target; by default ``origin/main``, else ``main``. If there is
    neither, the edit is compared with HEAD.
    """
    try:
        repo = Repository(str(folder))
    except pygit2.GitError as error:
        if reason := unopened(folder, error):
            raise reason from None
        if revision is not None:
            raise StateRepoError(f"{folder} is not a Git checkout; leave out --base") from None
        return None
    if "core.sparsecheckout" in repo.config and repo.config.get_bool("core.sparsecheckout"):
        raise StateRepoError(
            f"{folder} is a sparse checkout, which lacks files; check out all files with "
            "`git sparse-checkout disable`"
        )
    if repo.is_empty or repo.head_is_unborn:
        return None
    with reading(str(folder), repo):
        target = revision or next((name for name in _DEFAULTS if name in repo.references), "")
        tip = _tip_of(repo, target) if target else None
        commit = _started_from(repo, target, tip)
        base = Base(str(commit.id), trees.texts(commit.tree, _ROOTS), None, False)
        if tip is not None:
            _, newer = repo.ahead_behind(repo.head.peel(Commit).id, tip.id)
            merged = trees.texts(tip.tree, GENERATED_ROOTS) if newer else {}
            name = target.removeprefix("refs/remotes/").removeprefix("refs/heads/")
            base = replace(base, target=name, newer=newer, merged=merged)
        try:
            snapshot = state_in_effect.state_at(repo, commit.id)
        except (InvalidInput, StateRepoError):
            return base
        return replace(base, state=snapshot.state, valid=not snapshot.problems)


def _tip_of(repo: Repository, target: str) -> Commit:
    try:
        return revisions.resolve(repo, repo.head.peel(Commit).id, target, REAL.now())
    except StateRepoError:
        if repo.is_shallow:
            raise StateRepoError(f"{quoted(target)}: {_SHALLOW}") from None
        raise


def _started_from(repo: Repository, target: str, tip: Commit | None) -> Commit:
    head = repo.head.peel(Commit)
    try:
        common = repo.merge_base(head.id, tip.id) if tip is not None else None
    except (pygit2.GitError, KeyError):
        if repo.is_shallow:
            raise StateRepoError(f"{quoted(target)}: {_SHALLOW}") from None
        raise
    if common is not None:
        return trees.commit_of(repo, common)
    if repo.is_shallow:
        raise StateRepoError(_SHALLOW)
    if not target:
        return head
    raise StateRepoError(
        f"HEAD and {target} have no commit in common; name the merge target with --base"
    )


def author_of(folder: Path) -> str:
    try:
        repo = Repository(str(folder))
        return str(repo.head.peel(Commit).author.name)
    except (pygit2.GitError, LookupError, ValueError):  # also an encoding that nobody knows
        return ""
