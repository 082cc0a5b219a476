"""Reads the claim files of a commit, and finds the claim files that differ between commits."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from pygit2 import Oid, Repository, Tree

from demandops.base.errors import Fault, InvalidInput, fault
from demandops.base.naming import Subject
from demandops.decide.booking import Restoration
from demandops.model.demand.demand import Rollback
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger.claim import Claim, ClaimKey
from demandops.model.ledger.ledger import Ledger
from demandops.repo.git import tree as trees
from demandops.repo.history import commit_log, commit_message


def read_claims(files: Iterable[tuple[str, str]]) -> tuple[list[Claim], list[Fault]]:
    claims, faults = list[Claim](), list[Fault]()
    for path, text in files:
        if claim_files.kind_of(path) is None:
            continue
        try:
            claims.append(claim_files.read(text, path))
        except InvalidInput as error:
            faults += error.faults
    return claims, faults


def claim_at(tree: Tree | None, path: str) -> Claim | None:
    child = trees.entry(tree, path)  # a folder or a submodule has no text, so it is no valid claim
    return claim_files.read(trees.text_of(child), path) if child is not None else None


def valid_claim_at(tree: Tree | None, path: str) -> Claim | None:
    try:
        return claim_at(tree, path)
    except InvalidInput:
        return None


def claim_in(path: str, ledger: Ledger) -> Claim | None:
    """Return the claim whose file has this path; a search of the whole ledger."""
    # a path has slugs and digests of the ids, so it does not give the key
    if claim_files.kind_of(path) is None:
        return None
    return next((claim for claim in ledger if claim_files.path_of(claim.key) == path), None)


def owner_faults(claim: Claim | None, was: Claim | None, path: str) -> Iterator[Fault]:
    # the generator books no such claim, but a person or an earlier version may replace the file
    if claim and was and claim.key != was.key:
        message = (
            f"the file belongs to {was.subject} of demand '{was.demand}', but has a claim on "
            f"{claim.subject} of demand '{claim.demand}'; restore the file, and use other ids"
        )
        yield fault("", message, code="conflict").within(path)


def as_last_written(repo: Repository, to: Oid, path: str) -> Claim | None:
    """Return the newest valid claim that a generator, or a merged proposal, wrote to a file.

    None if somebody has deleted it since.
    """
    for entry, _, exists in commit_log.changes_to(repo, to, path):
        if not exists:
            return None
        # a person's commit has no trailers
        claim = valid_claim_at(trees.commit_of(repo, entry.commit).tree, path)
        if entry.trailers and claim:
            return claim
    return None


def was_deleted(repo: Repository, path: str, after: Oid, to: Oid) -> bool:
    line = commit_log.first_parents(repo, to, after)
    return any(trees.entry(commit.tree, path) is None for commit in line)


def added_by_people(repo: Repository, since: str, to: Oid) -> set[ClaimKey]:
    if not since or since not in repo:
        return set()
    before, after = trees.commit_of(repo, since).tree, trees.commit_of(repo, to).tree
    paths = {
        path
        for commit in commit_log.person_commits(repo, to, since)
        # a merge, or what keeps a proposal's trailers, may add what a generator has proposed
        if len(commit.parents) == 1
        and commit_message.PROPOSAL not in commit_log.entry_of(commit).trailers
        for path in changed_files(commit.parents[0].tree, commit.tree)
    }
    claims = (valid_claim_at(after, path) for path in paths if not trees.entry(before, path))
    return {claim.key for claim in claims if claim}


def restoration(repo: Repository, rollback: Rollback) -> Restoration:
    commit = trees.commit_of(repo, rollback.to)
    texts = trees.texts(commit.tree, (claim_files.LEDGER_ROOT,))
    claims, faults = read_claims(texts.items())
    if faults:
        raise InvalidInput(faults)
    return Restoration(
        to=str(commit.id),
        claims=tuple(claims),
        drop_newer=rollback.drop_newer,
        demand=rollback.demand,
        application=rollback.application,
        reason=rollback.reason,
        by=rollback.by,
        email=rollback.email,
    )


def changed_subjects(before: Ledger, after: Ledger) -> list[Subject]:
    old, new = before.claims, after.claims
    return sorted((subj for subj in {*old, *new} if old.get(subj) != new.get(subj)), key=str)


def changed_files(before: Tree | None, after: Tree) -> Iterator[str]:
    changed = trees.differences(before, after, (claim_files.LEDGER_ROOT,))
    return (path for path, _ in changed if claim_files.kind_of(path) is not None)
