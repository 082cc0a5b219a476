"""Opening the state repo: a bare repository on this disk, or a URL that Git can clone.

Both give a pygit2 repository to read and write objects, and one way to publish a commit. It
succeeds only on top of the current tip: no push is forced and no texts are merged.
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
        folder: the folder for the clone of a URL.
        notify: called with a text before work that takes a while.
        allow_offline: use an existing clone if its remote cannot be reached.

    Raises:
        StateRepoError: the address is not usable, or the remote cannot be reached.
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
