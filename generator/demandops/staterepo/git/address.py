"""The address of a state repo: a folder or a URL, and which URLs are allowed."""

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
    """Return ``text`` without the user part of its URLs, which may hold a password."""
    return _USER.sub(r"\1", _HAS_PASSWORD.sub(r"\1", text))


def is_url(address: str) -> bool:
    """Return whether this is a Git URL (``https://…``, ``ssh://…``, ``user@host:path``)."""
    return not Path(address).exists() and bool(_SCHEME.match(address) or _SCP.match(address))


def check_url(url: str) -> None:
    """Refuse a URL that git accepts but a generator should not use.

    Raises:
        StateRepoError: the URL has another scheme or holds a password.
    """
    scheme = _SCHEME.match(url)
    if scheme and (scheme[2] == "::" or scheme[1] not in _ALLOWED):
        raise StateRepoError(
            f"a state repo's address cannot start with '{scheme[0]}'; use https, ssh, git or file"
        )
    if _HAS_PASSWORD.search(url):
        raise StateRepoError(
            "the state repo's address holds a password, which process lists would show; remove "
            "it and use a credential helper, ~/.netrc or an SSH key"
        )
