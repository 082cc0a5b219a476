"""What all forges have in common: a request to merge a branch, and what can be done with it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

RequestState = Literal["open", "merged", "closed"]


@dataclass(frozen=True, slots=True)
class PullRequest:
    """A request to merge a branch: its number, where a person finds it, what became of it."""

    number: int
    link: str
    state: RequestState


class Forge(Protocol):
    """A project on a forge. Every method raises ``ForgeError`` where the forge does not comply."""

    def open(self, branch: str, target: str, title: str, body: str) -> PullRequest:
        """Return the request for a branch, or a new one where there was none.

        A branch is never proposed twice, so one that was closed is not opened again.
        """

    def find(self, branch: str, target: str) -> PullRequest | None:
        """Return the newest request for a branch, whatever became of it."""

    def close(self, request: PullRequest) -> None:
        """Close a request without merging it."""
