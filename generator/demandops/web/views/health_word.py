"""The health of a release in one word, and the color of this word on the page."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime

from demandops.cluster.release_status import ReleaseStatus

# The words for a health, each with its color on the page, from the worst to the best health.
WORDS = {
    "failing": "bad",
    "waiting": "busy",
    "starting": "busy",
    "unknown": "none",
    "healthy": "good",
}

# The index of each word in `WORDS`; a lower index means worse health.
RANKS = {word: float(place) for place, word in enumerate(WORDS)}


def word_of(status: ReleaseStatus) -> str:
    if status.state == "unknown":
        return "unknown"
    if status.health.failing:
        return "failing"
    return {"healthy": "healthy", "reconciled": "starting", "waiting": "waiting"}[status.state]


def since_of(status: ReleaseStatus) -> datetime | None:
    """Return when a release's state last changed; None if the cluster reports no valid time."""
    try:  # Python 3.10 reads no "Z"
        since = datetime.fromisoformat(status.since.replace("Z", "+00:00"))
    except ValueError:
        return None
    return since if since.tzinfo else None


def worst_word(statuses: Iterable[ReleaseStatus]) -> str:
    """Return the word for the worst health of releases; ``unknown`` if there are no releases."""
    return min(map(word_of, statuses), key=RANKS.__getitem__, default="unknown")
