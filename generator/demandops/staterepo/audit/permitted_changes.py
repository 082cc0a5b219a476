"""Finds the files that a commit of the generator changed, but was not allowed to change.

A commit of the generator may change generated files, reports, and the claims that its message
names. Some operations may change further files.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from pygit2 import Commit, Tree

from demandops.config.repo_settings import ROOT_FILE
from demandops.demand.claim import OVERRIDE_PREFIX
from demandops.ledger import (
    claim_file,
    ended_override_file,
    kept_replicas,
    recent_shutdowns,
    waiting,
)
from demandops.settings import GENERATED_ROOTS, NOTES_ROOT
from demandops.staterepo.git import tree as trees
from demandops.staterepo.history.commit_log import LogEntry
from demandops.staterepo.load import ledger_files

_OWN_ROOTS = (*GENERATED_ROOTS, NOTES_ROOT)
# Operations that may record or forget recent shutdowns.
_RECORDING = ("shutdown", "join", "rollback")
# The folders of the ledger that have records, such as recent shutdowns, instead of claims.
_RECORDS = tuple(
    f"{root}/"
    for root in (
        ended_override_file.MARKERS_ROOT,
        recent_shutdowns.SHUTDOWNS_ROOT,
        kept_replicas.REPLICAS_ROOT,
    )
)
# Operations that may rewrite a claim, to start its lease or to change its schema.
_REWRITING = ("follow", "upgrade")
# Operations that may add or remove the marker of an ended override.
_ENDING = ("follow", "upgrade", "expire-override")


def disallowed_files(commit: Commit, entry: LogEntry) -> Iterator[str]:
    """Yield the files that a commit of the generator changed, but was not allowed to change.

    These are files that people write, claims of demands that the message does not name, claims in
    another format than the generator's, and records that the commit's operation must not change.
    """
    if not commit.parents:  # `demandops init` writes everything
        return
    before, operation = commit.parents[0].tree, entry.first("Operation")
    demands = {*entry.trailers.get("Demand-Id", ())}
    for path in entry.trailers.get("Override", ()):  # claims that a `keep` override adds
        demands.add(OVERRIDE_PREFIX + path.rsplit("/", 1)[-1].removesuffix(".yaml"))
    named = {f"{claim_file.segment(demand)}.yaml" for demand in demands}
    for path, blob in trees.differences(before, commit.tree):
        root = path.split("/", 1)[0]
        if root in _OWN_ROOTS or (path == ROOT_FILE and operation == "upgrade"):
            continue
        if isinstance(trees.entry(commit.tree, path), Tree):  # the files in the folder count
            continue
        if root != claim_file.LEDGER_ROOT:
            yield path
        elif path.startswith(_RECORDS):
            if not _may_record(commit, path, operation):
                yield path
        elif path.rsplit("/", 1)[-1] in named:
            if blob and not _is_canonical(commit, path):
                yield path
        elif operation not in _REWRITING or not _only_rewrites(commit, path):
            yield path


def _only_rewrites(commit: Commit, path: str) -> bool:
    """Return whether a commit changed at most the schema of a claim and the start of its lease."""
    before, after = (
        ledger_files.valid_claim_at(tree, path) for tree in (commit.parents[0].tree, commit.tree)
    )
    if before is None or after is None:
        return False
    if before.lease and after.lease and after.lease.has_started > before.lease.has_started:
        before = replace(before, lease=replace(before.lease, until=after.lease.until))
    return before == after and _is_canonical(commit, path)


def _is_canonical(commit: Commit, path: str) -> bool:
    if path.startswith(f"{waiting.WAITING_ROOT}/"):
        text = trees.read_text(commit.tree, path) or ""
        waits = waiting.read(text, path)
        return waits is not None and waiting.text_of(waits) == text
    claim = ledger_files.valid_claim_at(commit.tree, path)
    return claim is not None and claim_file.text_of(claim) == trees.read_text(commit.tree, path)


def _may_record(commit: Commit, path: str, operation: str) -> bool:
    text = trees.read_text(commit.tree, path) or ""
    if path.startswith(f"{ended_override_file.MARKERS_ROOT}/"):
        return operation in _ENDING and (not text or bool(ended_override_file.read({path: text})))
    if path.startswith(f"{recent_shutdowns.SHUTDOWNS_ROOT}/"):
        return operation in _RECORDING
    record = kept_replicas.read(text, path)
    is_canonical = record is not None and kept_replicas.text_of(*record) == text
    return operation not in (*_REWRITING, *_ENDING) and (not text or is_canonical)
