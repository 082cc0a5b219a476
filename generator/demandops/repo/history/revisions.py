"""Points in history as people write them: a branch, a tag, an id, or a time.

A time means the newest commit along the first parents that was committed at or before this time.
A date means the end of its day, and a time without seconds the end of its minute. A time without a
zone is UTC, like all times that the program prints.
"""

from __future__ import annotations

import re
from datetime import datetime, timedelta, timezone
from itertools import islice

import pygit2
from pygit2 import Commit, Oid, Repository

from demandops.base.errors import StateRepoError
from demandops.base.quoting import quoted
from demandops.model.config.base_model import seconds_of
from demandops.repo.git.tree import commit_of
from demandops.repo.history import commit_log
from demandops.repo.history.commit_message import time_text

# Examples of the times that parse_time accepts.
TIMES = "2026-01-31T14:03, 2026-01-31, 14:03 (all UTC) or 2h (two hours ago)"

_DATE = re.compile(r"\d{4}-\d{2}-\d{2}")
_CLOCK = re.compile(r"\d{1,2}:\d{2}(:\d{2})?")
_DAY, _MINUTE, _SECOND = timedelta(days=1), timedelta(minutes=1), timedelta(seconds=1)
_REVISION = re.compile(r"([^~^]+)((?:\^|~[0-9]{0,9})*)")
_STEP = re.compile(r"[~^]([0-9]*)")
_ID = re.compile(r"[0-9A-Fa-f]{4,40}")
_WHOLE_ID = 40
_SPACES = ("refs/", "refs/tags/", "refs/heads/", "refs/remotes/")
_BRANCHES_AND_TAGS = ("refs/heads/", "refs/tags/", "refs/remotes/")
_LONGEST = 250  # bytes; a file system takes no longer name of a branch


def parse_time(text: str, now: datetime, *, end: bool = False) -> datetime | None:
    """Return the time that a date, a time of day, both, or a duration before ``now`` names.

    A time of day without a date means its last occurrence before ``now``. With ``end``, a date
    means the end of its day, and a time without seconds the end of its minute.
    """
    text = text.strip()
    try:
        return now - timedelta(seconds=seconds_of(text.removesuffix("ago").rstrip()))
    except ValueError:
        pass
    has_no_seconds = re.match(r"\d{1,2}:\d{2}(?!:?\d)", re.split(r"[T ]", text)[-1])
    precision = _DAY if _DATE.fullmatch(text) else _MINUTE if has_no_seconds else _SECOND
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


def resolve(repo: Repository, tip: Oid, text: str, now: datetime) -> Commit:
    # The text is from outside: a time, the name of a branch or tag, or 4 to 40 digits of an id. A
    # name or id may be followed by ``~N`` or ``^``, along the first parents. ``HEAD`` is ``tip``.
    # libgit2 never parses the text: its own grammar has searches, some of which crash it.
    text = text.strip(" ")
    is_plain = text.isprintable() and len(text.encode(errors="replace")) <= _LONGEST
    match = _REVISION.fullmatch(text) if is_plain else None
    try:
        commit = _commit_named(repo, tip, match[1], match[2], now) if match else None
    except (KeyError, ValueError, pygit2.GitError) as error:
        raise StateRepoError(
            f"{quoted(text)} names no commit that can be read: {error.args[0]}; name another "
            "commit, or check the repository with `git fsck`"
        ) from None
    if commit is None:
        raise StateRepoError(
            f"{quoted(text)} is neither a commit of the state repo nor a time; write a branch, a "
            "tag or 4 to 40 digits of an id, with ~N for the Nth commit before it, or a time like "
            f"{TIMES}; `demandops log` lists the commits"
        )
    return commit


def _commit_named(
    repo: Repository, tip: Oid, base: str, steps: str, now: datetime
) -> Commit | None:
    names = _names(repo, base)
    # a branch may be named like a time, such as 2026-01-31
    at = None if names or steps else parse_time(base, now, end=True)
    if at is not None:
        latest = int(at.timestamp())
        for commit in commit_log.first_parents(repo, tip):
            if commit.commit_time <= latest:
                return commit
        raise StateRepoError(
            f"at {time_text(at)} the state repo did not exist yet; its first commit is of "
            f"{time_text(commit_log.time_of(commit))}"
        )
    commits = {name: repo.references[name].peel(Commit) for name in names}
    if base == "HEAD":
        commits[base] = commit_of(repo, tip)
    elif _ID.fullmatch(base) and base.lower() in repo:
        named = repo[base.lower()]
        # digits that also begin the id of a file do not make a name ambiguous
        if not names or isinstance(named, Commit):
            commits[f"the commit {named.id}"] = named.peel(Commit)
    if len({commit.id for commit in commits.values()}) > 1:
        raise StateRepoError(
            f"{quoted(base)} is ambiguous: it means {' and '.join(commits)}; write the whole id, "
            "or a whole name that begins with refs/"
        )
    back = sum(int(count or 1) for count in _STEP.findall(steps))
    for commit in commits.values():
        walked = commit_log.first_parents(repo, commit.id)
        if (ancestor := next(islice(walked, back, None), None)) is None:
            raise StateRepoError(
                f"{quoted(base)} has fewer than {back} commits before it; write a smaller ~N"
            )
        return ancestor
    return None


def _names(repo: Repository, base: str) -> list[str]:
    # whoever may push a branch must not change what a whole id or HEAD means
    if base == "HEAD" or (len(base) == _WHOLE_ID and _ID.fullmatch(base)):
        return []
    valid = [
        name
        for name in (base, *(f"{space}{base}" for space in _SPACES))
        if name.startswith(_BRANCHES_AND_TAGS) and pygit2.reference_is_valid_name(name)
    ]
    names = [name for name in valid if name in repo.references]
    tracked = f"refs/remotes/origin/{base}"  # as in a clone, or a checkout of another branch
    return names or [tracked for _ in valid[:1] if tracked in repo.references]
