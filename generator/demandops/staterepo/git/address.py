"""Where a state repo is said to be: a folder or a URL, and which URLs are taken."""

from __future__ import annotations

import re
from pathlib import Path

from demandops.errors import StateRepoError

_SCHEME = re.compile(r"^([A-Za-z][A-Za-z0-9+.-]*)(://|::)")
_SCP = re.compile(r"^([^/\s:]+:(?!:)|[^/\s:]+@\[[^\]/]+\]:)")
_ALLOWED = ("https", "http", "ssh", "git", "file", "git+ssh")
_HAS_PASSWORD = re.compile(r"(://)[^/@\s]*:(?!\d+/)\S*@")
_USER = re.compile(r"(://)[^/@\s]*@")


def without_secrets(text: str) -> str:
    """Return ``text`` with the user part of every URL taken out: it may hold a password."""
    return _USER.sub(r"\1", _HAS_PASSWORD.sub(r"\1", text))


def is_url(address: str) -> bool:
    """Tell a Git URL (``https://…``, ``ssh://…``, ``user@host:path``) from a folder."""
    return not Path(address).exists() and bool(_SCHEME.match(address) or _SCP.match(address))


def check_url(url: str) -> None:
    """Refuse a URL that git would take and a generator should not.

    Raises:
        StateRepoError: saying how to mend it.
    """
    scheme = _SCHEME.match(url)
    if scheme and (scheme[2] == "::" or scheme[1] not in _ALLOWED):
        raise StateRepoError(
            f"'{scheme[0]}' is no way to reach a state repo; use https, ssh, git or file"
        )
    if _HAS_PASSWORD.search(url):
        raise StateRepoError(
            "the state repo's address holds a password, which process lists would show; leave "
            "it out and give it to git by a credential helper, ~/.netrc or an SSH key"
        )
