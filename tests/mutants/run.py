"""``make mutants``: which share of small mistakes in the core do its tests find?

Draws ``MUTANTS`` (600) mutants of the core by ``SEED`` (1), from each room in proportion to its
lines, and runs at most 200 tests that reach the mutated line. It stops after ``MUTANTS_MINUTES``
(60), and goes on at the next call: ``build/mutants/`` has what is known of this code and its tests.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import math
import os
import random
import resource
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from functools import lru_cache
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType

import coverage
import pytest

from tests.mutants.mutation import Mutant, mutants

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "generator" / "demandops"
ROOMS = ("model", "connections", "decide", "render")
TESTS = ("tests/unit", "tests/golden", "tests/appdefs")
READ = ("generator", "templates", "appdefs", "state-repo-skeleton", "tests")
MOST_TESTS = 200
# Runs without a mutant that must pass first: a test that fails in any case finds nothing.
CONTROLS = 10
# A mutant that uses more processor time counts as found; most use 4 s, so it would not end.
CPU_S = 40


def draw(number: int) -> list[Mutant]:
    """Return at least ``number`` mutants; each beginning of the list has its share of each room."""
    files = {room: sorted((PACKAGE / room).rglob("*.py")) for room in ROOMS}
    lines = {room: sum(len(one.read_text().splitlines()) for one in files[room]) for room in ROOMS}
    placed = list[tuple[float, str, Mutant]]()
    for room in ROOMS:
        known = [mutant for file in files[room] for mutant in mutants(file)]
        share = -(-number * lines[room] // sum(lines.values()))
        chance = random.Random(f"{os.environ.get('SEED', '1')} {room}")
        drawn = chance.sample(known, min(share, len(known)))
        placed += [((index + 0.5) / len(drawn), room, one) for index, one in enumerate(drawn)]
    return [mutant for *_, mutant in sorted(placed, key=lambda each: each[:2])]


class Reached:
    """What one run of all tests shows: which tests reach a line, and how long each takes."""

    def __init__(self, folder: Path) -> None:
        times, data = folder / "times.json", folder / "coverage"
        if not times.exists():
            options = "-p tests.mutants.run -q -n auto -p no:cacheprovider --cov-report= "
            options += "--cov-context=test " + " ".join(f"--cov=demandops.{room}" for room in ROOMS)
            command = [sys.executable, "-m", "pytest", *options.split(), *TESTS]
            told = {"COVERAGE_FILE": str(data), "MUTANTS_TIMES": str(times)}
            subprocess.run(command, env=os.environ | told, check=False)
        self._seconds: dict[str, float] = json.loads(times.read_text())
        self._data = coverage.CoverageData(str(data))
        self._data.read()

    @lru_cache(maxsize=1024)  # noqa: B019 - there is one object
    def _in(self, path: Path) -> tuple[dict[int, set[str]], Counter[str]]:
        found = self._data.contexts_by_lineno(str(path)).items()
        by_line = {line: {one.partition("|")[0] for one in by if one} for line, by in found}
        return by_line, Counter(test for tests in by_line.values() for test in tests)

    def tests(self, mutant: Mutant) -> list[str]:
        """Return the tests to run for a mutant, the fastest first."""
        by_line, breadth = self._in(mutant.path)
        found = set[str]().union(*(by_line.get(line, ()) for line in mutant.lines))
        if not found and by_line.keys() & mutant.lines:  # the line runs when the module is imported
            found = {*breadth}
        fastest = sorted(found & self._seconds.keys(), key=lambda test: self._seconds[test])
        # those that reach most of the module are the likeliest to see what is wrong in it
        widest = sorted(fastest, key=lambda test: -breadth[test])
        chosen = {*widest[: MOST_TESTS // 2], *fastest[: MOST_TESTS // 2]}
        chosen |= {test for test in fastest if "/golden/" in test}  # these see all that is rendered
        return [test for test in fastest if test in chosen]


seconds = Counter[str]()  # this module is a plugin of pytest in the run of all tests


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    seconds[report.nodeid] += report.duration if report.outcome == "passed" else math.inf


def pytest_sessionfinish(session: pytest.Session) -> None:
    if not hasattr(session.config, "workerinput"):  # xdist reports all to this process
        passed = {test: time for test, time in seconds.items() if time < math.inf}
        Path(os.environ["MUTANTS_TIMES"]).write_text(json.dumps(passed))


def import_mutated(mutant: Mutant) -> None:
    original = SourceFileLoader.get_code
    code = compile(mutant.tree(), mutant.path, "exec", dont_inherit=True)

    def get_code(loader: SourceFileLoader, name: str) -> CodeType | None:
        return code if loader.path == str(mutant.path) else original(loader, name)

    SourceFileLoader.get_code = get_code  # type: ignore[method-assign]


def warm_up() -> None:
    """Import the libraries of the program and the tests, so that a fork imports only these two."""
    importlib.import_module("tests.conftest")
    for name in [name for name in sys.modules if name.partition(".")[0] in ("demandops", "tests")]:
        del sys.modules[name]


def start(mutant: Mutant | None, tests: list[str]) -> int:
    if pid := os.fork():
        return pid
    code = 1
    try:
        os.setsid()
        null = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(null, stream)
        resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S))
        if mutant:
            import_mutated(mutant)
        options = ["-x", "-q", "-p", "no:cacheprovider", "-n", "0", "--hypothesis-seed=0"]
        code = int(pytest.main([*options, *tests]))
    finally:
        os._exit(code)


def results(tries: list[tuple[Mutant | None, list[str]]], end: float) -> Iterator[tuple[int, bool]]:
    """Yield (index, whether a test failed) for each try that began before ``end``."""
    running, waiting = dict[int, int](), list(range(len(tries)))
    while running or (waiting and time.monotonic() < end):
        if waiting and len(running) < (os.cpu_count() or 1) and time.monotonic() < end:
            index = waiting.pop(0)
            running[start(*tries[index])] = index
            continue
        pid, status = os.wait()
        with suppress(ProcessLookupError):  # what the tests left running
            os.killpg(pid, signal.SIGKILL)
        yield running.pop(pid), status != 0


def main() -> int:
    os.chdir(ROOT)
    end = time.monotonic() + 60 * float(os.environ.get("MUTANTS_MINUTES") or 60)
    digest = hashlib.sha256()
    for file in sorted(one for root in READ for one in (ROOT / root).rglob("*") if one.is_file()):
        digest.update(file.read_bytes() if file.suffix != ".pyc" else b"")
    folder = ROOT / "build" / "mutants" / digest.hexdigest()[:12]
    folder.mkdir(parents=True, exist_ok=True)
    reached, drawn = Reached(folder), draw(int(os.environ.get("MUTANTS") or 600))
    warm_up()
    tests = {one: reached.tests(one) for one in drawn}
    controls = [(None, named) for named in tests.values() if named][:CONTROLS]
    if failed := [controls[index][1] for index, fails in results(controls, end) if fails]:
        print(f"mutants: without a mutant, one of these fails: {failed[0]}")
        return 1
    file = folder / "found.jsonl"
    known = dict(map(json.loads, file.read_text().splitlines())) if file.exists() else {}
    known |= {str(one): False for one in drawn if not tests[one]}
    left = [one for one in drawn if str(one) not in known]
    with file.open("a") as written:
        for index, found in results([(one, tests[one]) for one in left], end):
            known[str(left[index])] = found
            print(json.dumps([str(left[index]), found]), file=written, flush=True)
    tried = [one for one in drawn if str(one) in known]
    survivors = [one for one in tried if not known[str(one)]]
    for one in sorted(survivors, key=str):
        print(f"not found by {len(tests[one])} tests: {one}")
    for room in ROOMS:
        of_room = {one for one in tried if one.path.is_relative_to(PACKAGE / room)}
        print(f"{room}: {len(of_room - {*survivors})} of {len(of_room)}")
    share = 1 - len(survivors) / max(len(tried), 1)
    print(f"mutants: {share:.1%} of {len(tried)} found, {len(drawn) - len(tried)} left to try")
    return 0


if __name__ == "__main__":
    sys.exit(main())
