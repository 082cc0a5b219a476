"""Proving commits: what the generator committed is what books and configuration give.

A commit is proven whole (loaded and rendered from nothing) or by differences from the one proven
before it. The second trusts object ids, and that planning and rendering are functions; it does not
trust what the generator thought was affected: every release is planned and rendered again of whose
plan anything that was read has changed (:mod:`generator.plan.traced`), and every file that differs
in Git is compared. The first and the last commit of a row are proven whole.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import pygit2
from pygit2 import Commit, Oid, Repository, Tree

from generator.catalog.catalog import CONFIG_ROOTS
from generator.decision import State, rendered
from generator.demand.claim import Claim
from generator.errors import InvalidInput
from generator.ledger import format as ledger_format
from generator.ledger.ledger import ClaimChange
from generator.plan.planner import ReleaseKey
from generator.plan.traced import TracedPlan
from generator.render import gitops
from generator.render.paths import path_of
from generator.settings import GENERATED_ROOTS, RENDER_VERSION
from generator.staterepo import snapshot as snapshots
from generator.staterepo import tree as trees
from generator.staterepo.history import LogEntry, entry_of
from generator.staterepo.snapshot import Snapshot

_PEOPLES = (*CONFIG_ROOTS, "overrides")
_FREE = ("init", "upgrade")
"""Operations that may write what people own: they lay it down, or bring it to a new form."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether the rendered files of one commit are those that its books and settings give.

    ``touched`` are files that the commit changed and that are not its to write. ``signature`` says
    what is wrong with it where one is asked for, ``signer`` whose it is.
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
    """A commit that was rendered again, and what of it serves the next."""

    tree: Tree
    state: State
    claims: dict[str, Claim]
    plan: TracedPlan
    planned: dict[ReleaseKey, tuple[str, Oid]]
    steady: dict[str, Oid]
    """What stays when nothing is demanded."""
    standing: dict[str, Oid]
    """What the commit holds below the generated folders."""

    def take_in(self, state: State, changes: Sequence[ClaimChange]) -> None:
        """Plan and render what the changes may have changed."""
        self.state = state
        for key, release in self.plan.advance(state.ledger, changes).items():
            self.planned.pop(key, None)
            if release is not None:
                text = gitops.render(release, state.catalog, state.engine)
                self.planned[key] = (path_of(release), _blob(text))

    def differing(self) -> tuple[str, ...]:
        """Return the files that are not what they should be."""
        return _differing(self.steady | dict(self.planned.values()), self.standing)


def verify(repo: Repository, commits: Sequence[str], *, whole: bool = False) -> Iterator[Verdict]:
    """Yield a verdict on each commit, oldest first.

    Args:
        whole: whether to load and render every commit from nothing.
    """
    row = _Row(repo)
    for place, revision in enumerate(commits, 1):
        commit = snapshots.commit_of(repo, revision)
        entry = entry_of(commit)
        verdict = Verdict(entry.commit, entry.summary, True, _why_not(entry))
        if verdict.skipped:
            yield verdict
            continue
        touched = _not_its_own(repo, commit, entry)
        alone = whole or place == len(commits) or bool(entry.one("In-Force"))
        try:
            differing = row.differing(commit, entry, alone=alone)
        except _Unreadable as error:
            why = f"a person's file was not valid then: {error}"
            yield replace(verdict, skipped=why, touched=touched, holds=not touched)
        except InvalidInput as error:  # the generator did render it then, so it must now
            yield replace(verdict, holds=False, fault=str(error.faults[0]), touched=touched)
        else:
            holds = not (differing or touched)
            yield replace(verdict, holds=holds, differing=differing, touched=touched)


class _Unreadable(Exception):
    """A commit that cannot be judged, for a file of people in it is not valid."""


class _Row:
    """Commits that are proven one after the other."""

    def __init__(self, repo: Repository) -> None:
        self._repo = repo
        self._proof: _Proof | None = None

    def differing(self, commit: Commit, entry: LogEntry, *, alone: bool) -> tuple[str, ...]:
        """Return the files of a commit that are not what they should be.

        Args:
            alone: whether nothing that is known of another commit may serve.

        Raises:
            _Unreadable, InvalidInput: where it cannot be read, or not be rendered.
        """
        proof, self._proof = self._proof, None
        if alone:
            state = self._loaded(commit, entry)
            wanted = {path: _blob(text) for path, text in rendered(state).items()}
            return _differing(wanted, dict(_standing(commit.tree)))
        if proof is None or _reconfigured(proof, commit):
            proof = _from_nothing(self._loaded(commit, entry), commit)
        else:
            try:
                changes = _claims_changed(self._repo, proof, commit)
            except InvalidInput as error:
                raise _Unreadable(error.faults[0]) from None
            _bring_forward(self._repo, proof, commit, changes)
        self._proof = proof  # of one that could not be judged nothing serves the next
        return proof.differing()

    def _loaded(self, commit: Commit, entry: LogEntry) -> State:
        try:
            return _in_force_at(self._repo, commit, entry.one("In-Force")).state
        except InvalidInput as error:
            raise _Unreadable(error.faults[0]) from None


def _differing(wanted: Mapping[str, Oid], standing: Mapping[str, Oid]) -> tuple[str, ...]:
    return tuple(
        path
        for path in sorted({*wanted, *standing})
        if wanted.get(path) != standing.get(path) and not trees.is_note(path)
    )


def _why_not(entry: LogEntry) -> str:
    if not entry.by_generator:
        return "made by a person"
    version = entry.one("Render-Version")
    if version != str(RENDER_VERSION):
        return f"rendered by version {version}, this is version {RENDER_VERSION}"
    return ""


def _in_force_at(repo: Repository, commit: Commit, sound: str) -> Snapshot:
    """Return what the generator went by at one of its commits.

    ``sound`` is the commit whose configuration was in force, where people had broken theirs.
    """
    if not sound:
        return snapshots.load(repo, commit.id)
    snapshot = snapshots.load(repo, sound)
    later = snapshots.advance(repo, snapshot, commit.id).snapshot
    return replace(later, state=replace(snapshot.state, ledger=later.state.ledger))


def _reconfigured(proof: _Proof, commit: Commit) -> bool:
    def ids(tree: Tree) -> list[Oid | None]:
        found = (trees.child(tree, root) for root in _PEOPLES)
        return [entry.id if entry else None for entry in found]

    return ids(proof.tree) != ids(commit.tree)


def _claims_changed(repo: Repository, proof: _Proof, commit: Commit) -> list[ClaimChange]:
    """Return the claims that differ from those proven before.

    Raises:
        InvalidInput: where a claim file is not valid.
    """
    changes = []
    for path, blob in trees.below_root(repo, proof.tree, commit.tree, ledger_format.LEDGER_ROOT):
        if ledger_format.kind_of(path) is None:
            continue
        known = proof.claims.get(path)
        claim = ledger_format.read(_text(commit, path), path) if blob else None
        if known or claim:
            changes.append(ClaimChange(known, claim))
    return changes


def _from_nothing(state: State, commit: Commit) -> _Proof:
    """Render a commit whole, so that the next can be proven by what differs."""
    steady = gitops.standing_files(state.catalog, state.engine)
    proof = _Proof(
        tree=commit.tree,
        state=state,
        claims={ledger_format.path_of(claim.key): claim for claim in state.ledger},
        plan=TracedPlan(state.catalog),
        planned={},
        steady={path: _blob(text) for path, text in steady.items()},
        standing=dict(_standing(commit.tree)),
    )
    proof.take_in(state, ())
    return proof


def _bring_forward(
    repo: Repository, proof: _Proof, commit: Commit, changes: Sequence[ClaimChange]
) -> None:
    """Render what a commit changed of its books, and note what it changed of its files."""
    ledger = proof.state.ledger
    for change in changes:
        ledger = ledger.replace(change.key, change.after)
        path = ledger_format.path_of(change.key)
        proof.claims.pop(path, None)
        if change.after is not None:
            proof.claims[path] = change.after
    for root in GENERATED_ROOTS:
        for path, blob in trees.below_root(repo, proof.tree, commit.tree, root):
            proof.standing.pop(path, None)
            if blob is not None:
                proof.standing[path] = blob
    proof.tree = commit.tree
    proof.take_in(replace(proof.state, ledger=ledger), changes)


def _standing(tree: Tree) -> Iterator[tuple[str, Oid]]:
    for root in GENERATED_ROOTS:
        entry = trees.child(tree, root)
        if isinstance(entry, Tree):
            yield from trees.entries(entry, f"{root}/")
        elif entry is not None:
            yield root, entry.id


def _not_its_own(repo: Repository, commit: Commit, entry: LogEntry) -> tuple[str, ...]:
    """Return what a commit of the generator changed although its message does not account for it.

    People's files, and claims of demands that it does not name or that are not written as the
    generator writes them.
    """
    if not commit.parents or entry.one("Operation") in _FREE:
        return ()
    before, found = commit.parents[0].tree, []
    for root in _PEOPLES:
        found += [path for path, _ in trees.below_root(repo, before, commit.tree, root)]
    named = {f"{ledger_format.segment(id)}.yaml" for id in entry.trailers.get("Demand-Id", ())}
    for path, blob in trees.below_root(repo, before, commit.tree, ledger_format.LEDGER_ROOT):
        if path.rsplit("/", 1)[-1] not in named or (blob and not _is_canonical(commit, path)):
            found.append(path)
    return tuple(found)


def _is_canonical(commit: Commit, path: str) -> bool:
    text = _text(commit, path)
    try:
        return ledger_format.write(ledger_format.read(text, path)) == text
    except InvalidInput:
        return False


def _text(commit: Commit, path: str) -> str:
    return trees.read_text(commit.tree, path) or ""


def _blob(text: str) -> Oid:
    return pygit2.hash(text.encode())
