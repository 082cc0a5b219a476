"""Generators in processes that tests can kill: the tests' end, and the program at the other end."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from demandops.serve import agenda
from demandops.serve.generator import Generator
from demandops.serve.journal import Journal

from tests.kit.goals import Goal
from tests.kit.limits import PATIENCE_S
from tests.kit.repo import force_writes

_CHECKOUT = Path(__file__).parents[2]


def demand(name: str, made: Goal, operation: str | None = None) -> dict[str, Any]:
    """Return a demand in the form that :meth:`Drivers.start` expects."""
    return {"name": name, "goal": made, "operation": operation or f"op-{name}"}


@dataclass
class Told:
    answers: dict[str, dict[str, Any]] = field(default_factory=dict)
    finished: bool | None = None
    """Whether the generator had published everything when it was closed; None if it was killed."""


Run = subprocess.Popen[str]


def listen(run: Run, on_ready: Callable[[], object] = lambda: None) -> Told:
    """Return all events of a run at its end; after ``on_ready``, it sends its demands."""
    told = Told()
    assert run.stdin is not None and run.stdout is not None
    for line in run.stdout:
        event = json.loads(line)
        if "ready" in event:
            on_ready()
            run.stdin.close()
        elif "answer" in event:
            told.answers[event["answer"]] = event
        else:
            told.finished = event["finished"]
    assert run.wait(PATIENCE_S) in (0, -signal.SIGKILL)
    return told


def listen_to_all(runs: list[Run], on_ready: Callable[[], object] = lambda: None) -> list[Told]:
    """Return the events of all runs at their end; ``on_ready`` is called when all have started."""
    waited_for = threading.Barrier(len(runs), on_ready)
    with ThreadPoolExecutor(len(runs)) as pool:
        return list(pool.map(lambda run: listen(run, lambda: waited_for.wait(PATIENCE_S)), runs))


class Drivers:
    def __init__(self, synced: bool) -> None:
        self._synced = synced
        self._runs: list[Run] = []

    def start(
        self,
        address: str | Path,
        lanes: list[list[dict[str, Any]]],
        *,
        dies: bool = False,
        key: Path | None = None,
        cwd: Path | None = None,
    ) -> Run:
        """Start a generator; if it ``dies``, it does so once its first demands are journaled.

        Its ``lanes`` are clients, each a list of demands. A client waits for an answer before it
        sends its next demand.
        """
        plan = {"address": str(address), "lanes": lanes, "dies": dies, "synced": self._synced}
        plan["key"] = str(key or "")
        roots = (_CHECKOUT, _CHECKOUT / "generator", _CHECKOUT / "ros_bridge")
        run = subprocess.Popen(
            [sys.executable, "-m", "tests.kit.processes"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=cwd,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(map(str, roots))},
        )
        self._runs.append(run)
        assert run.stdin is not None
        print(json.dumps(plan), file=run.stdin, flush=True)
        return run

    def close(self) -> None:
        for run in self._runs:
            run.kill()
            run.wait()


# ---- the program ----


def tell(**event: object) -> None:
    # a write of this size to a pipe is atomic, so lines of different threads do not mix
    os.write(1, (json.dumps(event) + "\n").encode())


def die_once_journaled() -> None:
    """Let this process kill itself when its first demands are in the journal."""
    append = Journal.append

    def append_and_die(*args: Any) -> None:
        append(*args)
        os.kill(os.getpid(), signal.SIGKILL)

    Journal.append = append_and_die  # type: ignore[method-assign]


def main() -> None:
    plan = json.loads(sys.stdin.readline())
    force_writes(plan["synced"])
    agenda.LONGEST_EVALUATION_S = 60.0  # so that no slow machine publishes a batch in two parts
    if plan["dies"]:
        die_once_journaled()
    key = plan["key"]
    generator = Generator(plan["address"], signing_key=Path(key) if key else None)
    tell(ready=True)
    sys.stdin.read()  # until all others are ready too

    def play(lane: list[dict[str, Any]]) -> None:
        for one in lane:
            future = generator.submit(one["goal"], one["operation"]).future
            if error := future.exception():
                tell(answer=one["name"], outcome=type(error).__name__, commit="")
            else:
                receipt = future.result()
                tell(answer=one["name"], outcome=receipt.outcome, commit=receipt.commit)

    with ThreadPoolExecutor(len(plan["lanes"])) as pool:
        list(pool.map(play, plan["lanes"]))
    tell(finished=generator.close(PATIENCE_S))


if __name__ == "__main__":
    main()
