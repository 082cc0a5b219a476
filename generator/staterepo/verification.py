"""Proving commits: what the generator committed is what books and configuration give.

A commit is proven whole (loaded and rendered from nothing) or by differences from the one proven
before it. The second trusts object ids and that rendering is a function of release and catalog; it
does not trust what the generator thought was affected: every release is planned again at every
commit, and rendered again where its plan differs at all. The first and the last commit of a row
are proven whole.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import pygit2
from pygit2 import Commit, Oid, Repository, Tree

from generator.catalog.catalog import CONFIG_ROOTS
from generator.errors import InvalidInput
from generator.ledger import format as ledger_format
from generator.plan.planner import ReleaseKey, all_keys, plan
from generator.plan.release import Bridge, Release, ServiceRelease
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

_Planned = tuple[Release, str, Oid]
_Files = dict[str, Oid]


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
    snapshot: Snapshot
    planned: dict[ReleaseKey, _Planned]
    steady: _Files
    """What stays when nothing is demanded."""
    standing: _Files
    """What the commit holds below the generated folders."""

    def differing(self) -> tuple[str, ...]:
        wanted = self.steady | {path: blob for _, path, blob in self.planned.values()}
        paths = sorted({*wanted, *self.standing})
        return tuple(
            path
            for path in paths
            if wanted.get(path) != self.standing.get(path) and not trees.is_note(path)
        )


def verify(repo: Repository, commits: Sequence[str], *, whole: bool = False) -> Iterator[Verdict]:
    """Yield a verdict on each commit, oldest first.

    Args:
        whole: whether to load and render every commit from nothing.
    """
    proof: _Proof | None = None
    for place, revision in enumerate(commits):
        commit = snapshots.commit_of(repo, revision)
        entry = entry_of(commit)
        verdict = Verdict(entry.commit, entry.summary, True, _why_not(entry))
        if verdict.skipped:
            yield verdict
            continue
        in_force = entry.one("In-Force")
        ends = place in (0, len(commits) - 1)
        try:
            if whole or ends or in_force or proof is None or _reconfigured(proof, commit):
                snapshot = _in_force_at(repo, commit, in_force)
                proof = None
            else:
                snapshot = _advanced(repo, proof, commit)
        except InvalidInput as error:
            proof = None
            yield replace(verdict, skipped=f"a person's file was not valid then: {error.faults[0]}")
            continue
        touched = _not_its_own(repo, commit, entry)
        try:
            proof = _proven(repo, proof, snapshot, commit)
        except InvalidInput as error:  # the generator did render it then, so it must now
            proof = None
            yield replace(verdict, holds=False, fault=str(error.faults[0]), touched=touched)
            continue
        differing = proof.differing()
        yield replace(
            verdict, holds=not (differing or touched), differing=differing, touched=touched
        )
        if in_force:  # whose configuration is not that of its tree
            proof = None


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


def _advanced(repo: Repository, proof: _Proof, commit: Commit) -> Snapshot:
    """Return the books at a commit, reading the claims that differ from those proven before.

    Raises:
        InvalidInput: where a claim file is not valid.
    """
    ledger, keys = proof.snapshot.state.ledger, proof.snapshot.keys
    for path, blob in trees.below_root(repo, proof.tree, commit.tree, ledger_format.LEDGER_ROOT):
        if ledger_format.kind_of(path) is None:
            continue
        known = keys.get(path)
        if known is not None:
            ledger, keys = ledger.replace(known, None), keys.remove(path)
        if blob is not None:
            claim = ledger_format.read(_text(commit, path), path)
            ledger, keys = ledger.replace(claim.key, claim), keys.insert(path, claim.key)
    state = replace(proof.snapshot.state, ledger=ledger)
    return replace(proof.snapshot, commit=commit.id, state=state, keys=keys)


def _proven(repo: Repository, before: _Proof | None, snapshot: Snapshot, commit: Commit) -> _Proof:
    """Plan every release anew, and render those whose plan is not the one that is known."""
    state = snapshot.state
    planned = {}
    for key in all_keys(state.ledger, state.catalog):
        release = plan(state.ledger, state.catalog, key)
        if release is None:
            continue
        known = before.planned.get(key) if before else None
        if known is None or not _same(known[0], release):
            text = gitops.render(release, state.catalog, state.engine)
            known = (release, path_of(release), _blob(text))
        planned[key] = known
    if before is None:
        steady = gitops.standing_files(state.catalog, state.engine)
        standing = dict(_standing(commit.tree))
        ids = {path: _blob(text) for path, text in steady.items()}
        return _Proof(commit.tree, snapshot, planned, ids, standing)
    standing = before.standing
    for root in GENERATED_ROOTS:
        for path, blob in trees.below_root(repo, before.tree, commit.tree, root):
            standing.pop(path, None)
            if blob is not None:
                standing[path] = blob
    return _Proof(commit.tree, snapshot, planned, before.steady, standing)


def _same(one: Release, other: Release) -> bool:
    """Compare exactly: to Python 1 is True and 1.0, to a chart they are three values."""
    return type(one) is type(other) and one == other and _written(one) == _written(other)


def _written(release: Release) -> str:
    values: Any
    if isinstance(release, ServiceRelease):
        values = (release.parameters, release.inputs)
    elif isinstance(release, Bridge):
        values = release.rates
    else:
        values = release.topics
    return repr(values)


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
