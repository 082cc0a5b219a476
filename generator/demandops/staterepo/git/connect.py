"""Where the state repo is: a bare repository on this disk, or anything that Git can clone.

Both give a pygit2 repository to read and write objects in and one way to publish a commit, which
succeeds only on top of what was there: never a forced push, never a merge of texts.
"""

from __future__ import annotations

from pathlib import Path

from demandops.errors import StateRepoError
from demandops.staterepo.git.address import check_url, is_url
from demandops.staterepo.git.local_repository import LocalRepository
from demandops.staterepo.git.remote_repository import Notify, RemoteRepository
from demandops.staterepo.git.repository import StateRepository


def connect(
    address: str, folder: Path, notify: Notify = lambda text: None, *, allow_offline: bool = False
) -> StateRepository:
    """Open the state repo at ``address``.

    Args:
        address: a folder with a bare repository, or any URL that git clones.
        folder: where the clone of a URL is kept.
        notify: told about work that takes a while.
        allow_offline: whether a clone that is here already will do where its remote is away.

    Raises:
        StateRepoError: saying what is wrong with the address and how to mend it.
    """
    if is_url(address):
        check_url(address)
        return RemoteRepository(address, folder / "clone.git", notify, allow_offline)
    path = Path(address).expanduser()
    if not path.is_dir():
        raise StateRepoError(
            f"{address} does not exist; make a state repo with `demandops init {address} --bare`"
        )
    return LocalRepository(path)
