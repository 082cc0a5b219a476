"""State repos that are only read: a person's checkout, and the last fetch of a URL."""

from __future__ import annotations

from pathlib import Path

import pygit2
from pygit2 import Oid, Repository

from demandops.errors import StateRepoError
from demandops.settings import MAIN_BRANCH
from demandops.staterepo.git.local_repository import LocalRepository
from demandops.staterepo.git.repository import PushDenied


def is_checkout(folder: Path) -> bool:
    return (folder / ".git").exists() and (folder / "demandops.yaml").is_file()


def checkout_around(folder: Path) -> Path | None:
    """Return the nearest checkout of a state repo, from ``folder`` upwards."""
    return next(filter(is_checkout, (folder, *folder.parents)), None)


def origin_of(checkout: Path) -> str | None:
    try:
        remotes = {remote.name: remote.url for remote in Repository(str(checkout)).remotes}
    except pygit2.GitError:
        return None
    return remotes.get("origin")


class Checkout(LocalRepository):
    """A checkout: its tip is the commit that is checked out, on any branch."""

    main_reference = "HEAD"
    branches = "refs/remotes/origin/"

    def tip(self) -> Oid:
        target = self.objects.head.target
        assert isinstance(target, Oid)  # noqa: S101 - HEAD is resolved
        return target

    def _require_usable(self, path: Path) -> None:
        if self.objects.is_empty or self.objects.head_is_unborn:
            raise StateRepoError(f"{path} has no commit yet; commit its files first")

    def publish(self, expected: Oid, commit: Oid) -> bool:
        # a person may be editing the files, and would commit back what a demand has changed
        raise PushDenied(
            f"{self.address} is a checkout, and no command writes to a checkout; name the "
            "checkout's remote instead"
        )


class LastFetch(LocalRepository):
    """The clone of a URL at its last fetch, for readers that must not wait for the network."""

    main_reference = f"refs/remotes/origin/{MAIN_BRANCH}"
    branches = "refs/remotes/origin/"

    def _require_usable(self, path: Path) -> None:
        pass  # the process that made the clone has checked it
