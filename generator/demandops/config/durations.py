"""Durations and times for people: ``1h30m``, ``in 10m``, ``3m20s ago``."""

from __future__ import annotations

import re
from datetime import datetime

from demandops.quoting import quoted

_DURATION = re.compile(r"(?:([0-9]{1,9})d)?(?:([0-9]{1,9})h)?(?:([0-9]{1,9})m)?(?:([0-9]{1,9})s)?")
_UNITS = ((86_400, "d"), (3_600, "h"), (60, "m"), (1, "s"))
_YEAR_S = 366 * 86_400


def seconds_of(text: str) -> int:
    """Return the seconds of a duration like ``1h30m``; a ValueError says what is wrong with it."""
    match = _DURATION.fullmatch(text)
    if not text or match is None:
        raise ValueError(f"{quoted(text)} is not a duration; write one like 90s, 10m, 1h30m or 2d")
    pairs = zip(match.groups("0"), _UNITS, strict=True)
    seconds = sum(int(part) * size for part, (size, _) in pairs)
    if seconds > _YEAR_S:
        raise ValueError(f"'{text}' is longer than a year; choose a shorter duration")
    return seconds


def duration_text(seconds: float) -> str:
    """Return a duration, which is not negative, as text like ``1h30m``, rounded to seconds."""
    text, left = "", round(seconds)
    for size, name in _UNITS:
        whole, left = divmod(left, size)
        text += f"{whole}{name}" if whole else ""
    return text or "0s"


def span(seconds: float) -> str:
    """Return a duration without its sign, rounded down, in one or two units: ``12d``, ``3h20m``."""
    left = int(abs(seconds))
    for place, (size, unit) in enumerate(_UNITS):
        if left >= size or size == 1:
            whole, remainder = divmod(left, size)
            text = f"{whole}{unit}"
            if whole < 10 and size > 1:  # beside two digits, the next unit says nothing
                smaller, name = _UNITS[place + 1]
                text += f"{remainder // smaller}{name}" if remainder >= smaller else ""
            return text
    raise AssertionError("the smallest unit is one second")


def relative(moment: datetime, now: datetime) -> str:
    """Return a time relative to ``now``, like ``3m20s ago`` or ``in 10m``."""
    seconds = (moment - now).total_seconds()
    return f"in {span(seconds)}" if seconds >= 1 else f"{span(seconds)} ago"
