"""Inject faults into one demand and report what each did: ``make faults``.

The exit code is 1 if a promise was broken.
"""

from __future__ import annotations

import argparse
import gc
import io
import logging
import os
import pkgutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from importlib import import_module
from multiprocessing import current_process, get_context
from pathlib import Path
from typing import Any

import demandops
from demandops.cli import main as command_line

from tests.faults import disk, injection, power_loss
from tests.faults.injection import Result
from tests.faults.invariants import DEMAND
from tests.faults.rig import Rig

WORKERS = (os.cpu_count() or 1) + 1
"""One more than there are cores, because a worker that waits for a disk or a lock needs no core."""
MEMORY = Path("/dev/shm")
"""A file system in memory, where a sync takes no time; strace still shows each sync."""
TELL_EVERY = 20
_RIGS: dict[tuple[bool, bool], Rig] = {}
_FOLDER, _SHORT = Path(), True


@dataclass(frozen=True)
class _Task:
    part: str
    remote: bool
    what: tuple[Any, ...] = ()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--long", action="store_true", help="try every fault at every call")
    parser.add_argument("--only", default="", help="run only tasks whose text contains this")
    chosen = parser.parse_args()
    fast = MEMORY if MEMORY.is_dir() else None
    with tempfile.TemporaryDirectory(prefix="demandops-faults-", dir=fast) as folder:
        _prepare(Path(folder))
        tasks = [each for each in _tasks(Path(folder), chosen.long) if chosen.only in str(each)]
        print(f"{len(tasks)} tasks", flush=True)
        began, results = time.monotonic(), list[Result]()
        start = (Path(folder), not chosen.long)
        with get_context("fork").Pool(WORKERS, _start, start) as pool:
            for number, found in enumerate(pool.imap_unordered(_run, tasks), 1):
                results += found
                for result in found:
                    for problem in result.problems:
                        print(f"VIOLATED {' '.join(result.where)} {result.fault}: {problem}")
                if number % TELL_EVERY == 0:
                    print(f"{number} tasks, {time.monotonic() - began:.0f} s", flush=True)
    _report(results, time.monotonic() - began)
    return int(any(result.problems for result in results))


def _prepare(folder: Path) -> None:
    """Import all modules, and compile templates and schemas, so that forked processes need not."""
    for module in pkgutil.walk_packages(demandops.__path__, "demandops."):
        import_module(module.name)
    rig = Rig(folder / "first", remote=False)
    state = ("--state-repo", str(rig.state))
    for command in (("verify",), ("request", str(rig.goal_file(DEMAND)), "--dry-run")):
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            code = command_line.run([*command, *state])
        assert code == 0, code
    logging.getLogger().handlers.clear()  # each forked process logs to its own standard error
    gc.collect()
    gc.freeze()  # otherwise the garbage collector of each forked process would copy all memory


def _tasks(folder: Path, long: bool) -> Iterator[_Task]:
    """Yield all tasks, the longest first."""
    mounts = disk.may_mount()
    if not mounts:
        print("a full disk is not tried, because only root can mount a small disk")
    for remote in (False, True):
        if long or not remote:
            yield _Task("power", remote)
        yield _Task("damage", remote)
        for blocks in (range(0, 40, 2) if long else (0, 3, 6)) if mounts else ():
            yield _Task("full", remote, ("home", blocks))
            if not remote:
                yield _Task("full", remote, ("state.git", blocks))
        rig = Rig(folder / f"plan-{remote}", remote=remote)
        sites = injection.sites(rig)
        syncs = [each for each in sites if each.role == "demandops-writer" and each.kind == "fsync"]
        if not remote:
            yield from (_Task("failed sync", False, (each.n,)) for each in syncs if each.n > 1)
        for job in injection.jobs(sites, remote=remote, short=not long):
            yield _Task("injection", remote, job)


def _start(folder: Path, short: bool) -> None:
    global _FOLDER, _SHORT
    _FOLDER, _SHORT = folder / current_process().name, short


def _run(task: _Task) -> list[Result]:
    part = f"{task.part}, remote:" if task.remote else f"{task.part}:"
    try:
        return [replace(each, where=(part, *each.where)) for each in _results(task)]
    except Exception as error:  # the other tasks' results must not be lost
        traceback.print_exc()
        return [Result((part, str(task.what)), "", (f"not tried: {error!r}",))]


def _results(task: _Task) -> list[Result]:
    key = (task.part == "damage", task.remote)
    if key not in _RIGS:
        _RIGS[key] = Rig(_FOLDER / str(key), remote=task.remote)
        if key[0]:
            disk.interrupted(_RIGS[key])
    rig = _RIGS[key]
    match task.part:
        case "power":
            return list(power_loss.run(rig))
        case "failed sync":
            return [power_loss.failed_sync(rig, *task.what)]
        case "damage":
            return list(disk.damage(rig, short=_SHORT))
        case "full":
            name, blocks = task.what
            return [disk.full(rig, rig.folder / name, blocks)]
    return [injection.run(rig, *task.what)]


def _report(results: list[Result], seconds: float) -> None:
    by_class: dict[str, Counter[str]] = {}
    for result in results:
        known = [f"known and open: {problem}" for problem in result.known]
        verdicts = [*result.problems, *known] or ["sound"]
        by_class.setdefault(" ".join(result.where), Counter()).update(verdicts)
    for name, verdicts in sorted(by_class.items()):
        told = ", ".join(f"{count} {verdict}" for verdict, count in sorted(verdicts.items()))
        print(f"{name}: {told}")
    wrong = sum(bool(result.problems) for result in results)
    known = sum(bool(result.known) for result in results)
    print(
        f"{len(results)} faults and states, {wrong} with a violation, "
        f"{known} with a known and open problem, {seconds:.0f} s"
    )


if __name__ == "__main__":
    sys.exit(main())
