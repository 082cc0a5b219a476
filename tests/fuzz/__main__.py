"""Run the targets: ``FUZZ_S=10 python -m tests.fuzz [NAME…]``; without names, run all of them."""

from __future__ import annotations

import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, redirect_stderr
from io import StringIO
from multiprocessing import get_context
from pathlib import Path
from random import SystemRandom
from typing import Any

from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as seeded
from hypothesis import strategies as st

from tests.fuzz import Target

try:
    import atheris
except ImportError:  # no wheel of Atheris for this system, so Hypothesis changes the seeds instead
    atheris = None

FOLDER = Path("build/fuzz").absolute()
LONGEST_S = 1
MOST_MEMORY = 2 << 30
_WALL_S = 60
_LONGEST_INPUT = 1 << 14
_ODD = (
    *(".inf", "-.nan", "1e999", "Infinity", "null", "~", "[]", "{}", "-1", "9" * 30, "!!int", "&a"),
    *("*a", "0001-01-01T00:00:00+23:59", "9999-12-31T23:59:59-23:59", "..", r"\\ud800", r"\x00"),
    r"\"\\Uffffffff\"",
)
"""Words that some parser has misread; libFuzzer inserts them anywhere."""


class TooSlow(BaseException):
    """Raised in a check that takes more than ``LONGEST_S`` of processor time."""


class Run:
    def __init__(self, target: Target, seconds: float) -> None:
        self.target, self.seconds = target, seconds
        self.folder = FOLDER / target.name
        self.calls = get_context("fork").Value("q", 0, lock=False)
        self._end = 0.0
        self._kept: dict[str, int] = {}

    def __call__(self) -> None:
        out = os.open(self.folder / "out", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(out, 1)
        os.dup2(out, 2)
        status = 1
        try:
            self._look()
            status = 0
        except BaseException:
            os.write(out, traceback.format_exc().encode())
        finally:
            os._exit(status)  # without the exit handlers that the parent has registered

    def _look(self) -> None:
        tempfile.tempdir = str(self.folder)  # the next run removes this folder
        signal.signal(signal.SIGVTALRM, _stop)
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MOST_MEMORY, used + MOST_MEMORY))
        self._end = time.monotonic() + self.seconds
        for one in self.target.seeds:
            self.check(one)
        if atheris and self.target.values is None:
            self._by_atheris()
        else:
            self._by_hypothesis()

    def check(self, value: Any) -> None:
        """Check one input; keep a finding unless a shorter input with the same error is kept."""
        self.calls.value += 1
        error = self._error(value)
        if isinstance(error, TooSlow):  # perhaps only because a first call has to prepare much
            error = self._error(value)
        if error is None:
            return
        stack = traceback.extract_tb(error.__traceback__)
        frames = [one for one in stack if _is_ours(one.filename)]
        where = f"{Path(frames[-1].filename).stem}-{frames[-1].lineno}" if frames else ""
        name = f"{type(error).__name__}-{where}"
        data = value if isinstance(value, bytes) else repr(value).encode("utf-8", "replace")
        if len(data) < self._kept.get(name, sys.maxsize):
            self._kept[name] = len(data)
            (self.folder / f"{name}.input").write_bytes(data)
            (self.folder / f"{name}.txt").write_text("".join(traceback.format_exception(error)))

    def _error(self, value: Any) -> BaseException | None:
        try:
            signal.setitimer(signal.ITIMER_VIRTUAL, LONGEST_S)
            self.target.check(value)
        except self.target.expected as error:
            faults = getattr(error, "faults", [])
            if self.target.names_files and not all(one.file and one.message for one in faults):
                return AssertionError(f"a fault without a file or message: {faults}")
        except BaseException as error:
            return error
        finally:
            signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        return None

    def _by_atheris(self) -> None:
        corpus = FOLDER / "corpus" / self.target.name
        corpus.mkdir(parents=True, exist_ok=True)
        for number, one in enumerate(self.target.seeds):
            (corpus / f"seed-{number}").write_bytes(one)
        text = b" ".join(self.target.seeds).decode("ascii", "ignore")
        words = {*_ODD, *re.findall(r"[\w./-]{2,30}", text)}
        dictionary = self.folder / "words"
        dictionary.write_text("".join(f'"{word}"\n' for word in sorted(words)))
        flags = [
            *(f"-max_total_time={self.seconds:.0f}", f"-timeout={_WALL_S}", "-rss_limit_mb=0"),
            *(f"-max_len={_LONGEST_INPUT}", f"-dict={dictionary}"),
            f"-artifact_prefix={self.folder}/",
        ]
        atheris.Setup([sys.argv[0], *flags, str(corpus)], self.check)
        atheris.Fuzz()

    def _by_hypothesis(self) -> None:
        values = self.target.values
        values = changed(self.target.seeds) if values is None else values
        without = {"database": None, "deadline": None, "suppress_health_check": list(HealthCheck)}
        while time.monotonic() < self._end:

            @seeded(SystemRandom().getrandbits(64))
            @settings(max_examples=200, phases=[Phase.generate], **without)
            @given(values)
            def some(value: Any) -> None:
                if time.monotonic() < self._end:
                    self.check(value)

            some()

    def findings(self, exitcode: int | None) -> list[str]:
        found = sorted(path.name for path in self.folder.iterdir() if path.suffix == ".input")
        return found if exitcode == 0 else [*found, f"the process ended with {exitcode}; see out"]


def _stop(number: int, frame: object) -> None:
    raise TooSlow(f"computes for more than {LONGEST_S} s")


def _is_ours(file: str) -> bool:
    return "/demandops" in file or ("/tests/" in file and "/fuzz/__main__" not in file)


def changed(seeds: tuple[bytes, ...]) -> st.SearchStrategy[bytes]:
    def change(seed: bytes, part: float, length: int, new: bytes) -> bytes:
        at = round(part * len(seed))
        return seed[:at] + new + seed[at + length :]

    cut = st.floats(0, 1), st.integers(0, 12), st.binary(max_size=12)
    return st.builds(change, st.sampled_from(seeds), *cut)


def run(one: Run) -> list[str]:
    shutil.rmtree(one.folder, ignore_errors=True)
    one.folder.mkdir(parents=True)
    process = get_context("fork").Process(target=one, daemon=True)
    process.start()
    process.join(one.seconds + 2 * _WALL_S)
    if process.is_alive():
        process.kill()
        process.join()
    found = one.findings(process.exitcode)
    note = f": {len(found)} FINDINGS" if found else ""
    print(f"{one.calls.value:9d} inputs of {one.target.name}{note}", flush=True)
    return [f"{one.folder.relative_to(Path.cwd())}/{name}" for name in found]


def main(names: list[str]) -> int:
    ours = ["demandops", "demandops_ros"]
    instrumented = atheris.instrument_imports(include=ours) if atheris else nullcontext()
    with instrumented, redirect_stderr(StringIO()):  # atheris prints each module's name
        from tests.fuzz import parsers, written
    targets = {one.name: one for one in (*parsers.TARGETS, *written.TARGETS)}
    seconds = float(os.environ.get("FUZZ_S", "10"))
    runs = [Run(targets[name], seconds) for name in names or targets]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        found = [one for found in pool.map(run, runs) for one in found]
    print("\n".join(found))
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
