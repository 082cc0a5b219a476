"""Inject errors and kills, by strace, at the system calls that booking a demand makes."""

from __future__ import annotations

import errno
import os
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from tests.faults.invariants import DEMAND, after_fault, after_restart
from tests.faults.rig import GIT, PLENTY_S, Ran, Rig, Strace
from tests.faults.trace import Call, calls_of, file_class, parse

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
_KNOWN: dict[Path, list[Site]] = {}
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
class Site:
    """The n-th call of a kind in a thread or process, and the class of file that it touches.

    ``role`` is the name of the thread, or the git command of the process, such as ``git push``. For
    a thread, ``which`` is 0. For a process, ``which`` is its number, from 1, among the processes of
    the same git command.
    """

    role: str
    kind: str
    file: str
    n: int
    creates: bool = False
    which: int = 0
    place: int = 0
    """How many calls of the same class came before this one."""

    @property
    def call_class(self) -> tuple[str, str, str, bool]:
        return self.role, self.kind, self.file, self.creates

    @property
    def is_threads(self) -> bool:
        return not self.which

    @property
    def changes(self) -> bool:
        return self.kind in calls_of("changes") or self.creates

    def faults(self) -> list[str]:
        """Return the faults to inject here; a kill leaves the disk as the previous call left it."""
        errors = ["EIO"]
        if self.kind in calls_of("by name"):
            errors.append("EACCES")
        if self.kind in calls_of("needs room") or self.creates:
            errors.append("ENOSPC")
        if self.kind in calls_of("interruptible"):
            errors.append("EINTR")
        return [*errors, KILL] if self.changes else errors


@dataclass(frozen=True)
class Job:
    remote: bool
    site: Site
    fault: str


@dataclass(frozen=True)
class Result:
    """The problems that a fault caused at a role's call on a class of file.

    ``known`` has the problems that docs/reliability.md lists as open; ``hangs``: a process did
    not end in time.
    """

    part: str
    where: tuple[str, str, str]
    fault: str
    problems: tuple[str, ...]
    known: tuple[str, ...] = ()
    hangs: bool = False


def sites(rig: Rig) -> list[Site]:
    """Return the calls that booking :data:`DEMAND` makes: first of threads, then of git."""
    options = ["-s", "64", "-e", EVERYTHING]
    rig.restore()
    ran = rig.must(rig.book(DEMAND, Strace(["-f", *options]), PLENTY_S))
    threads = set(ran.roles.values())
    calls = parse(ran.trace, ran.roles, rig.folder)
    made = [_site(call, rig) for call in calls if call.role in threads]
    rig.restore()
    made += _git_sites(rig, rig.must(rig.book(DEMAND, Strace(options, GIT), PLENTY_S)))
    found, counts = [], Counter[object]()
    for site in made:
        found.append(replace(site, place=counts[site.call_class]))
        counts[site.call_class] += 1
    _KNOWN[rig.folder] = found
    return found


def _here(rig: Rig, site: Site) -> Site:
    """Return a call with its number in this rig, because numbers differ between processes.

    If the site's thread did not make the call, return a call of the same kind that another
    thread made on the same class of file.
    """
    known = _KNOWN[rig.folder]
    same = [
        each for each in known if (each.call_class, each.place) == (site.call_class, site.place)
    ]
    threads = [
        each for each in known if each.is_threads and each.call_class[1:] == site.call_class[1:]
    ]
    return next(iter(same or (threads if site.is_threads else [])), site)


def _site(call: Call, rig: Rig, which: int = 0) -> Site:
    creates = "O_CREAT" in call.arguments
    file = file_class(call.paths[-1], rig.folder)
    return Site(call.role, call.kind, file, call.n, creates, which)


def _is_of_journal(site: Site) -> bool:
    return site.is_threads and site.file.endswith("/outbox.jsonl") and not site.creates


def _counted(rig: Rig, site: Site) -> tuple[int, list[str]]:
    """Return the number of the call, and options that limit what strace counts.

    On the journal it counts only the journal's calls, because the number of others depends on
    timing.
    """
    if _is_of_journal(site):
        return site.place + 1, ["-P", str(next(rig.home.rglob("outbox.jsonl")))]
    return site.n, []


def _git_sites(rig: Rig, ran: Ran) -> list[Site]:
    return [_site(call, rig, which) for which, call in _git_calls(rig, ran)]


def _git_calls(rig: Rig, ran: Ran) -> Iterator[tuple[int, Call]]:
    """Yield each traced call of git with the number of its process (see ``Site.which``)."""
    for trace in ran.git:
        text = "".join(f"1 {line}\n" for line in trace.text.splitlines())
        for call in parse(text, {1: trace.command}, rig.folder, trace.folder):
            yield trace.which, call


def jobs(found: Iterable[Site], *, remote: bool, short: bool) -> list[Job]:
    """Return every fault at every call.

    With ``short``, choose the last call of each class (and the first, for syncs without a
    remote) and the faults of ``_SHORT``, and for reads only EIO without a remote.
    """
    classes: dict[tuple[str, str, str, bool], list[Site]] = {}
    for site in found:
        if site.kind not in calls_of("cannot fail"):
            classes.setdefault(site.call_class, []).append(site)
    made = []
    for group in classes.values():
        changes = group[0].changes
        if short and remote and not changes:
            continue
        chosen = group
        if short:
            is_sync = group[0].kind in SYNCS and not remote
            chosen = list(dict.fromkeys((group[0], group[-1]))) if is_sync else group[-1:]
        tried = _SHORT[remote] if changes else ("EIO",)
        made += [
            Job(remote, site, fault)
            for site in chosen
            for fault in site.faults()
            if not short or fault in tried
        ]
    return made


def run(rig: Rig, job: Job) -> Result:
    if rig.folder not in _KNOWN:
        sites(rig)
    site = _here(rig, job.site)
    result = _run(rig, job, site)
    for tries in range(_TRIES_ON_JOURNAL if _is_of_journal(site) else _TRIES):
        if result.problems != (_MISSED,):
            break
        if _is_of_journal(site):
            site = replace(site, role=_OTHER_THREAD.get(site.role, site.role))
        else:
            site = _counted_anew(rig, job.site, site, only_here=tries == 0)
        result = _run(rig, job, site)
    if result.problems and result.hangs:
        rig.restore()
        if rig.is_slower(DEMAND):
            return run(rig, job)
    return result


def _counted_anew(rig: Rig, wanted: Site, here: Site, *, only_here: bool) -> Site:
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
        ran = rig.must(rig.book(DEMAND, Strace(_traces(here), _at(here)), PLENTY_S))
        made = [_site(call, rig, which) for which, call in _calls_at(rig, here, ran)]
        same = [each for each in made if each.call_class == here.call_class]
        if len(same) > before:
            return replace(same[before], which=here.which, place=here.place)
    sites(rig)
    return _here(rig, wanted)


def _at(site: Site) -> str:
    return site.role if site.is_threads else f"{site.role} {site.which}"


def _traces(site: Site) -> list[str]:
    return ["-s64", "-e", f"trace={site.kind},chdir,execve,clone,clone3,fork,vfork"]


def _calls_at(rig: Rig, site: Site, ran: Ran) -> list[tuple[int, Call]]:
    if site.is_threads:
        return [(0, call) for call in parse(ran.trace, ran.roles, rig.folder)]
    return list(_git_calls(rig, ran))


def _run(rig: Rig, job: Job, site: Site) -> Result:
    happens = "signal=KILL" if job.fault == KILL else f"error={job.fault}"
    rig.restore()
    n, only = _counted(rig, site)
    options = [*only, "-e", f"inject={site.kind}:{happens}:when={n}", *_traces(site)]
    ran = rig.book(DEMAND, Strace(options, _at(site)))
    hit = [
        _site(call, rig)
        for _, call in _calls_at(rig, site, ran)
        if "INJECTED" in call.result or (job.fault == KILL and call.result.startswith("?"))
    ]
    where = (site.role, site.kind, site.file)
    part = "remote" if job.remote else "local"
    if not any(each.file == site.file for each in hit):
        return Result(part, where, job.fault, (_MISSED,))
    told = [os.strerror(getattr(errno, job.fault, 0)), "no room", *_HIDDEN]
    if not site.is_threads:
        told += _WITHOUT_REASON
    # a failed sync of a clone does no harm, because the remote keeps what was pushed
    own = site.is_threads and (not job.remote or "outbox" in site.file)
    unsound = own and site.kind in SYNCS and job.fault == "EIO" and "stop" not in site.role
    problems = list(after_fault(ran, tuple(told), unsound=unsound))
    if site.role == "git receive-pack":  # its locks stay until an operator removes them
        rig.unlock_server()
    found = tuple(after_restart(rig, ran))
    hangs = bool(ran.hangs) or any("the next start fails" in each for each in found)
    if where == _UNNOTICED:
        return Result(part, where, job.fault, tuple(problems), known=found, hangs=hangs)
    return Result(part, where, job.fault, (*problems, *found), hangs=hangs)
