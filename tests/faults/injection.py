"""Errors and kills at the system calls of one demand, as strace found them."""

from __future__ import annotations

import errno
import os
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from tests.faults.invariants import DEMAND, after_fault, after_restart
from tests.faults.rig import PLENTY_S, Rig, Strace
from tests.faults.trace import Call, file_class, parse

EVERYTHING = "trace=%file,%desc,%process"
CANNOT_FAIL = {
    "chdir",
    "close",  # strace would not close it
    "execve",
    "fcntl",
    "fstat",
    "getcwd",
    "ioctl",
    "lseek",
    "mmap",
    "munmap",
}
"""Kinds of calls in which a fault of a disk does not show."""
CHANGES = {
    "creat", "fallocate", "fchmod", "fdatasync", "fsync", "ftruncate", "link", "linkat", "mkdir",
    "mkdirat", "chmod", "pwrite64", "rename", "renameat", "renameat2", "rmdir", "symlink", "sync",
    "sync_file_range", "truncate", "unlink", "unlinkat", "write", "writev",
}  # fmt: skip
SYNCS = {"fsync", "fdatasync", "sync_file_range", "syncfs", "msync"}
_BY_NAME = {
    "access", "chmod", "creat", "link", "linkat", "lstat", "mkdir", "mkdirat", "newfstatat", "open",
    "openat", "readlink", "rename", "renameat", "renameat2", "rmdir", "stat", "statx", "symlink",
    "truncate", "unlink", "unlinkat",
}  # fmt: skip
_NEED_ROOM = {
    "creat", "fallocate", "fdatasync", "fsync", "link", "linkat", "mkdir", "mkdirat", "pwrite64",
    "rename", "renameat", "renameat2", "symlink", "write", "writev",
}  # fmt: skip
_INTERRUPTIBLE = {"flock", "fsync", "open", "openat", "pread64", "pwrite64", "read", "write"}
KILL = "SIGKILL"
_SHORT = {False: ("EIO", "EACCES", "ENOSPC", KILL), True: ("EIO", KILL)}
"""What the short form tries, without and with a remote."""

_MISSED = "not reached"
_TRIES = 8
"""How often to count the calls again if one is missed: either thread may write the journal."""
_KNOWN: dict[Path, list[Site]] = {}
"""The calls of a demand, by the folder in which this process books it."""
_HIDDEN = ("not a Git repository", "checked out", "cannot be read", "refresh packfiles")
"""What is said if libgit2 does not say why it could not read a file."""


@dataclass(frozen=True)
class Site:
    """The n-th call of a kind in a thread or program, and the class of file that it touches."""

    role: str
    kind: str
    file: str
    n: int
    creates: bool = False
    place: int = 0
    """How many calls of its class came before it."""

    @property
    def of_class(self) -> tuple[str, str, str, bool]:
        """What it has in common with the other calls of its class."""
        return self.role, self.kind, self.file, self.creates

    @property
    def changes(self) -> bool:
        """Whether the call changes or syncs a file."""
        return self.kind in CHANGES or self.creates

    def faults(self) -> list[str]:
        """Return what can happen at this call; a kill comes before it, so after the one before."""
        errors = ["EIO"]
        if self.kind in _BY_NAME:
            errors.append("EACCES")
        if self.kind in _NEED_ROOM or self.creates:
            errors.append("ENOSPC")
        if self.kind in _INTERRUPTIBLE:
            errors.append("EINTR")
        return [*errors, KILL] if self.changes else errors


@dataclass(frozen=True)
class Job:
    """One fault at one call."""

    remote: bool
    site: Site
    fault: str


@dataclass(frozen=True)
class Result:
    """What one fault did. ``where``: the thread or program, the call and the class of file."""

    part: str
    where: tuple[str, str, str]
    fault: str
    problems: tuple[str, ...]


def sites(rig: Rig) -> list[Site]:
    """Book one demand under strace, and return its calls."""
    rig.restore()
    ran = rig.must(rig.book(DEMAND, Strace(["-f", "-s", "64", "-e", EVERYTHING]), PLENTY_S))
    found, counts = [], Counter[object]()
    for call in parse(ran.trace, ran.roles, rig.folder):
        site = _site(call, rig)
        found.append(replace(site, place=counts[site.of_class]))
        counts[site.of_class] += 1
    _KNOWN[rig.folder] = found
    return found


def _here(rig: Rig, site: Site) -> Site:
    """Return the same call as it is counted in this process, which may read more or fewer files."""
    known = _KNOWN[rig.folder]
    same = [each for each in known if (each.of_class, each.place) == (site.of_class, site.place)]
    return same[0] if same else site


def _site(call: Call, rig: Rig) -> Site:
    creates = "O_CREAT" in call.arguments
    return Site(call.role, call.kind, file_class(call.paths[-1], rig.folder), call.n, creates)


def jobs(found: Iterable[Site], *, remote: bool, short: bool) -> list[Job]:
    """Return every fault at every call; if ``short``, at the last call of each class.

    Calls that only read meet fewer faults then. Those of git and at a remote fewer still.
    """
    classes: dict[tuple[str, str, str, bool], list[Site]] = {}
    for site in found:
        if site.kind not in CANNOT_FAIL:
            classes.setdefault(site.of_class, []).append(site)
    made = []
    for group in classes.values():
        chosen = group
        if short and remote and (">" in group[0].role or not group[0].changes):
            continue
        if short:
            is_sync = group[0].kind in SYNCS and not remote
            chosen = list(dict.fromkeys((group[0], group[-1]))) if is_sync else group[-1:]
        for site in chosen:
            faults = site.faults()
            if short and not site.changes:
                faults = ["EIO"]
            elif short:
                faults = [each for each in faults if each in _SHORT[remote]]
            made += [Job(remote, site, fault) for fault in faults]
    return made


def run(rig: Rig, job: Job) -> Result:
    """Have one fault happen, and return what became of the demand."""
    if rig.folder not in _KNOWN:
        sites(rig)
    result = _run(rig, job, _here(rig, job.site))
    for _ in range(_TRIES):
        if result.problems != (_MISSED,):
            break
        sites(rig)
        result = _run(rig, job, _here(rig, job.site))
    return result


def _run(rig: Rig, job: Job, site: Site) -> Result:
    happens = "signal=KILL" if job.fault == KILL else f"error={job.fault}"
    command = site.role.partition(" > ")[0]
    options = ["-s64", "-e", f"inject={site.kind}:{happens}:when={site.n}", "-e"]
    options.append(f"trace={site.kind},chdir,execve,clone,clone3,fork,vfork")
    rig.restore()
    folder = "/"
    if command.startswith("git "):
        options.append("-f")
        command, folder = command.removeprefix("git "), str(next(rig.home.rglob("clone.git")))
    ran = rig.book(DEMAND, Strace(options, command))
    hit = [
        _site(call, rig)
        for call in parse(ran.trace, ran.roles, rig.folder, folder)
        if "INJECTED" in call.result or (job.fault == KILL and call.result.startswith("?"))
    ]
    where = (site.role, site.kind, site.file)
    part = "remote" if job.remote else "local"
    if not any(each.file == site.file for each in hit):
        return Result(part, where, job.fault, (_MISSED,))
    number = getattr(errno, job.fault, 0)
    told = (os.strerror(number), "no room", *_HIDDEN)
    own = not command.startswith("git") and ">" not in site.role and command == site.role
    own = own and (not job.remote or "outbox" in site.file)  # a push is the remote's promise
    unsound = own and site.kind in SYNCS and job.fault == "EIO" and "stop" not in site.role
    problems = list(after_fault(ran, told, unsound=unsound))
    problems += after_restart(rig, ran)
    return Result(part, where, job.fault, tuple(problems))
