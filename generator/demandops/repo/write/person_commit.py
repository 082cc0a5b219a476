"""Commits that a command makes for a person: on main, or on a branch to be merged.

The person is author and committer, so a generator reads the commit like any other edit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime

from pygit2 import Blob, Commit, Oid, Tree
from pygit2.enums import FileMode

from demandops.base.errors import InvalidInput, StateRepoError
from demandops.base.quoting import one_line
from demandops.base.runtime import REAL
from demandops.base.settings import MAIN_BRANCH
from demandops.base.strict_yaml import with_lines
from demandops.decide.state import State
from demandops.model.config.config import CONFIG_ROOTS
from demandops.repo.git import tree as trees
from demandops.repo.git.objects import NewObjects
from demandops.repo.git.repository import MAIN, StateRepository
from demandops.repo.history import commit_message
from demandops.repo.history.commit_log import Person
from demandops.repo.load import snapshot as snapshots
from demandops.repo.load.snapshot import Files, Snapshot
from demandops.repo.write.proposal_branch import PendingProposal, ProposalBranches

_ATTEMPTS = 5
_PAUSE_S = 0.2


@dataclass(frozen=True, slots=True)
class CommitDetails:
    person: Person
    now: datetime
    summary: str
    reason: str = ""
    trailers: tuple[tuple[str, str], ...] = ()  # for programs; the reason may be one of them

    @property
    def text(self) -> str:
        if self.trailers:
            return commit_message.compose([[self.summary]], self.trailers)
        # the person's reason is as written: it may close an issue
        return commit_message.compose([[self.summary]], []) + (
            f"\n{one_line(self.reason)}\n" if self.reason else ""
        )


@dataclass(frozen=True, slots=True)
class Published:
    commit: str
    branch: str
    link: str = ""  # the address of the branch's merge request, if the server printed it


def commit_to_main(repository: StateRepository, files: Files, details: CommitDetails) -> Published:
    return _publish(repository, lambda tip: (files, [tip.id]), details)


def commit_to_branch(
    repository: StateRepository,
    files: Files,
    details: CommitDetails,
    branch: str,
    options: Sequence[str],
) -> Published:
    tip = trees.commit_of(repository.objects, repository.refresh())
    commit = _commit(repository, tip, files, [tip.id], details)
    branches = ProposalBranches(repository)
    if branches.exists(branch):
        raise StateRepoError(f"the branch {branch} exists already; merge or delete it first")
    link = branches.put(branch, commit, "", options)
    return Published(str(commit), branch, link)


def reject(
    repository: StateRepository, proposal: PendingProposal, details: CommitDetails
) -> Published:
    """Record on main, in a commit without files, that a person rejects a proposal."""
    trailers = commit_message.rejection_trailers(
        proposal.branch, proposal.commit, proposal.demands, proposal.requesters, details.reason
    )
    details = replace(details, trailers=tuple(trailers))

    def make(tip: Commit) -> tuple[Files, list[Oid]]:
        _require_unmoved(repository, proposal)
        return {}, [tip.id]

    return _publish(repository, make, details)


def _require_unmoved(repository: StateRepository, proposal: PendingProposal) -> None:
    # If the branch moves only after this, its commit is answered all the same: a demand that was
    # changed waits on another branch.
    if ProposalBranches(repository).heads().branches.get(proposal.branch) != proposal.commit:
        raise StateRepoError(
            f"{proposal.branch} is no longer at commit {proposal.commit}, so nothing was changed; "
            "look at the proposals again"
        )


def merge(
    repository: StateRepository, proposal: PendingProposal, details: CommitDetails
) -> Published:
    """Merge the commit of a proposal, which a person has seen, into main."""
    objects = repository.objects
    head = trees.commit_of(objects, proposal.commit)

    def make(tip: Commit) -> tuple[Files, list[Oid]]:
        _require_unmoved(repository, proposal)
        base = objects.merge_base(tip.id, head.id)
        if base is None:
            raise StateRepoError(
                f"{proposal.branch} and {MAIN_BRANCH} have no commit in common; reject the "
                "proposal with `demandops reject`, and send the demand again"
            )
        start = trees.commit_of(objects, base).tree
        proposed = [path for path, _ in trees.differences(start, head.tree)]
        if not {path for path, _ in trees.differences(start, tip.tree)}.isdisjoint(proposed):
            raise StateRepoError(
                f"{MAIN_BRANCH} and {proposal.branch} change the same files; wait until "
                "a running generator has made the branch anew, then try again; if the branch has "
                "commits by a person, the generator leaves it alone, so merge it with git"
            )
        for path in proposed:
            # files are written anew from their text, so a link or another encoding would be lost
            blob = trees.entry(head.tree, path)
            is_text = isinstance(blob, Blob) and trees.text_of(blob).encode() == blob.data
            if blob is not None and not (is_text and blob.filemode == FileMode.BLOB):
                raise StateRepoError(
                    f"{path} in {proposal.branch} is not a plain text file; merge the branch with "
                    "git"
                )
        texts = {path: trees.read_text(head.tree, path) for path in proposed}
        return texts, [tip.id, head.id]

    return _publish(repository, make, details)


def _publish(
    repository: StateRepository,
    make: Callable[[Commit], tuple[Files, list[Oid]]],
    details: CommitDetails,
) -> Published:
    for attempt in range(1, _ATTEMPTS + 1):
        tip = trees.commit_of(repository.objects, repository.refresh())
        files, parents = make(tip)
        commit = _commit(repository, tip, files, parents, details)
        if repository.publish(tip.id, commit):
            return Published(str(commit), MAIN_BRANCH)
        repository.new.forget()
        REAL.sleep(_PAUSE_S * attempt)
    if repository.always_current and repository.tip() == tip.id:
        raise StateRepoError(
            f"another program locks {MAIN_BRANCH} of {repository.address}, so nothing was changed; "
            f"try again; if no program writes there, remove {MAIN}.lock in it"
        )
    raise StateRepoError(
        f"{repository.address} got new commits during each of {_ATTEMPTS} attempts, so nothing was "
        "changed; try again"
    )


def _commit(
    repository: StateRepository,
    tip: Commit,
    files: Files,
    parents: list[Oid],
    details: CommitDetails,
) -> Oid:
    tree = repository.new.add_tree(tip.tree, files)
    changes_config = any(path.split("/", 1)[0] in CONFIG_ROOTS for path in files)
    if changes_config:
        _require_effect(repository, tip, files)
    who = commit_message.signature(*details.person, details.now)
    text = details.text
    try:
        config = snapshots.config_at(repository.objects[tree].peel(Tree))
        if config.repo_settings.signed_off_by:
            text = commit_message.signed_off(text, f"{who.name} <{who.email}>")
    except InvalidInput:
        if changes_config:
            raise
    return repository.new.add_commit(repository.signer, (who, who), text, tree, parents)


def state_after(repository: StateRepository, before: Snapshot, files: Files) -> State:
    """Return what would be in effect after a commit of these files, which nobody makes.

    If their configuration would not be valid, StateRepoError is raised if that of ``before`` is not
    valid either, else InvalidInput.
    """
    objects = repository.reopened()  # it gets the commit in memory
    new, tip = NewObjects(objects), trees.commit_of(objects, before.commit)
    who = commit_message.signature("A person", "person@demandops.invalid", REAL.now())
    tree = new.add_tree(tip.tree, files)
    commit = new.add_commit(None, (who, who), "", tree, [tip.id])
    after = snapshots.follow(objects, before, commit, REAL.now()).snapshot
    if after.faults and before.faults:
        raise StateRepoError(
            f"nothing of {MAIN_BRANCH}'s configuration is in effect, because it is not valid, so "
            f"nothing was changed: {snapshots.problems_of(objects, before)[0]}; first "
            f"{snapshots.how_to_mend(objects, before)}"
        )
    if after.faults:
        raise InvalidInput(with_lines(after.faults, files.get))
    return after.state


def _require_effect(repository: StateRepository, tip: Commit, files: Files) -> None:
    # what a person adds to a configuration that stays invalid would not be in effect either
    objects = repository.objects
    try:
        entry = snapshots.newest_of_generator(objects, tip.id)
        snapshots.config_at(tip.tree)
        if entry is None or not entry.first(snapshots.CONFIGURATION):
            return
    except InvalidInput:
        pass
    try:
        before = snapshots.state_at(objects, tip.id)
    except InvalidInput:
        return  # nothing is in effect yet, so the new files alone are judged
    if before.faults:
        state_after(repository, before, files)
