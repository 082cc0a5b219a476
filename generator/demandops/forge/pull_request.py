"""The interface of a forge: pull requests, and the operations on them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

RequestState = Literal["open", "merged", "closed"]


@dataclass(frozen=True, slots=True)
class PullRequest:
    """A request to merge a branch: its number, its web page and its state."""

    number: int
    link: str
    state: RequestState


class Forge(Protocol):
    """A project on a forge. Every method raises ``ForgeError`` if the forge fails or refuses."""

    def open(self, branch: str, target: str, title: str, body: str) -> PullRequest:
        """Return the pull request for a branch; open one if there is none.

        A branch gets only one pull request, so a closed one is not opened again.
        """

    def find(self, branch: str, target: str) -> PullRequest | None:
        """Return the newest pull request for a branch in any state, or ``None``."""

    def close(self, request: PullRequest) -> None:
        """Close a pull request without merging it."""
