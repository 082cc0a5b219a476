"""The generator: accepts demands from any thread and runs the worker thread."""

from __future__ import annotations

import re
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import ExitStack
from pathlib import Path

from demandops.base import settings
from demandops.base.errors import Refused
from demandops.base.runtime import REAL, Runtime, log
from demandops.model.config.config import Config
from demandops.model.demand.demand import Demand
from demandops.model.demand.goals import read_goal
from demandops.repo.git.remote_repository import Slot, connect
from demandops.repo.git.repository import reading, using
from demandops.repo.git.signing import Signer
from demandops.repo.history import commit_log
from demandops.repo.load import snapshot as snapshots
from demandops.repo.load.snapshot import Progress, Snapshot
from demandops.serve.agenda import heartbeat_in
from demandops.serve.approvals import Approvals
from demandops.serve.demands import Demands, Remote
from demandops.serve.journal import Listener, Ticket, open_journal
from demandops.serve.worker import Worker

_STOP_TIMEOUT_S = 5.0
# How much longer a stop waits for the threads; a running call of git or ssh-keygen ends in it.
_GRACE_S = 5.0
# How long demands wait while the server takes no commit at all, as with a read-only key or a branch
# that is protected: somebody may be about to mend that. Then they are answered.
_REFUSAL_PATIENCE_S = 120.0
_OPERATION = re.compile(r"[A-Za-z0-9_.-]{1,100}")
_UNREAD = Demand("put")  # of a ticket whose goal cannot be read


class Generator:
    """Turns demands into commits of one state repo; any thread may call all its methods."""

    def __init__(  # noqa: PLR0913 - each is a setting of its own
        self,
        state_repo: str,
        *,
        data: Path | None = None,
        queue_limit: int = settings.QUEUE_LIMIT,
        # None is for a single client: without a limit, and all demands keep their order.
        requester_limit: int | None = settings.REQUESTER_QUEUE_LIMIT,
        start_offline: bool = True,
        # Whether receipts list the releases that a demand needs or removes.
        with_targets: bool = False,
        # Seconds between two fetches while no demand arrives; 0 means none at an interval. A
        # repository on this disk is checked each second, with 0 each minute.
        fetch_interval: float = 0.0,
        signing_key: Path | None = None,
        refusal_patience_s: float = _REFUSAL_PATIENCE_S,
        progress: Progress = lambda done, total: None,
        runtime: Runtime = REAL,
    ) -> None:
        heartbeat = heartbeat_in(settings.alive_file())
        signer = Signer(signing_key) if signing_key else None
        with ExitStack() as undo:
            with using(f"the data folder of {state_repo}"):
                self._slot = Slot(data or settings.data_home(state_repo))
                undo.callback(self._slot.close)
                self._journal = open_journal(self._slot.folder)
            with using(state_repo):
                repository = connect(state_repo, self._slot.folder, allow_offline=start_offline)
                repository.signer, repository.runtime = signer, runtime

                def start() -> Snapshot:
                    tip = repository.tip()
                    snapshots.refuse_other_render_version(repository.objects, tip)
                    return snapshots.start_at(repository.objects, tip, progress)

                try:
                    snapshot = start()
                except Exception:  # a power cut may have damaged the clone, which is only a copy
                    if not repository.renew_if_damaged():
                        raise
                    snapshot = start()
            undo.pop_all()
        self._repository, self._runtime = repository, runtime
        self.address = repository.address
        self.remote_status = remote = Remote(self.address, runtime)
        self._demands = Demands(self._journal, queue_limit, requester_limit, remote, runtime)
        token_file = settings.forge_token_file()
        self._worker = Worker(
            repository,
            snapshot,
            self._demands,
            Approvals(repository, snapshot.state, self._demands, with_targets, token_file),
            fetch_interval,
            heartbeat,
            refusal_patience_s,
        )
        self.fetch_now, self.withdraw = self._worker.fetch_now, self._demands.withdraw
        self.take_over_nodes = self._worker.take_over_nodes
        self.nodes_changed = self._worker.nodes_changed
        self.includes, self.unchanged = repository.includes, repository.unchanged
        self._finished: Future[bool] | None = None
        self._stop_lock = runtime.lock()
        self._threads = [
            runtime.keep_running("writer", self._worker.run),
            runtime.keep_running("journal", self._demands.journal_arrivals),
        ]

    @property
    def snapshot(self) -> Snapshot:
        return self._worker.snapshot

    def snapshot_at(self, revision: str) -> Snapshot:
        # at a commit or a time, without a fetch; it may take seconds
        objects = self._repository.reopened()  # as libgit2's objects belong to one thread
        tip, now = self.snapshot.commit, self._runtime.now()
        with reading(self.address, objects):
            commit = commit_log.resolve(objects, tip, revision, now)
            return snapshots.state_at(objects, commit.id)

    @property
    def unpublished(self) -> int:
        return self._demands.unpublished

    @property
    def failures(self) -> dict[str, str]:
        return self._runtime.failures

    def submit(
        self,
        goal: object,
        operation: str | None = None,
        listener: Listener = lambda stage, text: None,
    ) -> Ticket:
        """Queue a demand, or its goal as plain data, and return its ticket at once.

        Every error is in the ticket's future.

        One that was not accepted has ``ShuttingDown``, ``QueueFull``, ``Refused`` or
        ``StateRepoError``, and its listener is not called. If the generator ends before the demand
        is published or approved, the error is ``ShuttingDown`` or ``Unsound``, and the next start
        resumes the demand. ``operation`` is an id that no other demand ever had. ``listener`` is
        called in the worker thread, and of a demand that is given up in another one.
        """
        operation = operation or self._runtime.fresh_id()
        if not _OPERATION.fullmatch(operation):
            message = f"{operation!r} is not an operation id; use at most 100 letters, digits, "
            message += "dashes, dots and underscores"
            raise ValueError(message)
        ticket = Ticket(operation, _UNREAD, self._runtime.now(), listener=listener)
        limits = self.snapshot.state.config.repo_settings.limits
        try:
            # here, so that what cannot be read is not journaled, and does not wait in the queue
            ticket.demand = read_goal(goal, limits)
        except Refused as refused:
            ticket.refuse(refused)
            return ticket
        ticket.base = str(self.snapshot.commit)
        self._demands.arrive(ticket)
        return ticket

    def changes_since(self, since: str) -> tuple[str, list[str] | None]:
        # the newest published commit, and the changed paths, None if ``since`` is unknown
        commit = str(self.snapshot.commit)
        return commit, self._repository.changed_paths(since, commit)

    def on_publish(self, listener: Callable[[Config], None]) -> None:
        # the worker calls it, so it must return at once
        self._worker.listeners.append(listener)

    def stop(self, timeout: float = _STOP_TIMEOUT_S) -> Future[bool]:
        """Refuse further demands, finish the queued ones and stop; return at once.

        After ``timeout`` seconds, demands that are unpublished or await approval stay in the
        journal for the next start, and their futures raise ``ShuttingDown``. Only the first call's
        timeout counts. The future returns whether everything was published, apart from demands that
        await approval, and false if the threads have not ended :data:`_GRACE_S` after the timeout.
        """
        with self._stop_lock:
            if self._finished is not None:
                return self._finished
            self._finished = finished = Future[bool]()
        self._demands.close()

        def end() -> None:
            if not self._have_ended(timeout):
                self._worker.end_soon()
            if not self._have_ended(_GRACE_S):  # a thread may still hold locks
                log.error("the generator did not end; its demands stay in the journal")
                finished.set_result(False)
                return
            unpublished = self._demands.unpublished
            self._journal.close()
            self._slot.close()
            finished.set_result(not unpublished)

        self._runtime.start_thread("stop", end)
        return finished

    def _have_ended(self, timeout: float) -> bool:
        end = self._runtime.monotonic() + timeout
        for thread in self._threads:
            thread.join(max(0.0, end - self._runtime.monotonic()))
        return not any(thread.is_alive() for thread in self._threads)

    def close(self, timeout: float = _STOP_TIMEOUT_S) -> bool:
        return self.stop(timeout).result()
