"""Proving commits: the generated files are those that ledger and configuration give.

A commit is proven whole (everything is loaded and rendered) or by its differences from the commit
proven before it. The second way relies on object ids, and on plans and files that depend on their
input only. It does not trust which releases the generator considered affected: it plans and renders
every release again if any input of its plan changed (:mod:`demandops.plan.incremental_plan`), and
compares every file that differs in Git. The first and the last commit are proven whole.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import pygit2
from pygit2 import Commit, Oid, Repository, Tree

from demandops.config.config import CONFIG_ROOTS, Config
from demandops.decision import State, rendered_files
from demandops.errors import InvalidInput
from demandops.ledger import ended_override_file
from demandops.ledger.ledger import ClaimChange
from demandops.plan.incremental_plan import IncrementalPlan
from demandops.plan.release import Release
from demandops.plan.release_keys import ReleaseKey
from demandops.render import release_file
from demandops.render.gitops import manifests
from demandops.render.gitops.paths import path_of
from demandops.settings import GENERATED_ROOTS, NOTES_ROOT, RENDER_VERSION
from demandops.staterepo.audit import allowed_changes
from demandops.staterepo.git import tree as trees
from demandops.staterepo.history.commit_log import LogEntry, entry_of
from demandops.staterepo.history.commit_message import PROPOSAL
from demandops.staterepo.load import ledger_files, state_in_effect

_CHARTS = "/_charts/"


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether the generated files of a commit are those that ledger and configuration give.

    ``holds`` is true if nothing is wrong, or the commit is ``skipped``. ``touched`` are files that
    the commit changed but may not change. ``signature`` says what is wrong with a required
    signature, ``signer`` who signed.
    """

    commit: str
    summary: str
    holds: bool
    skipped: str = ""
    fault: str = ""
    differing: tuple[str, ...] = ()
    touched: tuple[str, ...] = ()
    signed: bool = False
    signer: str = ""
    signature: str = ""


@dataclass(slots=True)
class _Proof:
    """A commit that was rendered again, and what the proof of the next one reuses."""

    tree: Tree
    state: State
    plan: IncrementalPlan
    planned: dict[ReleaseKey, tuple[str, Oid]]
    held: dict[ReleaseKey, Release]
    """Releases whose files an override holds: they depend on the parent commit."""
    undemanded: dict[str, Oid]
    """Files that exist without any demand."""
    committed: dict[str, Oid]
    """The commit's files in the generated folders."""

    def advance(self, state: State, changes: Sequence[ClaimChange], before: Tree | None) -> None:
        """Plan and render what the changes affect.

        Args:
            state: ledger and configuration after the changes.
            changes: every claim that changed.
            before: the commit's parent, whose files overrides may hold.
        """
        self.state = state
        for key, release in self.plan.advance(state.ledger, changes).items():
            self.planned.pop(key, None)
            self.held.pop(key, None)
            if release is not None and release.shaping.held:
                self.held[key] = release
            elif release is not None:
                self.planned[key] = _rendered(release, state, None)
        for key, release in self.held.items():
            self.planned[key] = _rendered(release, state, before)

    def differing(self, before: Tree | None) -> tuple[str, ...]:
        """Return the files that differ from what was rendered."""
        wanted = self.undemanded | dict(self.planned.values())
        if before is not None and any(one.hold for one in self.state.config.active_overrides):
            charts = {
                path: trees.text_of(blob)
                for path, blob in trees.blobs(before, GENERATED_ROOTS)
                if _CHARTS in path and path not in wanted
            }
            kept = release_file.kept_charts({}, charts, self.state.config)
            wanted |= {path: _blob(text) for path, text in kept.items()}
        return _differing(wanted, self.committed)


def _rendered(release: Release, state: State, before: Tree | None) -> tuple[str, Oid]:
    path = path_of(release)
    current = trees.read_text(before, path)
    return path, _blob(release_file.release_text(release, state.config, state.engine, current))


def verify(repo: Repository, commits: Sequence[str], *, whole: bool = False) -> Iterator[Verdict]:
    """Yield a verdict on each commit, oldest first.

    Args:
        whole: load and render every commit whole.
    """
    proofs = _Proofs(repo)
    for place, revision in enumerate(commits, 1):
        commit = trees.commit_of(repo, revision)
        entry = entry_of(commit)
        verdict = Verdict(entry.commit, entry.summary, True, _skip_reason(entry))
        if verdict.skipped:
            yield verdict
            continue
        touched = allowed_changes.disallowed_files(commit, entry)
        whole_commit = whole or place == len(commits) or bool(entry.first("In-Force"))
        try:
            differing = proofs.differing(commit, entry, whole=whole_commit)
        except _Unreadable as error:
            why = f"a file was not valid then: {error}"
            yield replace(verdict, skipped=why, touched=touched, holds=not touched)
        except InvalidInput as error:  # the generator did render it then, so it must now
            yield replace(verdict, holds=False, fault=str(error.faults[0]), touched=touched)
        else:
            holds = not (differing or touched)
            yield replace(verdict, holds=holds, differing=differing, touched=touched)


class _Unreadable(Exception):
    """Raised when a commit cannot be proven because one of its files is not valid."""


class _Proofs:
    """Proves commits one after the other."""

    def __init__(self, repo: Repository) -> None:
        self._repo = repo
        self._proof: _Proof | None = None

    def differing(self, commit: Commit, entry: LogEntry, *, whole: bool) -> tuple[str, ...]:
        """Return the files of a commit that differ from what was rendered.

        Args:
            whole: do not reuse results of another commit.

        Raises:
            _Unreadable, InvalidInput: the commit cannot be read or rendered.
        """
        proof, self._proof = self._proof, None
        if whole:
            state = self._loaded(entry)
            files = rendered_files(state, _held_from(commit, state.config))
            wanted = {path: _blob(text) for path, text in files.items()}
            return _differing(wanted, _generated_files(commit.tree))
        if proof is None or _reconfigured(proof, commit):
            proof = _prove_whole(self._loaded(entry), commit)
        else:
            try:
                changes = _claims_changed(proof, commit)
            except InvalidInput as error:
                raise _Unreadable(error.faults[0]) from None
            _advance(proof, commit, changes)
        self._proof = proof  # not reached, and so None, if the commit could not be read
        return proof.differing(trees.parent_tree(commit))

    def _loaded(self, entry: LogEntry) -> State:
        try:
            return state_in_effect.recorded_state(self._repo, entry).state
        except InvalidInput as error:
            raise _Unreadable(error.faults[0]) from None


def _differing(wanted: Mapping[str, Oid], committed: Mapping[str, Oid]) -> tuple[str, ...]:
    return tuple(
        path
        for path in sorted({*wanted, *committed})
        if wanted.get(path) != committed.get(path) and not trees.is_readme(path)
    )


def _skip_reason(entry: LogEntry) -> str:
    if not entry.by_generator:
        return "merged by a person" if PROPOSAL in entry.trailers else "made by a person"
    version = entry.first("Render-Version")
    if version != str(RENDER_VERSION):
        return f"rendered by version {version}, this is version {RENDER_VERSION}"
    return ""


def _held_from(commit: Commit, config: Config) -> dict[str, str]:
    """Return the files of the commit's parent if overrides hold some of them."""
    before = trees.parent_tree(commit)
    if before is None or not any(override.hold for override in config.active_overrides):
        return {}
    return trees.texts(before, GENERATED_ROOTS)


def _reconfigured(proof: _Proof, commit: Commit) -> bool:
    """Return whether configuration, ended overrides or the problem report changed."""

    roots = (*CONFIG_ROOTS, NOTES_ROOT, ended_override_file.MARKERS_ROOT)
    return trees.differ(proof.tree, commit.tree, roots)


def _claims_changed(proof: _Proof, commit: Commit) -> list[ClaimChange]:
    """Return the claims that differ from those of the commit proven before.

    Raises:
        InvalidInput: a claim file is not valid.
    """
    return [
        ClaimChange(*(ledger_files.claim_at(tree, path) for tree in (proof.tree, commit.tree)))
        for path in ledger_files.changed_files(proof.tree, commit.tree)
    ]


def _prove_whole(state: State, commit: Commit) -> _Proof:
    """Render a commit whole, so that the next can be proven by its differences."""
    undemanded = manifests.base_files(state.config, state.engine)
    proof = _Proof(
        tree=commit.tree,
        state=state,
        plan=IncrementalPlan(state.config),
        planned={},
        held={},
        undemanded={path: _blob(text) for path, text in undemanded.items()},
        committed=_generated_files(commit.tree),
    )
    proof.advance(state, (), trees.parent_tree(commit))
    return proof


def _advance(proof: _Proof, commit: Commit, changes: Sequence[ClaimChange]) -> None:
    """Render what a commit changed in the ledger, and record which files it changed."""
    ledger = proof.state.ledger
    for change in changes:
        ledger = ledger.replace(change.key, change.after)
    for path, blob in trees.differences(proof.tree, commit.tree, GENERATED_ROOTS):
        proof.committed.pop(path, None)
        if blob is not None:
            proof.committed[path] = blob
    proof.tree = commit.tree
    proof.advance(replace(proof.state, ledger=ledger), changes, trees.parent_tree(commit))


def _generated_files(tree: Tree) -> dict[str, Oid]:
    return {path: blob.id for path, blob in trees.blobs(tree, GENERATED_ROOTS)}


def _blob(text: str) -> Oid:
    return pygit2.hash(text.encode())
