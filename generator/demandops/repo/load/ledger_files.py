"""Reads the claim files of a commit, and finds the claim files that differ between commits."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass

from pygit2 import Oid, Repository, Tree

from demandops.base import naming
from demandops.base.errors import Fault, InvalidInput, fault
from demandops.base.naming import Subject
from demandops.decide.rollback import Restoration
from demandops.model.demand.demand import Lease, Rollback
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger.claim import Claim, ClaimKey
from demandops.model.ledger.ledger import ClaimChange, Ledger
from demandops.render.gitops import CLUSTERS_ROOT
from demandops.repo.git import tree as trees
from demandops.repo.history import commit_log, commit_message


@dataclass(frozen=True, slots=True)
class ClaimFiles:
    claims: tuple[Claim, ...]
    faults: tuple[Fault, ...]

    def ledger(self) -> Ledger:
        ledger = Ledger()
        for claim in self.claims:
            ledger = ledger.replace(claim.key, claim)
        return ledger


def read_claims(files: Iterable[tuple[str, str]]) -> ClaimFiles:
    claims, faults = list[Claim](), list[Fault]()
    for path, text in files:
        if claim_files.kind_of(path) is None:
            continue
        try:
            claims.append(claim_files.read(text, path))
        except InvalidInput as error:
            faults += error.faults
    return ClaimFiles(tuple(claims), tuple(faults))


def claim_at(tree: Tree | None, path: str) -> Claim | None:
    text = trees.read_text(tree, path)
    return claim_files.read(text, path) if text is not None else None


def valid_claim_at(tree: Tree | None, path: str) -> Claim | None:
    try:
        return claim_at(tree, path)
    except InvalidInput:
        return None


def key_of(path: str, ledger: Ledger) -> ClaimKey | None:
    """Return the key of the claim whose file has this path; a search of the whole ledger."""
    if claim_files.kind_of(path) is None:
        return None
    # a path has slugs and digests of the ids, so it does not give the key
    return next((claim.key for claim in ledger if claim_files.path_of(claim.key) == path), None)


def owner_faults(claim: Claim | None, path: str, ledger: Ledger) -> Iterator[Fault]:
    # the generator books no such claim, but a person or an earlier version may replace the file
    owner = key_of(path, ledger) if claim and not ledger.get(claim.key) else None
    if claim is not None and owner is not None:
        message = (
            f"the file belongs to {owner.subject} of demand '{owner.demand}', but has a claim on "
            f"{claim.subject} of demand '{claim.demand}'; restore the file, and use other ids"
        )
        yield fault("", message, code="conflict").within(path)


def last_valid_claims(
    repo: Repository, last_valid_commit: Oid, to: Oid, paths: Iterable[str]
) -> dict[str, Claim | None]:
    # If the generator has changed a file since ``last_valid_commit``, the claim that it wrote last
    # counts, else the claim at that commit.
    tree = trees.commit_of(repo, last_valid_commit).tree
    claims = {path: claim_at(tree, path) for path in paths}
    left = set(claims)
    for commit, _ in commit_log.commits(repo, to, last_valid_commit) if left else ():
        before = trees.parent_tree(commit)
        changed = [path for path in left if trees.differ(before, commit.tree, (path,))]
        if before is not None and changed and commit_log.is_by_generator(repo, commit):
            for path in changed:
                with suppress(InvalidInput):  # only a forged commit has an invalid claim
                    claims[path] = claim_at(commit.tree, path)
                    left.remove(path)
    return claims


def lease_before_approval(repo: Repository, to: Oid, path: str) -> Lease | None:
    for commit in commit_log.first_parents(repo, to):
        claim = valid_claim_at(commit.tree, path)
        # a merged proposal's lease has not started; the one before it has
        if claim is None or claim.lease is None or claim.lease.has_started:
            return claim.lease if claim else None
    return None


def claims_by_people(
    repo: Repository, last_valid_commit: Oid, to: Oid, in_effect: Ledger
) -> list[ClaimChange]:
    """Return the valid claims that people added or edited, each with the last valid one before."""
    paths = {
        path
        for commit in commit_log.person_commits(repo, to, last_valid_commit)
        for path in changed_files(trees.parent_tree(commit), commit.tree)
    }
    tree = trees.commit_of(repo, to).tree
    written = {
        path: claim
        for path in sorted(paths)
        if (claim := valid_claim_at(tree, path)) and in_effect.get(claim.key) != claim
    }
    booked = last_valid_claims(repo, last_valid_commit, to, written)
    changes = (ClaimChange(booked[path], claim) for path, claim in written.items())
    return [change for change in changes if change.before != change.after]


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
    files = read_claims(trees.texts(commit.tree, (claim_files.LEDGER_ROOT,)).items())
    if files.faults:
        raise InvalidInput(files.faults)
    return Restoration(
        to=str(commit.id),
        made=commit_log.time_of(commit),
        claims=files.claims,
        drop_newer=rollback.drop_newer,
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


def changes_node(repo: Repository, revision: str | Oid, node: str) -> bool:
    commit = trees.commit_of(repo, revision)
    before, after = trees.parent_tree(commit), commit.tree
    if before is None:
        return False
    folder = naming.object_name("", node)
    for path, _ in trees.differences(before, after, (CLUSTERS_ROOT,)):
        parts = path.split("/")
        if len(parts) == 5 and parts[3] == folder:
            return True
    claims = (
        valid_claim_at(tree, path)
        for path in changed_files(before, after)
        for tree in (before, after)
    )
    return any(claim is not None and claim.held.needs(node) for claim in claims)
