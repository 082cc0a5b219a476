"""Inject faults into one demand and report what each did: ``make faults``.

Writes ``build/faults.json`` and ends with exit code 1 if a promise was broken.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path

from tests.faults import injection
from tests.faults.injection import Job, Result
from tests.faults.rig import Rig

WORKERS = 2
OUT = Path(__file__).parents[2] / "build" / "faults.json"
_RIGS: dict[bool, Rig] = {}
_IMPORTED = (
    "demandops.service",
    *(f"demandops.cli.{name}" for name in ("actions.request", "repo.init", "repo.verify")),
    "demandops.cli.views.bookkeeping",
)


def main() -> int:
    """Run the parts and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--long", action="store_true", help="every call, and every fault at it")
    parser.add_argument("--only", default="", help="only calls and files that contain this text")
    chosen = parser.parse_args()
    for name in _IMPORTED:
        import_module(name)
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="demandops-faults-") as folder:
        results = list(_injected(Path(folder), short=not chosen.long, only=chosen.only))
    _report(results, time.monotonic() - began)
    return int(any(result.problems for result in results))


def _injected(folder: Path, *, short: bool, only: str) -> Iterable[Result]:
    jobs: list[Job] = []
    for remote in (False, True):
        rig = Rig(folder / f"plan-{remote}", remote=remote)
        jobs += injection.jobs(injection.sites(rig), remote=remote, short=short)
    jobs = [job for job in jobs if only in f"{job.remote} {job.site} {job.fault}"]
    print(f"{len(jobs)} faults to inject", flush=True)
    with get_context("fork").Pool(WORKERS, _start, (folder,)) as pool:
        yield from pool.imap_unordered(_run, jobs)


def _start(folder: Path) -> None:
    from multiprocessing import current_process

    for remote in (False, True):
        name = f"{current_process().name}-{remote}"
        _RIGS[remote] = Rig(folder / name, remote=remote)


def _run(job: Job) -> Result:
    return injection.run(_RIGS[job.remote], job)


def _report(results: list[Result], seconds: float) -> None:
    by_class: dict[str, Counter[str]] = {}
    for result in results:
        name = " ".join((result.part, *result.where))
        by_class.setdefault(name, Counter()).update(result.problems or ("sound",))
    OUT.parent.mkdir(exist_ok=True)
    OUT.write_text(json.dumps(by_class, indent=1, sort_keys=True))
    for name, verdicts in sorted(by_class.items()):
        told = ", ".join(f"{count} {verdict}" for verdict, count in sorted(verdicts.items()))
        print(f"{name}: {told}")
    for result in results:
        for problem in result.problems:
            print(f"VIOLATED {result.part} {' '.join(result.where)} {result.fault}: {problem}")
    wrong = sum(bool(result.problems) for result in results)
    print(f"{len(results)} faults, {wrong} with a violation, {seconds:.0f} s")


if __name__ == "__main__":
    sys.exit(main())
