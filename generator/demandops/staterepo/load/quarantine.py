"""Claims that a person changed and that cannot be carried out: they are held back, file by file.

A claim that a person edited so that it names an unknown node, say, is in the repo as they left it
and not in force. What the generator booked on the same subject is, also where it came later: so a
file is held at the generator's last version of it, and not at what the whole subject once was.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from pygit2 import Repository
from pygit2.enums import SortMode

from demandops.decision import State, consequence
from demandops.demand.claim import Claim, Subject
from demandops.errors import Fault, InvalidInput
from demandops.ledger import claim_file as ledger_format
from demandops.render.changes.changeset import Read
from demandops.staterepo.git import tree as trees
from demandops.staterepo.history import commit_message
from demandops.staterepo.load.snapshot import Snapshot


def quarantine_invalid(
    repo: Repository, snapshot: Snapshot, before: Snapshot, subjects: Iterable[Subject], read: Read
) -> tuple[Snapshot, list[Subject], list[Fault]]:
    """Hold back what of ``subjects`` cannot be planned, neither as configured now nor as before.

    Returns:
        The snapshot with the last versions that could be in force, the subjects that are as their
        files say, and what is wrong with the others.
    """
    good, faults = [], list[Fault]()
    for subject in subjects:
        found = _faults(snapshot.state, before, subject, read)
        if found and _faults(
            replace(before.state, ledger=snapshot.state.ledger), before, subject, read
        ):
            faults += _located_in_claim_files(found, snapshot, before, subject)
            snapshot = _with_last_valid_claims(repo, snapshot, before, subject)
        else:
            good.append(subject)
    return snapshot, good, faults


def _faults(state: State, before: Snapshot, subject: Subject, read: Read) -> tuple[Fault, ...]:
    try:
        consequence(state, before.state.ledger, [subject], read)
    except InvalidInput as error:
        return error.faults
    return ()


def _located_in_claim_files(
    faults: Iterable[Fault], snapshot: Snapshot, before: Snapshot, subject: Subject
) -> list[Fault]:
    """Return faults of a subject, each told to be in the file of a claim that is another now."""
    claims = snapshot.state.ledger.of(subject)
    changed = [claim for claim in claims if before.state.ledger.get(claim.key) != claim]
    paths = [ledger_format.path_of(claim.key) for claim in (changed or claims)]
    return [found.within(paths[0]) if paths else found for found in faults]


def _with_last_valid_claims(
    repo: Repository, snapshot: Snapshot, before: Snapshot, subject: Subject
) -> Snapshot:
    ledger, keys = snapshot.state.ledger, snapshot.keys
    claims = (*before.state.ledger.of(subject), *ledger.of(subject))
    known = {ledger_format.path_of(claim.key): claim.key for claim in claims}
    ours = _claims_by_generator(repo, snapshot, before, known)
    for path, key in known.items():
        claim = ours[path] if path in ours else before.state.ledger.get(key)
        ledger = ledger.replace(key, claim)
        if claim is not None:
            keys = keys.insert(path, key)
    held = tuple(dict.fromkeys((*snapshot.quarantined_files, *known)))
    return replace(
        snapshot, state=replace(snapshot.state, ledger=ledger), keys=keys, quarantined_files=held
    )


def _claims_by_generator(
    repo: Repository, snapshot: Snapshot, before: Snapshot, paths: Iterable[str]
) -> dict[str, Claim | None]:
    """Return what a generator last wrote to the paths since ``before``, where one did."""
    walker = repo.walk(snapshot.commit, SortMode.TOPOLOGICAL)
    walker.hide(before.commit)
    found: dict[str, Claim | None] = {}
    left = set(paths)
    for commit in walker:
        if not commit.parents or not commit_message.is_by_generator(commit.message):
            continue
        old, new = commit.parents[0].tree, commit.tree
        for path in sorted(left):
            if trees.blob_id(old, path) != trees.blob_id(new, path):
                found[path] = _claim(trees.read_text(new, path), path)
                left.remove(path)
    return found


def _claim(text: str | None, path: str) -> Claim | None:
    return ledger_format.read(text, path) if text is not None else None
