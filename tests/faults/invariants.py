"""What must hold after a fault: an acknowledged demand is booked once, and none is half booked."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from tests.faults.rig import Ran, Rig, commits_by_demand
from tests.kit.repo import fsck, git

DEMAND, NEXT = 1, 2
_DONE, _REFUSED, _UNSOUND, _INTERRUPTED = 0, 1, 3, 130
_LEFTOVERS = ("demandops-pack-*", "**/pack-*.keep", "**/*.lock", "**/*.partial")
_OWN_FAULTS = ("fault of demandops", "internal error", "Traceback")


def after_fault(ran: Ran, told: tuple[str, ...], *, unsound: bool) -> Iterator[str]:
    """Yield each problem in a process's reaction to a fault.

    If it booked nothing, it must print one of the words ``told``; ``unsound``: a sync failed on
    which the acknowledgement relies.
    """
    if ran.hangs == "waits":
        if not ran.err.strip():
            yield "waits without a word"
    elif ran.hangs:
        yield ran.hangs
    if ran.code < 0 or ran.hangs.startswith("does"):
        return
    if ran.code not in (_DONE, _REFUSED, _UNSOUND, _INTERRUPTED):
        yield f"exit code {ran.code}"
    if unsound and ran.code != _UNSOUND:
        yield f"a sync failed, and the exit code is {ran.code}"
    text = ran.err + ran.out
    for words in _OWN_FAULTS:
        if words in text:
            yield f"blames itself: {words}"
    if ran.code and not any(word in text for word in told):
        yield f"does not say what is wrong: {_last_line(ran)}"


def after_restart(
    rig: Rig, ran: Ran, *, journaled: bool = False, clones: bool = True
) -> Iterator[str]:
    """Book another demand in a fresh process, and yield each problem of the state repo.

    Do nothing if the same state of the disk was found sound before, and no child of the process
    ``ran`` still runs. ``journaled``: the demand must not be missing; ``clones``: `git fsck`
    checks them too.
    """
    state = None
    if not ran.lingers:
        state = rig.fingerprint(), ran.commit, '"refused"' in ran.out, journaled, clones
        if state in rig.proved:
            return
    problems = list(_after_restart(rig, ran, journaled=journaled, clones=clones))
    if state and not problems:
        rig.proved.add(state)
    yield from problems


def _after_restart(rig: Rig, ran: Ran, *, journaled: bool, clones: bool) -> Iterator[str]:
    found = rig.book(NEXT, limit=2 * rig.limit)
    if not found.commit:
        told = f"{found.hangs} {_last_line(found)}"
        yield f"the next start fails: exit code {found.code} {told}"
        return
    booked = commits_by_demand(rig)
    times = len(booked.get(DEMAND, []))
    if times > 1:
        yield f"booked {times} times"
    if journaled and not times:
        yield "journaled and missing"
    if ran.commit and ran.commit not in git(rig.state, "rev-list", "main").split():
        yield "acknowledged and missing"
    if times and '"refused"' in ran.out:
        yield "refused and booked"
    for number in (0, NEXT):
        if len(booked.get(number, [])) != 1:
            yield f"demand {number} is booked {len(booked.get(number, []))} times"
    yield from _state(rig, set(booked), clones)


def _state(rig: Rig, numbers: set[int], clones: bool) -> Iterator[str]:
    books = rig.demandops("bookkeeping", "--state-repo", str(rig.state), "--output", "json")
    if books.code:
        yield f"bookkeeping: {books.err.strip()}"
    else:
        wrong = [n for n in range(NEXT + 1) if (f'"user{n}"' in books.out) != (n in numbers)]
        if wrong or not isinstance(json.loads(books.out), dict | list):
            yield f"the bookkeeping differs from the commits: {wrong}"
    verified = rig.demandops("verify", "--state-repo", str(rig.state))
    if verified.code:
        yield f"verify: {(verified.out + verified.err).strip()}"
    for folder in (rig.state, *(rig.home.rglob("clone.git") if clones else ())):
        if told := fsck(folder):
            yield f"git fsck: {told}"
        for pattern in _LEFTOVERS:
            yield from (f"left over: {_named(path)}" for path in folder.glob(pattern))


def _last_line(ran: Ran) -> str:
    return next(iter(ran.err.strip().splitlines()[-1:]), ran.out)


def _named(path: Path) -> str:
    return path.name.replace(path.stem.partition("-")[2], "*") if "-" in path.stem else path.name
