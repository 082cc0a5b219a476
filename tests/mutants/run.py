"""``make mutants``: which share of small mistakes in the core do its tests find?

Draws ``MUTANTS`` (600) mutants of the core by ``SEED`` (1), from each room in proportion to its
lines. For each it runs at most 30 tests, the fastest of those that reach the mutated line, until
one fails. It stops after ``MUTANTS_MINUTES`` (60), and goes on at the next call: what is known of
this code and these tests stays in ``build/mutants/``.
"""

from __future__ import annotations

import hashlib
import importlib.util
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
from functools import lru_cache
from importlib.machinery import ModuleSpec, SourceFileLoader
from pathlib import Path
from types import CodeType

import coverage
import pytest

from tests.mutants.mutation import Mutant, mutants

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "generator" / "demandops"
ROOMS = ("config", "demand", "ledger", "plan", "decision", "render")
TESTS = ("tests/unit", "tests/golden", "tests/appdefs")
FURTHER = ("tests/kit", "tests/model", "tests/scenarios", "templates", "state-repo-skeleton")
MOST_TESTS = 30
# Runs without a mutant that must pass first: a test that fails in any case finds nothing.
CONTROLS = 10
# A mutant that uses more processor time counts as found; most use 4 s, so it would not end.
CPU_S = 40
# So does one that waits for longer, for example for a lock.
WAIT_S = 600

Try = tuple["Mutant | None", list[str]]


def draw(number: int, seed: str) -> list[Mutant]:
    """Return at least ``number`` mutants; each beginning of the list has its share of each room."""
    files = {room: sorted((PACKAGE / room).rglob("*.py")) for room in ROOMS}
    lines = {room: sum(len(one.read_text().splitlines()) for one in files[room]) for room in ROOMS}
    placed = list[tuple[float, str, Mutant]]()
    for room in ROOMS:
        known = [mutant for file in files[room] for mutant in mutants(file)]
        share = -(-number * lines[room] // sum(lines.values()))
        drawn = random.Random(f"{seed} {room}").sample(known, min(share, len(known)))
        placed += [((index + 0.5) / len(drawn), room, one) for index, one in enumerate(drawn)]
    return [mutant for *_, mutant in sorted(placed, key=lambda each: each[:2])]


class Reached:
    """What one run of all tests shows: which tests reach a line, and how long each takes."""

    def __init__(self, folder: Path) -> None:
        times, data = folder / "times.json", folder / "coverage"
        if not times.exists():
            options = ["-q", "-n", str(os.cpu_count()), "-p", "no:cacheprovider", "--cov-report="]
            options += ["--cov-context=test", *(f"--cov=demandops.{room}" for room in ROOMS)]
            told = {"COVERAGE_FILE": str(data), "MUTANTS_TIMES": str(times)}
            command = [sys.executable, "-m", "pytest", "-p", "tests.mutants.run", *options]
            subprocess.run([*command, *TESTS], env=os.environ | told, check=False)
        self._seconds: dict[str, float] = json.loads(times.read_text())
        self._data = coverage.CoverageData(str(data))
        self._data.read()

    @lru_cache(maxsize=1024)  # noqa: B019 - there is one object
    def _by_line(self, path: Path) -> dict[int, set[str]]:
        found = self._data.contexts_by_lineno(str(path))
        return {line: {each.partition("|")[0] for each in by if each} for line, by in found.items()}

    def tests(self, mutant: Mutant) -> list[str]:
        """Return the tests to run for a mutant, the fastest first."""
        by_line = self._by_line(mutant.path)
        found = set[str]().union(*(by_line.get(line, ()) for line in mutant.lines))
        if not found and by_line.keys() & mutant.lines:  # the line runs when the module is imported
            found = found.union(*by_line.values())
        passed = found & self._seconds.keys()
        return sorted(passed, key=lambda test: self._seconds[test])[:MOST_TESTS]


# pytest calls these in the run of all tests, in which this module is a plugin.
seconds = Counter[str]()


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    seconds[report.nodeid] += report.duration if report.outcome == "passed" else math.inf


def pytest_sessionfinish(session: pytest.Session) -> None:
    if not hasattr(session.config, "workerinput"):  # xdist reports all to this process
        passed = {test: time for test, time in seconds.items() if time < math.inf}
        Path(os.environ["MUTANTS_TIMES"]).write_text(json.dumps(passed))


class MutatedModule(SourceFileLoader):
    """Finds and loads a mutant in place of its module."""

    def __init__(self, mutant: Mutant) -> None:
        parts = mutant.path.relative_to(PACKAGE.parent).with_suffix("").parts
        name = ".".join(parts).removesuffix(".__init__")
        super().__init__(name, str(mutant.path))
        self._compiled = compile(mutant.tree(), self.path, "exec", dont_inherit=True)

    def find_spec(self, name: str, path: object, target: object = None) -> ModuleSpec | None:
        known = name == self.name
        return (
            importlib.util.spec_from_file_location(name, self.path, loader=self) if known else None
        )

    def get_code(self, fullname: str) -> CodeType:
        return self._compiled


class Only:
    """Runs only some of the collected tests."""

    def __init__(self, tests: list[str]) -> None:
        self._tests = set(tests)

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = [item for item in items if item.nodeid in self._tests]


def warm_up() -> None:
    """Import the libraries of the program and the tests, so that a fork imports only these two."""
    for name in ("tests.conftest", "tests.scenarios.running"):
        importlib.import_module(name)
    for name in [name for name in sys.modules if name.partition(".")[0] in ("demandops", "tests")]:
        del sys.modules[name]


def start(mutant: Mutant | None, tests: list[str]) -> int:
    """Start tests in a fork, with a mutant in place of its module; return the process id."""
    if pid := os.fork():
        return pid
    code = 1
    try:
        os.setsid()
        null = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(null, stream)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S))
        if mutant:
            sys.meta_path.insert(0, MutatedModule(mutant))
        options = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "--hypothesis-seed=0"]
        files = dict.fromkeys(test.partition("::")[0] for test in tests)
        code = int(pytest.main([*options, *files], plugins=[Only(tests)]))
    finally:
        os._exit(code)


def results(tries: list[Try], end: float) -> Iterator[tuple[int, bool]]:
    """Yield (index, whether a test failed) for each try that began before ``end``."""
    running = dict[int, tuple[int, float]]()
    waiting = list(enumerate(tries))[::-1]
    while running or (waiting and time.monotonic() < end):
        if waiting and len(running) < (os.cpu_count() or 1) and time.monotonic() < end:
            index, (mutant, tests) = waiting.pop()
            running[start(mutant, tests)] = index, time.monotonic()
            continue
        pid, status = os.waitpid(-1, os.WNOHANG)
        if pid:
            yield running.pop(pid)[0], status != 0
            continue
        for late in [pid for pid, (_, at) in running.items() if time.monotonic() - at > WAIT_S]:
            os.killpg(late, signal.SIGKILL)
        time.sleep(0.02)


def digest_of_code_and_tests() -> str:
    folders = [*(PACKAGE / room for room in ROOMS), *(ROOT / name for name in (*TESTS, *FURTHER))]
    told = hashlib.sha256()
    for file in sorted(file for folder in folders for file in folder.rglob("*.[pyj]*[!c]")):
        told.update(f"{file.relative_to(ROOT)}".encode() + file.read_bytes())
    return told.hexdigest()[:12]


def main() -> int:
    os.chdir(ROOT)
    number, seed = int(os.environ.get("MUTANTS") or 600), os.environ.get("SEED") or "1"
    folder = ROOT / "build" / "mutants" / digest_of_code_and_tests()
    folder.mkdir(parents=True, exist_ok=True)
    reached, drawn = Reached(folder), draw(number, seed)
    end = time.monotonic() + 60 * float(os.environ.get("MUTANTS_MINUTES") or 60)
    warm_up()
    tests = {one: reached.tests(one) for one in drawn}
    controls: list[Try] = [(None, named) for named in tests.values() if named][:CONTROLS]
    for index, fails in results(controls, end):
        if fails:
            print(f"mutants: without a mutant, one of these fails: {controls[index][1]}")
            return 1
    names = {one: f"{one.path.relative_to(PACKAGE)}:{max(one.lines)}: {one.text}" for one in drawn}
    file = folder / "found.jsonl"
    known = dict(map(json.loads, file.read_text().splitlines())) if file.exists() else {}
    known |= {names[one]: False for one in drawn if not tests[one]}
    left = [one for one in drawn if names[one] not in known]
    with file.open("a") as written:
        for index, found in results([(one, tests[one]) for one in left], end):
            known[names[left[index]]] = found
            print(json.dumps([names[left[index]], found]), file=written, flush=True)
    tried = [one for one in drawn if names[one] in known]
    survivors = [one for one in tried if not known[names[one]]]
    for one in sorted(survivors, key=lambda each: names[each]):
        print(f"not found by {len(tests[one])} tests: {names[one]}")
    for room in ROOMS:
        of_room = [one for one in tried if one.path.is_relative_to(PACKAGE / room)]
        print(f"{room}: {len({*of_room} - {*survivors})} of {len(of_room)}")
    share = 1 - len(survivors) / max(len(tried), 1)
    print(f"mutants: {share:.1%} of {len(tried)} found, {len(drawn) - len(tried)} left to try")
    return 0


if __name__ == "__main__":
    sys.exit(main())
