"""The commit to roll back to: its claims, and the configuration files that changed since."""

from __future__ import annotations

from datetime import datetime, timezone

from pygit2 import Oid, Repository

from demandops.config.config import CONFIG_ROOTS
from demandops.errors import InvalidInput
from demandops.ledger import claim_file
from demandops.ledger.operations.restoration import Restoration
from demandops.staterepo.git import tree as trees
from demandops.staterepo.git.tree import commit_of
from demandops.staterepo.load import ledger_files


def restoration(repo: Repository, to: str, **more: object) -> Restoration:
    """Return the request to roll back to a commit.

    Args:
        to: the commit.
        more: further fields of :class:`Restoration`.

    Raises:
        InvalidInput: every fault of that commit's claim files.
        StateRepoError: there is no such commit.
    """
    commit = commit_of(repo, to)
    found = ledger_files.read(trees.texts(commit.tree, (claim_file.LEDGER_ROOT,)).items())
    if found.faults:
        raise InvalidInput(found.faults)
    return Restoration(
        id="",
        to=str(commit.id),
        made=datetime.fromtimestamp(commit.commit_time, tz=timezone.utc),
        claims=found.claims,
        **more,  # type: ignore[arg-type]
    )


def config_files_changed_since(repo: Repository, commit: str | Oid, tip: str | Oid) -> list[str]:
    """Return the configuration files that changed since ``commit``."""
    before, after = commit_of(repo, commit).tree, commit_of(repo, tip).tree
    return sorted(path for path, _ in trees.differences(before, after, CONFIG_ROOTS))
