"""Opens a state repo by its address: a folder, or a URL that Git can clone."""

from __future__ import annotations

import re
from pathlib import Path

from demandops.base.errors import StateRepoError
from demandops.base.quoting import quoted
from demandops.repo.git.local_repository import Checkout, LocalRepository, is_checkout
from demandops.repo.git.remote_repository import HAS_PASSWORD, HAS_TOKEN, Notify, RemoteRepository
from demandops.repo.git.repository import StateRepository

_SCHEME = re.compile(r"^([A-Za-z][A-Za-z0-9+.-]*)(://|::)")
_SCP = re.compile(r"^([^/\s:]+:(?!:)|[^/\s:]+@\[[^\]/]+\]:)")
_NO_HOST = re.compile(r"^(https?|ssh|git|git\+ssh)://([^/@]*@)?(:\d*)?(/|$)")
_ALLOWED = ("https", "http", "ssh", "git", "file", "git+ssh")


def is_url(address: str) -> bool:
    """Return whether an address is a Git URL (``https://…``, ``ssh://…``, ``user@host:path``)."""
    try:
        exists = Path(address).exists()
    except OSError:  # the address is too long, or in a folder that this user cannot read
        exists = False
    # like git, which takes an existing folder ``a:b`` for a folder
    return not exists and bool(_SCHEME.match(address) or _SCP.match(address))


def connect(
    address: str,
    folder: Path,
    notify: Notify = lambda text: None,
    *,
    allow_offline: bool = False,
    only_read: bool = False,
) -> StateRepository:
    """Return the state repo at an address.

    Args:
        address: the folder of a repository in which main is not checked out, such as a bare one,
            or a URL.
        folder: the folder in which the clone of a URL is made.
        notify: called with a text before work that takes a while.
        allow_offline: whether an existing clone may be used if its remote cannot be reached.
        only_read: whether the address may also be the folder of a checkout.
    """
    if is_url(address):
        _check_url(address)
        return RemoteRepository(address, folder / "clone.git", notify, allow_offline)
    try:
        path = Path(address).expanduser()
        is_folder, exists = path.is_dir(), path.exists()
        is_read_only = is_checkout(path) and only_read
    except (OSError, ValueError, RuntimeError) as error:  # for example ``~x`` without a user x
        reason = getattr(error, "strerror", None) or str(error)
        raise StateRepoError(
            f"{quoted(address)} cannot be opened: {reason}; name the folder of a state repo"
        ) from None
    if exists and not is_folder:
        raise StateRepoError(f"{address} is not a folder; name the folder of a state repo")
    if not is_folder:
        place = "" if path.is_absolute() else f" in {Path.cwd()}"
        raise StateRepoError(
            f"{address} does not exist{place}; correct the path, or make a state repo there with "
            f"`demandops init {address} --bare`"
        )
    return Checkout(path) if is_read_only else LocalRepository(path)


def _check_url(url: str) -> None:
    scheme = _SCHEME.match(url)
    # git would start a program for other schemes: ``ext::COMMAND``, or git-remote-SCHEME
    if scheme and (scheme[2] == "::" or scheme[1] not in _ALLOWED):
        raise StateRepoError(
            f"a state repo's address cannot start with '{scheme[0]}'; use https, ssh, git or file"
        )
    if HAS_PASSWORD.search(url) or HAS_TOKEN.match(url):
        raise StateRepoError(
            "the state repo's address holds a password or token, which process lists would show; "
            "remove it and use a credential helper, ~/.netrc or an SSH key"
        )
    if no_host := _NO_HOST.match(url):
        raise StateRepoError(
            f"the state repo's address names no host after '{no_host[1]}://'; write "
            f"{no_host[1]}://HOST/PATH, or the folder of a bare repository"
        )
