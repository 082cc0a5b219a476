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
"""Word for a health → its color on the page, from the worst to the best health."""

RANKS = {word: float(place) for place, word in enumerate(WORDS)}
"""Word → its index in ``WORDS``; a lower index means worse health."""


def word_of(status: ReleaseStatus) -> str:
    """Return the word for the health of a release."""
    if status.state == "unknown":
        return "unknown"
    if status.health.failing:
        return "failing"
    return {"healthy": "healthy", "reconciled": "starting", "waiting": "waiting"}[status.state]


def since_of(status: ReleaseStatus) -> datetime | None:
    """Return the time of the last change of a release's state; None if the cluster has none."""
    try:
        return datetime.fromisoformat(status.since.replace("Z", "+00:00"))
    except ValueError:
        return None


def worst_word(statuses: Iterable[ReleaseStatus]) -> str:
    """Return the word for the worst health of several releases; ``unknown`` without a release."""
    return min(map(word_of, statuses), key=RANKS.__getitem__, default="unknown")
