"""Proposals in the state repo: branches that a person merges to approve what they change.

On ``demand/…`` the generator proposes demands that need approval; on the others people propose
what commands would else commit to main. The generator rebuilds its branch if newer commits on main
make the branch outdated, and deletes the branch in the end. If a person added commits to it, the
generator neither rebuilds it nor deletes it after a merge. This module knows nothing of forges
except GitLab's push options and the link that GitLab prints.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache

from pygit2 import GitError, Oid, Repository, Tree

from demandops.base import naming
from demandops.base.errors import InvalidInput, StateRepoError
from demandops.base.quoting import quoted
from demandops.base.runtime import log
from demandops.base.settings import MAIN_BRANCH
from demandops.repo.git import tree as trees
from demandops.repo.git.remote_repository import RemoteRepository
from demandops.repo.git.repository import MAIN, PushDenied, StateRepository
from demandops.repo.git.tree import commit_of
from demandops.repo.history import commit_log, commit_message
from demandops.repo.load import ledger_files

PREFIX = "demand/"
# where people propose; a command that proposes something else adds its folder here
OF_PEOPLE = ("override/", "drain/", "undrain/", "revert/")
_PREFIXES = (PREFIX, *OF_PEOPLE)
_HEADS = "refs/heads/"
_NO_OPTIONS = re.compile(r"^fatal: the receiving end does not support push options", re.MULTILINE)
_LINK = re.compile(r"https?://\S+")


class BranchMoved(StateRepoError):
    """Raised when a branch is not at the commit where the generator left it."""

    def __init__(self, branch: str) -> None:
        super().__init__(f"{branch} was changed by someone other than the generator")


def branch_name(name: str, operation: str) -> str:
    return PREFIX + naming.slug_with_hash(name, operation, 12)


@dataclass(frozen=True, slots=True)
class BranchHeads:
    main: str  # empty if there is none
    branches: dict[str, str]  # of the proposals


class ProposalBranches:
    def __init__(self, repository: StateRepository) -> None:
        self._repository = repository
        self._remote = repository if isinstance(repository, RemoteRepository) else None

    def heads(self) -> BranchHeads:
        patterns = (f"{_HEADS}{prefix}*" for prefix in _PREFIXES)
        commits = self._repository.list_references(MAIN, *patterns)
        heads = {name.removeprefix(_HEADS): commit for name, commit in commits.items()}
        return BranchHeads(heads.pop(MAIN_BRANCH, ""), heads)

    def exists(self, branch: str) -> bool:
        # any branch, also one that does not begin with ``demand/``
        reference = f"{_HEADS}{branch}"
        return reference in self._repository.list_references(reference)

    def put(self, branch: str, commit: Oid, expected: str, options: Sequence[str] = ()) -> str:
        """Make a branch point to ``commit``, durably, and return the link that the server printed.

        Raises BranchMoved if the branch is not at ``expected``; if that is empty, the branch must
        not exist. Push options are left out if the server supports none.
        """
        with self._repository.new.packed(commit):
            return self._move(branch, commit, expected, options)

    def remove(self, branch: str, expected: str) -> None:
        self._move(branch, None, expected)

    def _move(
        self, branch: str, commit: Oid | None, expected: str, options: Sequence[str] = ()
    ) -> str:
        reference, wanted = f"{_HEADS}{branch}", str(commit or "")
        if self._remote is None:
            try:
                references = self._repository.objects.references
                # libgit2 moves or removes a branch only from where this reading has found it
                found = references.get(reference)
                now = str(found.target) if found else ""
                if now != expected and (now or commit is not None):
                    raise BranchMoved(branch)
                if commit is None:
                    if found:
                        found.delete()
                elif found:
                    found.set_target(commit, "demandops")
                else:
                    references.create(reference, commit)
            except (GitError, OSError) as error:
                raise self._why_denied(branch) or error from None
            return ""
        spec, lease = f"{wanted}:{reference}", f"{reference}:{expected}"
        pushed = self._remote.push(spec, lease, options)
        if pushed.took(reference):
            lines = [line for line in pushed.err.splitlines() if line.startswith("remote:")]
            links = [link[0] for line in lines if (link := _LINK.search(line))]
            # GitLab prints how to make a merge request, or the one that exists
            return next((link for link in links if "/merge_requests/" in link), "")
        if options and _NO_OPTIONS.search(pushed.err):
            return self._move(branch, commit, expected)
        now = self.heads().branches.get(branch, "")
        if now == wanted:
            return ""  # the push succeeded, but the answer was lost
        if now != expected:
            raise BranchMoved(branch)
        raise self._why_denied(branch) or self._remote.push_error(pushed, reference)

    def _why_denied(self, branch: str) -> PushDenied | None:
        folders = (branch[:end] for end, letter in enumerate(branch) if letter == "/")
        taken = next(filter(self.exists, folders), "")
        # Git may store each branch as a file, so that a branch ``a`` takes the folder of ``a/b``
        if not taken:
            return None
        return PushDenied(
            f"{self._repository.address} cannot have the branch {branch}, because it has a branch "
            f"{taken}; delete or rename {taken}, then try again"
        )

    def message(self, commit: str) -> str:
        try:
            return commit_of(self._repository.objects, commit).message
        except StateRepoError:
            return ""

    def is_up_to_date(
        self, tip: Oid, commit: str, base: str, files: Mapping[str, str | None]
    ) -> bool:
        """Return whether a proposal merges into main at ``tip`` cleanly, and changes ``files``.

        The proposal is ``commit``, made on ``base``. The demands would now change ``files``.
        """
        try:
            old, proposal, now, new = self._trees(tip, commit, base, files)
        except StateRepoError:
            return False
        proposed = dict(trees.differences(old, proposal))
        if proposed != dict(trees.differences(now, new)):
            return False
        return proposed.keys().isdisjoint(path for path, _ in trees.differences(old, now))

    def books_the_same(
        self, tip: Oid, commit: str, base: str, files: Mapping[str, str | None]
    ) -> bool:
        # leases aside; also true if the proposal is unknown
        try:
            old, proposal, now, new = self._trees(tip, commit, base, files)
        except StateRepoError:
            return True
        paths = {*ledger_files.changed_files(old, proposal), *ledger_files.changed_files(now, new)}
        pairs = (map(ledger_files.valid_claim_at, (proposal, new), (path,) * 2) for path in paths)
        return all((a and a.booked) == (b and b.booked) for a, b in pairs)

    def _trees(
        self, tip: Oid, commit: str, base: str, files: Mapping[str, str | None]
    ) -> tuple[Tree, Tree, Tree, Tree]:
        # StateRepoError is raised if the clone was made again, or `git gc` removed the commit
        objects = self._repository.objects
        old, proposal, now = (commit_of(objects, each).tree for each in (base, commit, tip))
        return old, proposal, now, objects[self._repository.new.add_tree(now, files)].peel(Tree)


@dataclass(frozen=True, slots=True)
class PendingProposal:
    branch: str
    commit: str  # the newest of the branch, perhaps by a person
    author: str
    summary: str
    since: datetime  # when the first demand was received
    requesters: tuple[str, ...]
    demands: tuple[str, ...]
    operations: tuple[str, ...]
    required_by: tuple[str, ...] = ()
    # the branch and the commit where the demand waited before it was changed
    replaces: tuple[str, ...] = ()

    def require(self, commit: str) -> None:
        # whoever may push to the branch finds another commit with the same 10 digits in minutes
        if commit != self.commit:
            remedy = "if it has changed since, look at it again"
            if commit and self.commit.startswith(commit):
                remedy = "give the whole id, because another commit may begin with these digits"
            message = f"{self.branch} is at commit {self.commit}, not at {quoted(commit)}; {remedy}"
            raise InvalidInput.at("", message)


def pending_proposals(repository: StateRepository) -> Iterator[PendingProposal]:
    # those whose commits are not on main, sorted by branch
    if isinstance(repository, RemoteRepository):
        repository.fetch_branches(*_PREFIXES)
    space = _HEADS if repository.main_reference == MAIN else "refs/remotes/origin/"
    repo = Repository(repository.objects.path)
    main, folders = repository.tip(), tuple(f"{space}{prefix}" for prefix in _PREFIXES)
    for name in sorted(name for name in repo.references if name.startswith(folders)):
        try:
            head = repo.references[name].resolve().target
            commits = list(commit_log.commits(repo, head, main))
        except (KeyError, ValueError, TypeError, GitError, StateRepoError):
            _warn_of_unreadable(name)
            continue
        branch = name.removeprefix(space)
        entries = [entry for _, entry in commits]
        if branch.startswith(PREFIX):
            entries = [entry for entry in entries if commit_message.PROPOSAL in entry.trailers]
        if not entries:
            continue
        yield PendingProposal(
            branch=branch,
            commit=str(head),
            author=entries[0].author,
            summary=entries[0].summary,
            since=entries[-1].authored or entries[-1].time,
            requesters=_all_of(entries, "Requester"),
            demands=_all_of(entries, "Demand-Id"),
            operations=_all_of(entries, "Operation-Id"),
            required_by=_all_of(entries, commit_message.REQUIRED_BY),
            replaces=_all_of(entries, commit_message.REPLACES),
        )


@lru_cache(maxsize=100)  # a page lists the proposals again and again
def _warn_of_unreadable(name: str) -> None:
    log.warning("the branch %s points to no commit that can be read; delete the branch", name)


def _all_of(entries: Iterable[commit_log.LogEntry], key: str) -> tuple[str, ...]:
    return tuple(sorted({value for entry in entries for value in entry.trailers.get(key, ())}))
