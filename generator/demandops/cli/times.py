"""Times for people: how long ago something was, or until it is."""

from __future__ import annotations

from datetime import datetime

_UNITS = ((86400, "d"), (3600, "h"), (60, "m"), (1, "s"))
_TWO_PARTS = 10


def span(seconds: float) -> str:
    """Return a duration like ``2d``, ``3h20m`` or ``45s``: its largest unit and perhaps the next.

    It has the second unit if the first has one digit.
    """
    left = int(abs(seconds))
    for place, (size, unit) in enumerate(_UNITS):
        if left >= size or size == 1:
            whole, rest = divmod(left, size)
            part = f"{whole}{unit}"
            if whole < _TWO_PARTS and size > 1:
                smaller, name = _UNITS[place + 1]
                part += f"{rest // smaller}{name}" if rest >= smaller else ""
            return part
    raise AssertionError("the smallest unit is one second")


def relative(moment: datetime, now: datetime) -> str:
    """Return ``3m20s ago`` or ``in 10m``."""
    seconds = (moment - now).total_seconds()
    return f"in {span(seconds)}" if seconds >= 1 else f"{span(seconds)} ago"
