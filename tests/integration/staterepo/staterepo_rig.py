"""What the tests of the state repo share: demands, a person with a clone, and looks at history.

History is read by git itself, so that the generator's own reading of it is not what is trusted.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime, timezone
from functools import lru_cache
from pathlib import Path
from typing import Any

import pygit2
from demandops.config.config import CONFIG_ROOTS
from demandops.config.load import load
from demandops.decision import State, decide
from demandops.ledger.apply import Ledger
from demandops.plan.views.bookkeeping import as_data, bookkeeping
from demandops.service import Generator, Receipt, Ticket
from demandops.staterepo import new_repo, reader
from demandops.staterepo.load import snapshot as snapshots

Goal = dict[str, Any]
Books = dict[str, Any]

NOW = datetime(2026, 3, 1, 12, 0, tzinfo=timezone.utc)
PATIENCE_S = 15.0
"""How long an answer may take that has to come."""

GIT_ENVIRONMENT = {
    "GIT_CONFIG_GLOBAL": os.devnull,
    "GIT_CONFIG_NOSYSTEM": "1",
    "GIT_AUTHOR_NAME": "Petra Platform",
    "GIT_AUTHOR_EMAIL": "petra@example.org",
    "GIT_COMMITTER_NAME": "Petra Platform",
    "GIT_COMMITTER_EMAIL": "petra@example.org",
    "GIT_TERMINAL_PROMPT": "0",
    "LC_ALL": "C.UTF-8",
}

_DRIVER = Path(__file__).parents[2] / "kit" / "driver.py"
_CHECKOUT = Path(__file__).parents[3]


def init(path: Path) -> Path:
    new_repo.init(path, NOW, bare=True, gitops="flux")
    return path


# ---- demands ----


def goal(number: int, *, shutdown: bool = False, vehicle: int | None = None) -> Goal:
    """Demand ``number``: claims of its own on an application and a connection that others share."""
    name = f"vehicle{(number if vehicle is None else vehicle) % 4:02}"
    requesters = [f"user{number}", "station00"]
    ego = f"/vehicles/{name}/ego_data"
    return {
        "id": f"demand-{number}",
        "shutdown": shutdown,
        "apps": [
            {
                "header": {"id": f"edge/fusion-{number % 5}", "node_id": "edge"},
                "type": 1,
                "object_detection_fusion_app": {
                    "requester_ids": requesters,
                    "ego_data_topics": [{"topic_name": ego, "source_node_id": name}],
                    "pointcloud_topics": [
                        {"topic_name": "/stations/station00/pointcloud", "source_node_id": S}
                    ],
                },
            }
        ],
        "connections": [
            {
                "id": f"{name}/edge",
                "broker_node_id": "edge",
                "requester_ids": requesters,
                "source_node_id": name,
                "target_node_id": "edge",
                "source_topics": [ego],
                "target_topics": [ego],
                "type": 1,
            }
        ],
    }


S = "station00"


def leave(number: int) -> Goal:
    return goal(number, shutdown=True)


def impossible() -> Goal:
    """A demand that is refused whatever is booked."""
    made = goal(0)
    made["apps"][0]["header"]["node_id"] = "nowhere"
    return made


@lru_cache(maxsize=1)
def _fresh() -> State:
    files = new_repo.files()
    config = load({path: files[path] for path in files if path.split("/")[0] in CONFIG_ROOTS})
    return State.of(config, Ledger())


def books_after(goals: Iterable[Goal]) -> Books:
    """What bookkeeping says when ``goals`` are decided one by one, without any state repo."""
    state = _fresh()
    for made in goals:
        state = decide(state, made, NOW, lambda path: None).state
    return as_data(bookkeeping(state.ledger, state.config), "")


# ---- generators ----


@contextmanager
def running(address: str | Path, **options: Any) -> Iterator[Generator]:
    """A generator for the length of a block."""
    generator = Generator(str(address), **options)
    try:
        yield generator
    finally:
        generator.close(timeout=5)


def restart(address: str | Path) -> bool:
    """Start a generator that takes up what others left, and stop it; tell whether all is out."""
    return Generator(str(address)).close(timeout=PATIENCE_S)


def receipt(ticket: Ticket, timeout: float = PATIENCE_S) -> Receipt:
    return ticket.future.result(timeout)


def book(generator: Generator, *goals: Goal) -> list[Receipt]:
    """Book demands one after another."""
    return [receipt(generator.submit(made)) for made in goals]


class Gate:
    """Holds the worker at a stage of one demand, so that what comes next comes while it is busy."""

    def __init__(self, stage: str = "admitted") -> None:
        self._stage = stage
        self.reached = threading.Event()
        self.open = threading.Event()

    def __call__(self, stage: str, text: str) -> None:
        if stage == self._stage:
            self.reached.set()
            self.open.wait(PATIENCE_S)


@dataclass
class Stages:
    """A listener that remembers what it was told."""

    told: list[tuple[str, str]] = field(default_factory=list)

    def __call__(self, stage: str, text: str) -> None:
        self.told.append((stage, text))

    @property
    def names(self) -> list[str]:
        return [stage for stage, _ in self.told]


def wait_until(true: Callable[[], object], what: str, timeout: float = PATIENCE_S) -> None:
    end = time.monotonic() + timeout
    while not true():
        assert time.monotonic() < end, f"after {timeout:.0f} s still not so: {what}"
        time.sleep(0.01)


# ---- the generator in a process of its own ----


def demand(name: str, made: Goal, operation: str | None = None) -> dict[str, Any]:
    """One demand of a driver's plan."""
    return {"name": name, "goal": made, "operation": operation or f"op-{name}"}


@dataclass
class Told:
    """What a driver said before its end."""

    sent: list[str] = field(default_factory=list)
    answers: dict[str, dict[str, Any]] = field(default_factory=dict)
    withdrawn: list[str] = field(default_factory=list)
    finished: bool | None = None
    waits: dict[str, float] = field(default_factory=dict)
    """Seconds from a demand to its answer."""
    first: float = 0.0
    last: float = 0.0
    """When the first demand was sent and the last was answered, on this machine's clock."""


class Run:
    """A generator's process, and what it says."""

    def __init__(self, pipe: Path) -> None:
        self._pipe = pipe
        self._told = Told()
        self._ended = False
        self.pid = 0

    def listen(self, on_ready: Callable[[], object] = lambda: None) -> Told:
        """Read what the process says to its end."""
        sent: dict[str, float] = {}
        with self._pipe.open() as lines:
            for line in lines:
                event = json.loads(line)
                self._told.last = time.monotonic()
                if "ready" in event:
                    self.pid = event["ready"]
                    on_ready()
                elif "sent" in event:
                    self._told.sent.append(event["sent"])
                    sent[event["sent"]] = self._told.last
                    self._told.first = self._told.first or self._told.last
                elif "answer" in event:
                    self._told.answers[event["answer"]] = event
                    self._told.waits[event["answer"]] = self._told.last - sent[event["answer"]]
                elif "withdrawn" in event:
                    self._told.withdrawn.append(event["withdrawn"])
                elif "failed" in event:
                    raise AssertionError(f"the driver failed: {event['failed']}")
                else:
                    self._told.finished = event["finished"]
            self._ended = True
        return self._told

    def kill(self) -> None:
        """Kill -9 it, if it is there."""
        if self.pid and not self._ended:
            with suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)


class Drivers:
    """Starts generators in processes of their own."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._runs: list[Run] = []
        self._process = subprocess.Popen(
            [sys.executable, str(_DRIVER)],
            stdin=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(_CHECKOUT)},
        )

    def start(
        self,
        address: str | Path,
        lanes: list[list[dict[str, Any]]],
        *,
        opening: dict[str, Any] | None = None,
        die_at: str = "",
        cwd: Path | None = None,
    ) -> Run:
        pipe = self._folder / f"run-{len(list(self._folder.iterdir()))}"
        os.mkfifo(pipe)
        names = [*GIT_ENVIRONMENT, "DEMANDOPS_DATA_HOME"]
        plan = {
            "address": str(address),
            "lanes": lanes,
            "opening": opening,
            "die_at": die_at,
            "cwd": str(cwd or Path.cwd()),
            "environment": {name: os.environ[name] for name in names},
            "to": str(pipe),
        }
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(plan) + "\n")
        self._process.stdin.flush()
        self._runs.append(Run(pipe))
        return self._runs[-1]

    def kill_runs(self) -> None:
        """Kill what a failed test left running."""
        while self._runs:
            self._runs.pop().kill()

    def close(self) -> None:
        self.kill_runs()
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def listen_to_all(
    drivers: Drivers, runs: list[Run], on_ready: Callable[[], object] = lambda: None
) -> list[Told]:
    """Hear every process to its end; where the test is stopped, so are they.

    Args:
        on_ready: called once, when all have their clones.
    """
    waited_for = threading.Barrier(len(runs), on_ready)
    with ThreadPoolExecutor(len(runs)) as pool:
        try:
            return list(pool.map(lambda run: run.listen(lambda: waited_for.wait(60)), runs))
        except BaseException:
            drivers.kill_runs()  # else the pool would wait for them for ever
            raise


# ---- a person ----


class Person:
    """Somebody who changes the state repo in a clone of their own and pushes it."""

    def __init__(self, remote: Path, folder: Path) -> None:
        self._folder = folder
        git(folder.parent, "clone", "--quiet", str(remote), str(folder))

    def change(self, files: Mapping[str, str | None], message: str = "A person's change") -> str:
        """Commit ``files`` (nothing: remove) on the newest main and push it; return the commit."""
        git(self._folder, "fetch", "--quiet", "origin")
        git(self._folder, "reset", "--quiet", "--hard", "origin/main")
        for path, text in files.items():
            target = self._folder / path
            if text is None:
                target.unlink()
            else:
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_text(text)
        git(self._folder, "add", "--all")
        git(self._folder, "commit", "--quiet", "--message", message)
        git(self._folder, "push", "--quiet", "origin", "HEAD:main")
        return git(self._folder, "rev-parse", "HEAD")

    def edit(self, path: str, old: str, new: str) -> str:
        """Replace text that stands in a file exactly as it is said here."""
        git(self._folder, "fetch", "--quiet", "origin")
        text = git(self._folder, "show", f"origin/main:{path}") + "\n"
        assert old in text, f"{path} does not hold {old!r}"
        return self.change({path: text.replace(old, new)})


# ---- looks at history ----


def git(folder: Path, *args: str, check: bool = True) -> str:
    done = subprocess.run(
        ["git", "-C", str(folder), *args],
        capture_output=True,
        text=True,
        errors="replace",
        check=False,
        env={**os.environ, **GIT_ENVIRONMENT},
    )
    assert not check or done.returncode == 0, f"git {' '.join(args)}: {done.stdout}{done.stderr}"
    return done.stdout.removesuffix("\n")


@dataclass(frozen=True)
class Commit:
    """A commit as git itself tells it."""

    id: str
    parents: tuple[str, ...]
    summary: str
    trailers: tuple[tuple[str, str], ...]

    def one(self, key: str) -> str:
        return next((value for known, value in self.trailers if known == key), "")


_FORMAT = "%H%x1f%P%x1f%s%x1f%(trailers:only,unfold,separator=%x1e)%x1d"


def commits(repo: Path, revisions: str = "main") -> list[Commit]:
    """The commits behind the first one, oldest first."""
    text = git(repo, "log", "--reverse", f"--format={_FORMAT}", revisions)
    found = []
    for record in text.split("\x1d"):
        if not record.strip("\n"):
            continue
        commit, parents, summary, trailers = record.strip("\n").split("\x1f")
        pairs = [tuple(line.split(": ", 1)) for line in trailers.split("\x1e") if ": " in line]
        found.append(Commit(commit, tuple(parents.split()), summary, tuple(pairs)))  # type: ignore[arg-type]
    return [commit for commit in found if commit.parents]


def tip(repo: Path) -> str:
    return git(repo, "rev-parse", "main")


def operations(repo: Path) -> list[str]:
    """The operation ids of all demands' commits, oldest first."""
    return [found for commit in commits(repo) if (found := commit.one("Operation-Id"))]


def books(repo: Path, revision: str = "main") -> Books:
    state = snapshots.load(pygit2.Repository(str(repo)), revision).state
    return as_data(bookkeeping(state.ledger, state.config), "")


def claims(repo: Path, needle: str = "") -> list[str]:
    """The paths of claim files whose text holds ``needle``."""
    paths = git(repo, "ls-tree", "-r", "--name-only", "main", "ledger/").splitlines()
    paths = [path for path in paths if path.endswith(".yaml")]
    return [path for path in paths if needle in git(repo, "show", f"main:{path}")]


def differing(repo: Path, since: str | None = None) -> dict[str, tuple[str, ...]]:
    """What `demandops verify` finds fault with, in all of history or behind a commit."""
    with reader.opened(str(repo)) as opened:
        commits = opened.revisions(f"{since or root(repo)}..")
        verdicts = opened.verify(commits)
    return {verdict.summary: verdict.differing for verdict in verdicts if not verdict.holds}


def root(repo: Path) -> str:
    return git(repo, "rev-list", "--max-parents=0", "main")


def assert_sound(repo: Path, *, verify_last: int = 0) -> None:
    """Objects are whole, history is one line, no demand counts twice, every commit verifies.

    Args:
        verify_last: verify so many commits only, for verifying one takes a tenth of a second.
    """
    fsck = subprocess.run(
        ["git", "-C", str(repo), "fsck", "--strict", "--no-dangling", "--no-progress"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (fsck.returncode, fsck.stdout, fsck.stderr) == (0, "", "")
    made = commits(repo)
    assert [commit.id for commit in made if len(commit.parents) != 1] == []
    ids = operations(repo)
    assert sorted(ids) == sorted(set(ids))
    assert differing(repo, made[-verify_last - 1].id if verify_last else None) == {}
