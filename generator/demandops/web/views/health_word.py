"""The health of a release in one word, and the color of this word on the page."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime

from demandops.cluster.release_status import ReleaseStatus

WORDS = {
    "failing": "bad",
    "waiting": "busy",
    "starting": "busy",
    "unknown": "none",
    "healthy": "good",
}
"""Each word and its tone, the worst first."""

PLACES = {word: float(place) for place, word in enumerate(WORDS)}
"""The place of each word in the order of ``WORDS``."""


def word_of(status: ReleaseStatus) -> str:
    """Return the word for a status."""
    if status.state == "unknown":
        return "unknown"
    if status.health.failing:
        return "failing"
    return {"healthy": "healthy", "reconciled": "starting", "waiting": "waiting"}[status.state]


def since_of(status: ReleaseStatus) -> datetime | None:
    """Return the time since which a release has its state, if the cluster reports it."""
    try:
        return datetime.fromisoformat(status.since.replace("Z", "+00:00"))
    except ValueError:
        return None


def worst_word(statuses: Iterable[ReleaseStatus]) -> str:
    """Return the word for several releases; ``unknown`` if there are none."""
    return min(map(word_of, statuses), key=PLACES.__getitem__, default="unknown")
