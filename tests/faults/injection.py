"""Inject errors and kills, by strace, at the system calls that booking a demand makes."""

from __future__ import annotations

import errno
import os
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from tests.faults.invariants import DEMAND, after_fault, after_restart
from tests.faults.rig import GIT, PLENTY_S, Rig, Strace
from tests.faults.trace import Call, calls_of

EVERYTHING = "trace=%file,%desc,%process"
SYNCS = calls_of("syncs")
KILL = "SIGKILL"
_SHORT = {False: ("EIO", "EACCES", "ENOSPC", KILL), True: ("EIO", KILL)}
"""The faults that a short run injects; the key says whether the state repo is remote."""

_MISSED = "not reached"
_TRIES = 8
"""How often to repeat a fault that missed its call, with calls counted anew; numbers vary."""
_TRIES_ON_JOURNAL = 40
"""The same for calls on the journal, which either of two threads may make, so tries alternate."""
_OTHER_THREAD = {"demandops-journal": "demandops-writer", "demandops-writer": "demandops-journal"}
_KNOWN: dict[Path, list[Call]] = {}
"""The system calls that booking :data:`DEMAND` makes in a rig; the key is the rig's folder."""
_WITHOUT_REASON = (
    *("failed to update ref", "unpack", "Killed", "hung up", "signal 9", "has no branch"),
    *("the server cannot read the branch", "check the path in the address"),
)
"""Words of messages that do not say why a process of git failed, here or at the server.

A server that cannot read its references or folder offers no branch, or calls it no repository.
"""
_HIDDEN = ("not a Git repository", "checked out", "cannot be read", "refresh packfiles")
"""Messages about files that libgit2 could not read; they give no reason."""
_UNNOTICED = ("git receive-pack", "getdents64", "state.git/objects/tmp_objdir-incoming-*/??")
"""If this listing of received objects fails, Git believes that it is complete.

It may lose an object, which the generator cannot see: docs/reliability.md, "Known and open".
"""


@dataclass(frozen=True)
class Result:
    """The problems that a fault caused, such as at a role's call on a class of file.

    ``known`` has the problems that docs/reliability.md lists as open; ``hangs``: a process did
    not end in time.
    """

    where: tuple[str, ...]
    fault: str
    problems: tuple[str, ...]
    known: tuple[str, ...] = ()
    hangs: bool = False


def sites(rig: Rig) -> list[Call]:
    """Return the calls that booking :data:`DEMAND` makes: first of threads, then of git."""
    found, counts = [], Counter[object]()
    options = ["-s", "64", "-e", EVERYTHING]
    for strace in (Strace(["-f", *options]), Strace(options, GIT)):
        rig.restore()
        ran = rig.must(rig.book(DEMAND, strace, PLENTY_S))
        for call in ran.calls:
            if call.which or call.role in ran.threads:
                found.append(replace(call, place=counts[call.call_class]))
                counts[call.call_class] += 1
    _KNOWN[rig.folder] = found
    return found


def _here(rig: Rig, site: Call) -> Call:
    """Return a call with its number in this rig, because numbers differ between processes.

    If the site's thread did not make the call, return a call of the same kind that another
    thread made on the same class of file.
    """
    known = _KNOWN[rig.folder]
    same = [
        each for each in known if (each.call_class, each.place) == (site.call_class, site.place)
    ]
    others = [
        each for each in known if not each.which and each.call_class[1:] == site.call_class[1:]
    ]
    return next(iter(same or ([] if site.which else others)), site)


def _is_of_journal(site: Call) -> bool:
    return not site.which and site.file.endswith("/outbox.jsonl") and not site.creates


def faults(site: Call) -> list[str]:
    """Return the faults to inject here; a kill leaves the disk as the previous call left it."""
    errors = ["EIO"]
    if site.kind in calls_of("by name"):
        errors.append("EACCES")
    if site.kind in calls_of("needs room") or site.creates:
        errors.append("ENOSPC")
    if site.kind in calls_of("interruptible"):
        errors.append("EINTR")
    return [*errors, KILL] if site.changes else errors


def jobs(found: Iterable[Call], *, remote: bool, short: bool) -> Iterator[tuple[Call, str]]:
    """Yield every fault at every call.

    With ``short``, choose the last call of each class (and the first, for syncs without a
    remote) and the faults of ``_SHORT``, and for reads only EIO without a remote.
    """
    classes: dict[tuple[str, str, str, bool], list[Call]] = {}
    for site in found:
        if site.kind not in calls_of("cannot fail"):
            classes.setdefault(site.call_class, []).append(site)
    for group in classes.values():
        changes, chosen = group[0].changes, group
        if short and remote and not changes:
            continue
        if short:
            is_sync = group[0].kind in SYNCS and not remote
            chosen = list(dict.fromkeys((group[0], group[-1]))) if is_sync else group[-1:]
        tried = _SHORT[remote] if changes else ("EIO",)
        for site in chosen:
            yield from ((site, fault) for fault in faults(site) if not short or fault in tried)


def run(rig: Rig, wanted: Call, fault: str) -> Result:
    if rig.folder not in _KNOWN:
        sites(rig)
    site = _here(rig, wanted)
    result = _run(rig, site, fault)
    for tries in range(_TRIES_ON_JOURNAL if _is_of_journal(site) else _TRIES):
        if result.problems != (_MISSED,):
            break
        if _is_of_journal(site):
            site = replace(site, role=_OTHER_THREAD.get(site.role, site.role))
        else:
            site = _counted_anew(rig, wanted, site, only_here=tries == 0)
        result = _run(rig, site, fault)
    if result.problems and result.hangs:
        rig.restore()
        if rig.is_slower(DEMAND):
            return run(rig, wanted, fault)
    return result


def _counted_anew(rig: Rig, wanted: Call, here: Call, *, only_here: bool) -> Call:
    """Book the demand without a fault; return the wanted call with its number in this run.

    With ``only_here``, trace only its thread or process, which is cheaper, and all if it does
    not make the call.
    """
    if only_here:
        before = sum(
            (each.call_class, each.which) == (here.call_class, here.which)
            and each.place < here.place
            for each in _KNOWN[rig.folder]
        )
        rig.restore()
        ran = rig.must(rig.book(DEMAND, _at(here), PLENTY_S))
        same = [each for each in ran.calls if each.call_class == here.call_class]
        if len(same) > before:
            return replace(same[before], which=here.which, place=here.place)
    sites(rig)
    return _here(rig, wanted)


def _at(site: Call, *options: str) -> Strace:
    """Return a strace of only the thread or process that makes a call."""
    traced = ("-s64", "-e", f"trace={site.kind},chdir,execve,clone,clone3,fork,vfork")
    return Strace((*options, *traced), f"{site.role} {site.which}" if site.which else site.role)


def _run(rig: Rig, site: Call, fault: str) -> Result:
    happens = "signal=KILL" if fault == KILL else f"error={fault}"
    rig.restore()
    n, only = site.n, list[str]()
    if _is_of_journal(site):  # count only its own calls: how many others there are varies
        n, only = site.place + 1, ["-P", str(next(rig.home.rglob("outbox.jsonl")))]
    strace = _at(site, *only, "-e", f"inject={site.kind}:{happens}:when={n}")
    ran = rig.book(DEMAND, strace)
    where = (site.role, site.kind, site.file)
    if not any(
        "INJECTED" in call.result or (fault == KILL and call.result.startswith("?"))
        for call in ran.calls
        if call.file == site.file
    ):
        return Result(where, fault, (_MISSED,))
    told = [os.strerror(getattr(errno, fault, 0)), "no room", *_HIDDEN]
    told += _WITHOUT_REASON if site.which else ()
    # a failed sync of a clone does no harm, because the remote keeps what was pushed
    own = not site.which and (not rig.remote or "outbox" in site.file)
    unsound = own and site.kind in SYNCS and fault == "EIO" and "stop" not in site.role
    problems = tuple(after_fault(ran, tuple(told), unsound=unsound))
    if site.role == "git receive-pack":  # its locks stay until an operator removes them
        rig.unlock_server()
    found = tuple(after_restart(rig, ran))
    hangs = bool(ran.hangs) or any("the next start fails" in each for each in found)
    if where == _UNNOTICED:
        return Result(where, fault, problems, found, hangs)
    return Result(where, fault, problems + found, hangs=hangs)
