"""Points in history as people write them: a revision that Git knows, or a time.

A time means the newest commit along the first parents that was committed at or before this time.
A date means the end of its day, and a time without seconds the end of its minute. A time without a
zone is UTC, like all times that the program prints.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import datetime, timedelta, timezone

import pygit2
from pygit2 import Commit, Object, Oid, Reference, Repository

from demandops.config.durations import seconds_of
from demandops.errors import StateRepoError
from demandops.settings import MAIN_BRANCH
from demandops.staterepo.history import commit_log

TIMES = "2026-01-31T14:03, 2026-01-31, 14:03 (all UTC) or 2h (two hours ago)"
"""Examples of the times that :func:`parse_time` accepts."""

_DATE = re.compile(r"\d{4}-\d{2}-\d{2}")
_CLOCK = re.compile(r"\d{1,2}:\d{2}(:\d{2})?")
_DAY, _MINUTE, _SECOND = timedelta(days=1), timedelta(minutes=1), timedelta(seconds=1)
_MAIN = re.compile(rf"^(?:HEAD|{MAIN_BRANCH})(?=$|[~^@])")


def parse_time(text: str, now: datetime, *, end: bool = False) -> datetime | None:
    """Return the time that a text names, or None.

    Args:
        text: a date, a time of day, a date with a time of day, or a duration before ``now``
            (``2h``, ``1h30m``, ``2d ago``). A time of day without a date means its last occurrence
            before ``now``.
        now: the current time, with a time zone.
        end: if true, a date means the end of its day, and a time without seconds means the end of
            its minute. If false, they mean the beginning.
    """
    text = text.strip()
    try:
        return now - timedelta(seconds=seconds_of(text.removesuffix("ago").rstrip()))
    except ValueError:
        pass
    precision = _precision(text)
    clock = _CLOCK.fullmatch(text)
    if clock:
        hours, minutes = text.split(":", 1)
        text = f"{now.astimezone(timezone.utc):%Y-%m-%d}T{hours:0>2}:{minutes}"
    try:
        time = datetime.fromisoformat(re.sub(r"[Zz]$", "+00:00", text))
        zone = time.tzinfo or timezone.utc
        time = time.replace(tzinfo=zone).astimezone(timezone.utc)
    except (ValueError, OverflowError):
        return None
    if clock and time > now:
        time -= _DAY
    return time + (precision - _SECOND) if end else time


def _precision(text: str) -> timedelta:
    if _DATE.fullmatch(text):
        return _DAY
    clock = re.split(r"[T ]", text)[-1]
    return _MINUTE if re.match(r"\d{1,2}:\d{2}(?!:?\d)", clock) else _SECOND


def resolve(repo: Repository, tip: Oid, text: str, now: datetime) -> Commit:
    """Return the commit that a revision or a time names, or raise StateRepoError.

    A text is first looked up as the name of a branch or tag, then as a time, then as any other
    revision, in which ``HEAD`` and ``main`` mean ``tip``.
    """
    named = _found(repo.lookup_reference_dwim, text)
    if named is not None:
        return named
    at = parse_time(text, now, end=True)
    if at is not None:
        return commit_at_time(repo, tip, at)
    found = _found(repo.revparse_single, _MAIN.sub(str(tip), text))
    if found is None:
        raise StateRepoError(
            f"'{text}' is neither a commit of the state repo nor a time; `demandops log` lists the "
            f"commits; write a time like {TIMES}"
        )
    return found


def commit_at_time(repo: Repository, tip: Oid, at: datetime) -> Commit:
    """Return the newest commit along the first parents that was committed at or before ``at``.

    Raises StateRepoError if all commits are later.
    """
    latest = int(at.timestamp())
    for commit in commit_log.first_parents(repo, tip):
        if commit.commit_time <= latest:
            return commit
    first = commit_log.time_of(commit)
    raise StateRepoError(
        f"at {format_time(at)} the state repo did not exist yet; its first commit is of "
        f"{format_time(first)}"
    )


def format_time(at: datetime) -> str:
    """Return a time as messages show it: ``2026-01-31 14:03:00 UTC``."""
    return at.astimezone(timezone.utc).strftime("%Y-%m-%d %H:%M:%S UTC")


def _found(find: Callable[[str], Reference | Object], text: str) -> Commit | None:
    try:
        return find(text).peel(Commit)
    except (KeyError, ValueError, pygit2.GitError):
        return None
