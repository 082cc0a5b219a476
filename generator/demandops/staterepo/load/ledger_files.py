"""Reads the claim files of a commit, and finds the claim files that differ between commits."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass

from pygit2 import Oid, Repository, Tree

from demandops import naming
from demandops.demand.claim import Claim, ClaimKey
from demandops.demand.lease import Lease
from demandops.errors import Fault, InvalidInput, fault
from demandops.ledger import claim_file
from demandops.ledger.claim_changes import ClaimChange
from demandops.ledger.ledger import Ledger
from demandops.ledger.operations.restoration import Restoration
from demandops.render.gitops.paths import CLUSTERS_ROOT
from demandops.staterepo.git import tree as trees
from demandops.staterepo.history import commit_log
from demandops.subject import Subject


@dataclass(frozen=True, slots=True)
class ClaimFiles:
    """The claims that were read from files, and the faults of the files that are not valid."""

    claims: tuple[Claim, ...]
    faults: tuple[Fault, ...]

    def ledger(self) -> Ledger:
        """Return the ledger with these claims."""
        ledger = Ledger()
        for claim in self.claims:
            ledger = ledger.replace(claim.key, claim)
        return ledger


def read(files: Iterable[tuple[str, str]]) -> ClaimFiles:
    """Return the claims and the faults in files, which are given as (path, text).

    Files that are not claim files are skipped.
    """
    claims, faults = list[Claim](), list[Fault]()
    for path, text in files:
        if claim_file.kind_of(path) is None:
            continue
        try:
            claims.append(claim_file.read(text, path))
        except InvalidInput as error:
            faults += error.faults
    return ClaimFiles(tuple(claims), tuple(faults))


def claim_at(tree: Tree | None, path: str) -> Claim | None:
    """Return the claim at a path, or None if there is no file.

    Raises InvalidInput if the file is not valid.
    """
    text = trees.read_text(tree, path)
    return claim_file.read(text, path) if text is not None else None


def valid_claim_at(tree: Tree | None, path: str) -> Claim | None:
    """Return the claim at a path, or None if there is no valid file."""
    try:
        return claim_at(tree, path)
    except InvalidInput:
        return None


def key_of(path: str, ledger: Ledger) -> ClaimKey | None:
    """Return the key of the ledger's claim whose file has this path, or None.

    This searches the whole ledger.
    """
    if claim_file.kind_of(path) is None:
        return None
    return next((one.key for one in ledger if claim_file.path_of(one.key) == path), None)


def owner_faults(claim: Claim | None, path: str, ledger: Ledger) -> Iterator[Fault]:
    """Yield a fault if the file at ``path`` belonged to another claim before, that of ``ledger``.

    The generator books no such claim, but a person or an earlier version may replace the file.
    """
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
    """Return a map from each of ``paths`` to the last valid claim there, or None for no claim.

    If the generator has changed the file since ``last_valid_commit``, this is the claim that it
    wrote last. If not, this is the claim at ``last_valid_commit``.

    Args:
        repo: the repository.
        last_valid_commit: the newest commit with only valid files.
        to: the newest commit to consider.
        paths: the paths of claim files.
    """
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
    """Return the lease that a claim had on main before its proposal was merged.

    Return None if the claim did not exist then, or had no lease.
    """
    for commit in commit_log.first_parents(repo, to):
        claim = valid_claim_at(commit.tree, path)
        if claim is None or claim.lease is None or claim.lease.has_started:
            return claim.lease if claim else None
    return None


def claims_by_people(
    repo: Repository, last_valid_commit: Oid, to: Oid, known: Ledger
) -> list[ClaimChange]:
    """Return the valid claims that people added or edited, each with the last valid claim before.

    Args:
        repo: the repository.
        last_valid_commit: the newest commit with only valid files; only later changes count.
        to: the newest commit to consider.
        known: the ledger in effect until now; a claim that is the same there is left out.
    """
    paths = {
        path
        for commit in commit_log.person_commits(repo, to, last_valid_commit)
        for path in changed_files(trees.parent_tree(commit), commit.tree)
    }
    tree = trees.commit_of(repo, to).tree
    found = ((path, valid_claim_at(tree, path)) for path in sorted(paths))
    written = {path: claim for path, claim in found if claim and known.get(claim.key) != claim}
    booked = last_valid_claims(repo, last_valid_commit, to, written)
    changes = (ClaimChange(booked[path], claim) for path, claim in written.items())
    return [change for change in changes if change.before != change.after]


def added_by_people(repo: Repository, since: str, to: Oid) -> set[ClaimKey]:
    """Return the keys of the claims at ``to`` that people have added since a commit.

    Merges, and commits that keep the trailers of a proposal, are left out. Return an empty set if
    the repository lacks the commit ``since``.
    """
    if not since or since not in repo:
        return set()
    before, after = trees.commit_of(repo, since).tree, trees.commit_of(repo, to).tree
    paths = {
        path
        for commit in commit_log.person_commits(repo, to, since)
        if len(commit.parents) == 1
        and commit_log.PROPOSAL not in commit_log.entry_of(commit).trailers
        for path in changed_files(commit.parents[0].tree, commit.tree)
    }
    claims = (valid_claim_at(after, path) for path in paths if not trees.entry(before, path))
    return {claim.key for claim in claims if claim}


def restoration(repo: Repository, to: str, **more: object) -> Restoration:
    """Return the request to roll back to the ledger of the commit ``to``.

    ``more`` are the other fields of the request. Raises InvalidInput with the faults of all claim
    files if some are not valid, and StateRepoError if there is no such commit.
    """
    commit = trees.commit_of(repo, to)
    found = read(trees.texts(commit.tree, (claim_file.LEDGER_ROOT,)).items())
    if found.faults:
        raise InvalidInput(found.faults)
    return Restoration(
        id="",
        to=str(commit.id),
        made=commit_log.time_of(commit),
        claims=found.claims,
        **more,  # type: ignore[arg-type]
    )


def changed_subjects(before: Ledger, after: Ledger) -> list[Subject]:
    """Return the subjects whose claims differ between two ledgers, sorted."""
    old, new = before.claims, after.claims
    return sorted((one for one in {*old, *new} if old.get(one) != new.get(one)), key=str)


def changed_files(before: Tree | None, after: Tree) -> Iterator[str]:
    """Yield the paths of the claim files that differ between two trees, sorted."""
    changed = trees.differences(before, after, (claim_file.LEDGER_ROOT,))
    return (path for path, _ in changed if claim_file.kind_of(path) is not None)


def changes_node(repo: Repository, revision: str | Oid, node: str) -> bool:
    """Return whether a commit changed a release on a node, or a claim that names the node.

    For the first commit of the history, return false.
    """
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
