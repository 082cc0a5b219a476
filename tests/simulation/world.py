"""Machines with generators, a remote, and a network and disks that fail, all in one thread.

The generators are the production code. Only three things are replaced. ``Turns`` replaces the
clock, random numbers and threads. A push or fetch only moves a reference, because all clones share
one folder of objects. A call of ``fsync`` for the journal is recorded, so that a crash leaves only
what a disk may have kept.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any

import pygit2
from demandops.base.errors import DemandOpsError, StateRepoError
from demandops.base.runtime import Runtime
from demandops.decide.discovery import ClusterNode
from demandops.model.config.inventory import NODE_LABEL
from demandops.repo.git.remote_repository import GitResult, RemoteRepository
from demandops.repo.git.repository import MAIN, FetchInterrupted
from demandops.serve import generator
from demandops.serve.generator import Generator
from greenlet import getcurrent

from tests.kit.clock import Turns

FETCH_INTERVAL_S = 30.0
RACK = "rack1"
"""The node that nobody lists, because the cluster has it."""
_LABELS = {NODE_LABEL: RACK, "demandops/type": "rack"}
MACHINE = ClusterNode("machine-7", _LABELS, {"slots": "1"}, is_cordoned=False, writers={})
_JOURNAL = "outbox.jsonl"


class Machine(Runtime):
    def __init__(self, world: World, name: str) -> None:
        super().__init__()
        self.world, self.name, self.turns = world, name, world.turns
        for each in ("now", "monotonic", "uniform", "fresh_id", "sleep", "event", "condition"):
            setattr(self, each, getattr(self.turns, each))
        self.when_unsound = self.crash
        self.generator: Generator | None = None
        self.is_up = False
        self.threads: list[Any] = []
        self.folder = world.folder / f"{name}-0"
        self.disk = Disk(self)
        self.started_at = 0.0
        self.crashes_in = self.losses = self.rejections = 0
        self.is_cut_off, self.delay = False, 0.0
        self.has_rejected = False
        self.nodes_read: dict[str, list[ClusterNode]] = {}

    def processor_s(self) -> float:
        return 0.0

    def start_thread(self, name: str, target: Callable[[], object]) -> Any:
        self.threads.append(self.turns.start_thread(name, target))
        return self.threads[-1]

    def start(self) -> None:
        """Start the generator in a thread; try again while it cannot fetch from the remote."""
        self.is_up = True
        self.start_thread("start", self._start)

    def _start(self) -> None:
        while True:
            try:
                made = Generator(
                    self.name, data=self.folder, runtime=self, fetch_interval=FETCH_INTERVAL_S
                )
                break
            except StateRepoError as error:
                assert "cannot be fetched" in str(error), error
                self.sleep(5)
        self.nodes_read = {}
        made.take_over_nodes(lambda config: self._read_nodes())
        self.generator, self.started_at = made, self.monotonic()
        self.world.on_start(self)

    def _read_nodes(self) -> dict[str, list[ClusterNode]]:
        if not self.is_cut_off:
            self.nodes_read = {"c-its": [*self.world.nodes.values()]}
        return self.nodes_read

    def failed(self, name: str, error: Exception) -> None:
        super().failed(name, error)
        if not isinstance(error, DemandOpsError):
            self.world.failure = self.world.failure or error

    def may_crash(self) -> None:
        """Count ``crashes_in`` down and crash at 0; after a crash, this call never returns."""
        if self.crashes_in and getcurrent() in self.threads:
            self.crashes_in -= 1
            if not self.crashes_in:
                self.crash()

    def stop(self, timeout: float) -> None:
        """Stop the generator; its threads have the time for what is queued, and the disk syncs."""
        assert self.generator is not None
        stopped = self.generator.stop(timeout)
        self.turns.wait(lambda: stopped.done() or not self.is_up)
        if self.is_up:
            self._forget_generator()

    def _forget_generator(self) -> list[Any]:
        """Return its threads, which are unwound at the end of the history."""
        self.is_up, self.generator, self.crashes_in = False, None, 0
        threads, self.threads = self.threads, []
        self.world.dead += threads
        return threads

    def crash(self) -> None:
        """Stop all threads and lose what is not on the disk, which they cannot reach."""
        threads, old = self._forget_generator(), self.folder
        self.folder = self.world.folder / f"{self.name}-{next(self.world.numbers)}"
        slot = self.folder / "slot-0"
        slot.mkdir(parents=True)
        if (text := self.disk.left_of(old / "slot-0")) is not None:
            slot.joinpath(_JOURNAL).write_bytes(text)
        clone = old / "slot-0" / "clone.git"
        if clone.exists() and self.turns.chance.randrange(4):
            clone.rename(slot / "clone.git")
        self.disk = Disk(self)
        for path in (*slot.glob(_JOURNAL), slot):
            self.disk.sync(path)
        self.turns.stop(threads)


class Disk:
    """The durable part of a journal: file names and contents as of their last ``fsync``."""

    def __init__(self, machine: Machine) -> None:
        self._machine = machine
        self._names: dict[str, int] = {}
        self._contents: dict[int, bytes] = {}

    def sync(self, path: Path) -> None:
        """Record what ``fsync`` makes durable: names or a content; crash before or after."""
        self._machine.may_crash()
        if path.is_dir():
            self._names = {found.name: found.stat().st_ino for found in path.iterdir()}
        else:
            self._contents[path.stat().st_ino] = path.read_bytes()
        self._machine.may_crash()

    def left_of(self, folder: Path) -> bytes | None:
        """Return what is left of a journal after a crash of the process or of the whole machine."""
        chance, path = self._machine.turns.chance, folder / _JOURNAL
        now = {_JOURNAL: path.stat().st_ino} if path.exists() else {}
        if chance.randrange(2):  # only the process crashes, so all that was written stays
            return path.read_bytes() if now else None
        inode = chance.choice([now, self._names]).get(_JOURNAL)
        synced = self._contents.get(inode or 0, b"")
        if inode is None:
            return None
        if inode != now.get(_JOURNAL):
            return synced
        text = path.read_bytes()
        if text.startswith(synced):
            return text[: len(synced) + chance.randrange(len(text) - len(synced) + 1)]
        return chance.choice([text, synced])


class Clone(RemoteRepository):
    """A clone whose git commands are simulated, on a network that may fail."""

    def __init__(self, machine: Machine, folder: Path, allow_offline: bool) -> None:
        self._machine = machine
        super().__init__(machine.name, folder, allow_offline=allow_offline)

    def tidy(self) -> None:
        """Do not repack, because all clones share one folder of git objects."""

    def _clone(self) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)
        partial = self._folder.with_name("partial")
        shutil.rmtree(partial, ignore_errors=True)
        partial.joinpath("refs").mkdir(parents=True)
        partial.joinpath("HEAD").write_text("ref: refs/heads/main\n")
        partial.joinpath("config").write_text(
            "[core]\n\trepositoryformatversion = 0\n\tbare = true\n"
            f'[remote "origin"]\n\turl = {self._url}\n'
        )
        partial.joinpath("objects").symlink_to(Path(self._machine.world.remote.path) / "objects")
        folder, self._folder = self._folder, partial
        try:
            self._fetch()
        finally:
            self._folder = folder
        partial.rename(self._folder)

    def _run_git(
        self,
        *command: str,
        urgent: Callable[[], bool] = lambda: False,
        timeout: float = 0,
    ) -> GitResult:
        machine, verb = self._machine, command[0]
        self._wait(urgent, machine.delay)
        if self._aborted or machine.is_cut_off:
            return _failed("fatal: unable to access the remote: Connection refused")
        if verb == "push" and machine.rejections:
            machine.rejections, machine.has_rejected = machine.rejections - 1, True
            return _pushed(command, "[remote rejected] (pre-receive hook declined)")
        if verb == "fsck":
            return GitResult(0, "", "")
        machine.may_crash()
        result = getattr(self, f"_{verb.replace('-', '_')}_there")(*command[1:])
        machine.may_crash()
        self._wait(urgent, machine.delay)
        if machine.losses:
            machine.losses -= 1
            return _failed("fatal: the remote end hung up unexpectedly")
        return result

    def _wait(self, urgent: Callable[[], bool], seconds: float) -> None:
        end = self._machine.monotonic() + seconds
        while not self._aborted:
            if urgent():
                raise FetchInterrupted("the fetch was interrupted by a demand")
            left = end - self._machine.monotonic()
            self._machine.sleep(min(max(left, 0), 0.5))
            if left <= 0:
                return

    def _fetch_there(self, *arguments: str) -> GitResult:
        source, target = arguments[-1].removeprefix("+").split(":")
        file = self._folder / target
        tip = b"%s\n" % str(self._machine.world.remote.references[source].target).encode()
        with suppress(FileNotFoundError):
            if file.read_bytes() == tip:
                return GitResult(0, "", "")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(tip)
        return GitResult(0, "", "")

    def _ls_remote_there(self, *arguments: str) -> GitResult:
        references = self._machine.world.remote.references
        wanted = [each.rstrip("*") for each in arguments[2:]]
        found = [name for name in references if any(name.startswith(each) for each in wanted)]
        lines = (f"{references[name].target}\t{name}" for name in sorted(found))
        return GitResult(0, "\n".join(lines), "")

    def _push_there(self, *arguments: str) -> GitResult:
        world = self._machine.world
        references = world.remote.references
        (lease,) = [each for each in arguments if each.startswith("--force-with-lease=")]
        reference, _, expected = lease.partition("=")[2].partition(":")
        commit = arguments[-1].split(":")[0]
        now = str(references[reference].target) if reference in references else ""
        if now != expected:
            return _pushed(arguments, "[rejected] (stale info)")
        if not commit:
            references.delete(reference)
            return _pushed(arguments, "[deleted]", 0)
        if reference == MAIN:
            if not world.remote.descendant_of(commit, now):
                world.failure = AssertionError("history was rewritten")
            machine = self._machine
            world.pushed_by[commit] = machine, machine.started_at, machine.monotonic()
        references.create(reference, commit, force=True)
        world.on_push()
        return _pushed(arguments, f"{now}..{commit}", 0)


def _failed(text: str) -> GitResult:
    return GitResult(128, "", text)


def _pushed(command: tuple[str, ...], what: str, code: int = 1) -> GitResult:
    return GitResult(code, f"{'!' if code else ' '}\t{command[-1]}\t{what}\n", "")


class World:
    def __init__(self, seed: int, template: Path, folder: Path, machines: int) -> None:
        self.turns, self.folder, self.numbers = Turns(seed), folder, count(1)
        self.remote = pygit2.Repository(str(shutil.copytree(template, folder / "remote.git")))
        self.pushed_by: dict[str, tuple[Machine, float, float]] = {}
        """For each pushed tip of main: the machine, when its generator started, when it pushed."""
        self.dead: list[Any] = []
        self.on_start: Callable[[Machine], object] = lambda machine: None
        self.failure: Exception | None = None
        self.on_push: Callable[[], object] = lambda: None
        self.machines = [Machine(self, f"machine{number}") for number in range(machines)]
        self.last_jump = -1.0
        """When the clocks were last set forward."""
        self.nodes = {RACK: MACHINE}
        """The nodes that the cluster has, by id."""

    @property
    def tip(self) -> str:
        return str(self.remote.references[MAIN].target)

    @contextmanager
    def running(self) -> Iterator[None]:
        by_name = {machine.name: machine for machine in self.machines}

        def connect(address: str, folder: Path, *, allow_offline: bool) -> Clone:
            return Clone(by_name[address], folder / "clone.git", allow_offline)

        def sync(handle: int) -> None:
            path = Path(f"/proc/self/fd/{handle}").readlink()
            if "clone.git" in path.parts:
                return
            for machine in self.machines:
                if path.is_relative_to(machine.folder / "slot-0"):
                    machine.disk.sync(path)

        before = generator.connect, os.fsync, os.fdatasync
        generator.connect, os.fsync, os.fdatasync = connect, sync, sync  # type: ignore[assignment]
        try:
            for machine in self.machines:
                machine.start()
            yield
        finally:
            generator.connect, os.fsync, os.fdatasync = before
            for machine in self.machines:
                self.dead += machine.threads
            self.turns.end(self.dead)

    def tell_nodes(self) -> None:
        for machine in self.machines:
            if machine.generator and not machine.is_cut_off:
                machine.generator.nodes_changed()

    def set_clocks(self, seconds: float) -> None:
        self.turns.set_by(seconds)
        if seconds > 0:
            self.last_jump = self.turns.monotonic()
