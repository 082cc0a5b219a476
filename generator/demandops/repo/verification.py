"""Renders commits again and compares the bytes: each commit of a generator proves itself."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import pygit2
from pygit2 import Commit, Oid, Repository, Tree

from demandops.base.errors import InvalidInput, StateRepoError
from demandops.base.settings import (
    GENERATED_ROOTS,
    LEDGER_API_VERSION,
    RENDER_VERSION,
    REPORTS_ROOT,
)
from demandops.decide.planning.planner import ReleaseKey, affected_keys, all_keys, plan
from demandops.model.config import discovered
from demandops.model.config.appdef import without_ignored_fields
from demandops.model.config.repo_settings import ROOT_FILE
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger import records
from demandops.model.ledger.claim import OVERRIDE_PREFIX, Claim
from demandops.model.ledger.ledger import ClaimChange
from demandops.model.ledger.records import WaitingDemand
from demandops.model.release import Release
from demandops.render import gitops
from demandops.render.gitops import path_of
from demandops.repo.git import signing
from demandops.repo.git import tree as trees
from demandops.repo.history.commit_log import LogEntry, entry_of
from demandops.repo.history.commit_message import PROPOSAL
from demandops.repo.load import ledger_files
from demandops.repo.load import snapshot as snapshots
from demandops.repo.load.snapshot import Snapshot

# ---- the files that a commit of the generator changed, but was not allowed to change ----
#
# A commit of the generator may change generated files, reports, and the claims that its message
# names. Some operations may change further files.

# Operations that may rewrite a claim, to start its lease or to change its schema.
_REWRITING = ("follow", "upgrade")
# Operations that may add or remove the marker of an ended override.
_ENDING = ("follow", "upgrade", "expire-override")


def disallowed_files(  # noqa: PLR0912 - a branch for each kind of file
    repo: Repository, commit: Commit, entry: LogEntry
) -> Iterator[str]:
    # These are files that people write, claims of demands that the message does not name, claims in
    # another format than the generator's, and records that the commit's operation must not change.
    if not commit.parents:  # `demandops init` writes everything
        return
    before, operation = commit.parents[0].tree, entry.first("Operation")
    demands = {*entry.trailers.get("Demand-Id", ())}
    for path in entry.trailers.get("Override", ()):  # claims that a `keep` override adds
        demands.add(OVERRIDE_PREFIX + path.rsplit("/", 1)[-1].removesuffix(".yaml"))
    named = {f"{claim_files.segment(demand)}.yaml" for demand in demands}
    # a claim may be put back as it was at the generator's commit before, or after it
    since = entry.first("Since") if operation == "follow" else ""
    for path, blob in trees.differences(before, commit.tree):
        root = path.split("/", 1)[0]
        # of a folder, the files count
        if root in (*GENERATED_ROOTS, REPORTS_ROOT) or isinstance(
            trees.entry(commit.tree, path), Tree
        ):
            continue
        if operation == "upgrade" and not blob and path.startswith(records.GONE_ROOTS):
            continue
        old, new = (trees.read_text(tree, path) for tree in (before, commit.tree))
        # an upgrade takes fields out of definitions that are read no longer
        only_removes = old is not None and without_ignored_fields(path, old) == new
        if operation == "upgrade" and (path == ROOT_FILE or only_removes):
            continue
        is_put_back = bool(since) and _stood_since(repo, commit, since, path, blob)
        if discovered.is_discovered(path):
            if not (is_put_back or (operation == "discover" and _is_as_written(new, path))):
                yield path
        elif root != claim_files.LEDGER_ROOT:
            yield path
        elif path.startswith(f"{records.MARKERS_ROOT}/"):
            is_valid = not new or records.read_ended_override({path: new})
            if operation not in _ENDING or not is_valid:
                yield path
        elif path.rsplit("/", 1)[-1] in named:
            if blob and not _is_canonical(commit, path):
                yield path
        elif (operation not in _REWRITING or not _only_rewrites(commit, path)) and not is_put_back:
            yield path


def _stood_since(repo: Repository, commit: Commit, since: str, path: str, blob: Oid | None) -> bool:
    # what people deleted, and then broke, stays deleted
    while commit.parents and str(commit.id) != since:
        commit = commit.parents[0]
        if trees.entry_id(commit.tree, path) == blob:
            return True
    return False


def _is_as_written(text: str | None, path: str) -> bool:
    try:
        return text is None or discovered.text_of(discovered.read(text, path)) == text
    except InvalidInput:
        return False


def _only_rewrites(commit: Commit, path: str) -> bool:
    # at most the schema of a record and the start of a claim's lease
    before, after = (_record_at(tree, path) for tree in (commit.parents[0].tree, commit.tree))
    if isinstance(before, Claim) and isinstance(after, Claim):
        old, new = before.lease, after.lease
        if old and new and new.has_started > old.has_started:
            before = replace(before, lease=replace(old, until=new.until))
    return before == after and _is_canonical(commit, path)


def _is_canonical(commit: Commit, path: str) -> bool:
    record, text = _record_at(commit.tree, path), trees.read_text(commit.tree, path) or ""
    if record is None:
        return False
    if LEDGER_API_VERSION not in text:  # of an older schema, which had its own form
        return True
    return text == (
        claim_files.text_of(record) if isinstance(record, Claim) else records.waiting_text(record)
    )


def _record_at(tree: Tree, path: str) -> Claim | WaitingDemand | None:
    if path.startswith(f"{records.WAITING_ROOT}/"):
        return records.read_waiting(trees.read_text(tree, path) or "", path)
    return ledger_files.valid_claim_at(tree, path)


# ---- rendering the files again, and comparing them with the committed ones ----
#
# A commit is verified whole or by differences. To verify a commit whole, the program loads and
# renders everything. It does so for the first and the last commit, and for each commit with another
# configuration in effect than the commit before.
#
# By differences, the program starts from the commit that it verified before. It assumes that equal
# object ids mean equal files, and that plans and rendered files depend only on their input. It
# renders the releases again that the changed claims affect, and compares the ids of all generated
# files. A release that this choice missed would differ in the last commit, which is verified whole.


@dataclass(frozen=True, slots=True)
class Verdict:
    commit: str
    summary: str
    holds: bool  # whether no fault was found, also in a commit that was skipped
    skipped: str = ""  # why the commit was not rendered again
    fault: str = ""  # the error of reading or rendering the commit again
    differing: tuple[str, ...] = ()  # the generated files that differ from the rendered ones
    # the files that the commit changed, but was not allowed to change
    touched: tuple[str, ...] = ()
    signed: bool = False  # whether the commit has a signature, valid or not
    signer: str = ""  # who signed, if a signature is required and valid; else why it is not
    signature: str = ""


class _Proof:
    # the files that a commit should have, rendered again to compare with its committed files
    def __init__(self, snapshot: Snapshot, commit: Commit) -> None:
        self.snapshot, self.state, self._commit = snapshot, snapshot.state, commit
        self._planned: dict[ReleaseKey, tuple[str, Oid]] = {}
        # with an override that sets ``hold``: such a file's text depends on the parent commit
        self._held: dict[ReleaseKey, Release] = {}
        base_files = gitops.base_files(self.state.config)
        self._undemanded = {path: _blob(text) for path, text in base_files.items()}
        committed = trees.entries(commit.tree, GENERATED_ROOTS)
        self._committed = {path: child.id for path, child in committed}
        self._render(all_keys(self.state))

    def advanced(self, snapshot: Snapshot, commit: Commit) -> bool:
        # not if all releases may be affected, as by a configuration and by ended overrides
        old, new = self.state, snapshot.state
        if new.config is not old.config or new.ledger.ended != old.ledger.ended:
            return False
        before, after = self._commit.tree, commit.tree
        changes = [
            ClaimChange(*(ledger_files.claim_at(tree, path) for tree in (before, after)))
            for path in ledger_files.changed_files(before, after)
        ]
        for path, blob in trees.differences(before, after, GENERATED_ROOTS):
            self._committed.pop(path, None)
            self._committed |= {path: blob} if blob is not None else {}
        self.snapshot, self.state, self._commit = snapshot, new, commit
        self._render(affected_keys(old, new, changes))
        return True

    def _render(self, keys: Iterable[ReleaseKey]) -> None:
        for key in keys:
            release = plan(self.state, key)
            self._planned.pop(key, None)
            self._held.pop(key, None)
            if release is not None and release.shaping.held:
                self._held[key] = release
            elif release is not None:
                self._planned[key] = self._rendered(release, None)
        for key, release in self._held.items():
            self._planned[key] = self._rendered(release, trees.parent_tree(self._commit))

    def _rendered(self, release: Release, before: Tree | None) -> tuple[str, Oid]:
        path, state = path_of(release), self.state
        current = trees.read_text(before, path)
        return path, _blob(gitops.release_text(release, state.config, state.evaluate, current))

    def differing(self) -> tuple[str, ...]:
        wanted = self._undemanded | dict(self._planned.values())
        before = trees.parent_tree(self._commit)
        if before is not None and any(override.hold for override in self.state.overrides):
            charts = {
                path: trees.text_of(blob)
                for path, blob in trees.blobs(before, GENERATED_ROOTS)
                if "/_charts/" in path and path not in wanted
            }
            kept = gitops.kept_charts({}, charts, self.state)
            wanted |= {path: _blob(text) for path, text in kept.items()}
        return tuple(
            path
            for path in sorted({*wanted, *self._committed})
            if wanted.get(path) != self._committed.get(path) and not trees.is_readme(path)
        )


def verify(repo: Repository, commits: Sequence[str], *, whole: bool = False) -> Iterator[Verdict]:
    opened = [trees.commit_of(repo, revision) for revision in commits]
    checks = signing.checks(repo, [commit for commit in opened if entry_of(commit).by_generator])
    proof: _Proof | None = None
    for place, commit in enumerate(opened, 1):
        entry = entry_of(commit)
        check = checks.get(entry.commit, signing.Check())
        version, skipped = entry.first("Render-Version"), ""
        if not entry.by_generator:
            skipped = "merged by a person" if PROPOSAL in entry.trailers else "made by a person"
        elif version != str(RENDER_VERSION):
            skipped = f"rendered by version {version}, but this program renders version "
            skipped += str(RENDER_VERSION)
        verdict = Verdict(
            entry.commit,
            entry.summary,
            holds=not check.fault,
            skipped=skipped,
            signed=bool(signing.signature_of(commit)),
            signer=check.signer,
            signature=check.fault,
        )
        if skipped:
            yield verdict
            continue
        before, proof = proof, None  # proof stays None if the commit cannot be read
        try:
            verdict = replace(verdict, touched=tuple(sorted(disallowed_files(repo, commit, entry))))
            if whole or place == len(commits):
                before = None
            known = before.snapshot if before else None
            try:
                snapshot = snapshots.load(repo, commit.id, entry=entry, before=known)
                invalid = snapshot.claim_faults
            except InvalidInput as error:
                invalid = error.faults
            if invalid:
                why = f"a file was not valid at this commit: {invalid[0]}"
                yield replace(verdict, skipped=why, holds=verdict.holds and not verdict.touched)
                continue
            if before is None or not before.advanced(snapshot, commit):
                before = _Proof(snapshot, commit)
            proof, differing = before, before.differing()
        except InvalidInput as error:  # the generator could render the commit, so this is a fault
            yield replace(verdict, holds=False, fault=str(error.faults[0]))
        except StateRepoError as error:
            yield replace(verdict, holds=False, fault=str(error))
        else:
            holds = verdict.holds and not (differing or verdict.touched)
            yield replace(verdict, holds=holds, differing=differing)


def _blob(text: str) -> Oid:
    return pygit2.hash(text.encode())
