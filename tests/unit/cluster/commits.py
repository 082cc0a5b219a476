"""A history whose commits are named by letters, in order."""

from __future__ import annotations

from collections.abc import Iterable


class Letters:
    """Its commits change nothing but what ``changing`` says: (commit, path)."""

    def __init__(self, changing: Iterable[tuple[str, str]] = ()) -> None:
        self._changing = list(changing)

    def includes(self, commit: str, other: str) -> bool:
        """Tell whether a commit is another or comes after it."""
        return commit >= other

    def unchanged(self, commit: str, other: str, path: str) -> bool:
        """Tell whether no commit between two changes a path."""
        first, last = sorted((commit, other))
        return not any(first < one <= last and path == changed for one, changed in self._changing)
