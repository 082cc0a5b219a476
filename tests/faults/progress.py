"""What a run has tried: printed while the run goes on, and stored for a run that resumes it."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path

import demandops
from demandops.base.settings import data_folder

from tests.faults.injection import Result

_TELL_EVERY_S = 30.0


class Passed:
    """A file of the tasks that broke no promise, from which a later run can resume.

    The first line of the file is a digest of the program. Each further line is a task with its
    results. ``sound`` maps each task of the file to its results. Without ``resume``, or if the
    digest is not that of the current program, the file begins anew.
    """

    def __init__(self, file: Path, *, resume: bool) -> None:
        self._file = file
        self.sound: dict[str, list[Result]] = {}
        program = json.dumps(_program())
        lines = file.read_text().splitlines() if resume and file.exists() else []
        if lines and lines[0] != program:
            print("the program has changed since the interrupted run, so all tasks are tried again")
            lines = []
        for line in lines[1:]:
            with suppress(ValueError):  # cut off by the interruption
                task, results = json.loads(line)
                self.sound[task] = [
                    Result(
                        each["part"], tuple(each["where"]), each["fault"], (), tuple(each["known"])
                    )
                    for each in results
                ]
        file.parent.mkdir(exist_ok=True)
        file.write_text("".join(f"{line}\n" for line in lines or [program]))

    def add(self, task: str, results: Iterable[Result]) -> None:
        """Keep the results of a task, unless the task broke a promise and must be tried again."""
        kept = [asdict(result) for result in results]
        if not any(each["problems"] for each in kept):
            with self._file.open("a") as file:
                file.write(json.dumps([task, kept]) + "\n")

    def finish(self) -> None:
        """Delete the file, because the run has reached its end."""
        self._file.unlink()


class Progress:
    """Prints now and then how many tasks are done, in what time, and with how many violations."""

    def __init__(self, total: int) -> None:
        self._total, self._done, self._wrong = total, 0, 0
        self._began = self._told = time.monotonic()

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._began

    def add(self, results: Iterable[Result]) -> None:
        self._done += 1
        self._wrong += sum(bool(result.problems) for result in results)
        now = time.monotonic()
        if now - self._told >= _TELL_EVERY_S:
            self._told = now
            left = self.seconds / self._done * (self._total - self._done)
            print(
                f"{self._done} of {self._total} tasks, {self.seconds:.0f} s, "
                f"{self._wrong} with a violation; about {left:.0f} s to go",
                flush=True,
            )


def _program() -> str:
    """Return a digest of the program that is tried: its code and its data."""
    told = sha256()
    for folder in (Path(demandops.__file__).parent, data_folder("templates")):
        for path in sorted(folder.rglob("*")):
            if path.is_file() and path.suffix != ".pyc":
                told.update(f"{path.relative_to(folder)}\0".encode())
                told.update(path.read_bytes())
    return told.hexdigest()
