"""Claims that a person changed and that cannot be planned: quarantined, file by file.

The edited file stays in the repo, for example a claim that names an unknown node, but the last
valid version of the claim is in effect. That is the version that the generator wrote last, even
if it wrote it after the edit.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from pygit2 import Repository
from pygit2.enums import SortMode

from demandops.decision import State, changeset_of_edit
from demandops.demand.claim import Claim
from demandops.errors import Fault, InvalidInput
from demandops.ledger import claim_file
from demandops.render.changes.changeset import FileReader
from demandops.staterepo.git import tree as trees
from demandops.staterepo.history import commit_message
from demandops.staterepo.load.snapshot import Snapshot
from demandops.subject import Subject


def quarantine_invalid(
    repo: Repository,
    snapshot: Snapshot,
    before: Snapshot,
    subjects: Iterable[Subject],
    read: FileReader,
) -> tuple[Snapshot, list[Subject], list[Fault]]:
    """Quarantine the subjects that cannot be planned with the new or the old configuration.

    Returns:
        The snapshot with the last valid claims, the subjects that are not quarantined, and the
        faults of those that are.
    """
    good, faults = [], list[Fault]()
    for subject in subjects:
        subject_faults = _faults(snapshot.state, before, subject, read)
        if subject_faults and _faults(
            replace(before.state, ledger=snapshot.state.ledger), before, subject, read
        ):
            faults += _located_in_claim_files(subject_faults, snapshot, before, subject)
            snapshot = _with_last_valid_claims(repo, snapshot, before, subject)
        else:
            good.append(subject)
    return snapshot, good, faults


def _faults(
    state: State, before: Snapshot, subject: Subject, read: FileReader
) -> tuple[Fault, ...]:
    try:
        changeset_of_edit(state, before.state.ledger, [subject], read)
    except InvalidInput as error:
        return error.faults
    return ()


def _located_in_claim_files(
    faults: Iterable[Fault], snapshot: Snapshot, before: Snapshot, subject: Subject
) -> list[Fault]:
    """Return faults of a subject, located in the file of a claim that changed."""
    claims = snapshot.state.ledger.claims_on(subject)
    changed = [claim for claim in claims if before.state.ledger.get(claim.key) != claim]
    paths = [claim_file.path_of(claim.key) for claim in (changed or claims)]
    return [fault.within(paths[0]) if paths else fault for fault in faults]


def _with_last_valid_claims(
    repo: Repository, snapshot: Snapshot, before: Snapshot, subject: Subject
) -> Snapshot:
    ledger, keys = snapshot.state.ledger, snapshot.keys
    claims = (*before.state.ledger.claims_on(subject), *ledger.claims_on(subject))
    known = {claim_file.path_of(claim.key): claim.key for claim in claims}
    generated = _claims_by_generator(repo, snapshot, before, known)
    for path, key in known.items():
        claim = generated[path] if path in generated else before.state.ledger.get(key)
        ledger = ledger.replace(key, claim)
        if claim is not None:
            keys = keys.insert(path, key)
    quarantined = tuple(dict.fromkeys((*snapshot.quarantined_files, *known)))
    return replace(
        snapshot,
        state=replace(snapshot.state, ledger=ledger),
        keys=keys,
        quarantined_files=quarantined,
    )


def _claims_by_generator(
    repo: Repository, snapshot: Snapshot, before: Snapshot, paths: Iterable[str]
) -> dict[str, Claim | None]:
    """Return path → the claim that a generator last wrote there since ``before``."""
    walker = repo.walk(snapshot.commit, SortMode.TOPOLOGICAL)
    walker.hide(before.commit)
    claims: dict[str, Claim | None] = {}
    left = set(paths)
    for commit in walker:
        if not commit.parents or not commit_message.is_by_generator(commit.message):
            continue
        old, new = commit.parents[0].tree, commit.tree
        for path in sorted(left):
            if trees.blob_id(old, path) != trees.blob_id(new, path):
                claims[path] = _claim(trees.read_text(new, path), path)
                left.remove(path)
    return claims


def _claim(text: str | None, path: str) -> Claim | None:
    return claim_file.read(text, path) if text is not None else None
