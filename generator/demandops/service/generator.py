"""The generator: takes demands from any thread, and runs the one that settles them."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path

from demandops import settings
from demandops.config.config import Config
from demandops.errors import DemandOpsError, ShuttingDown, StateRepoError
from demandops.service.approvals.approvals import Approvals
from demandops.service.demand_queue import DemandQueue
from demandops.service.remote_status import StateRepoStatus
from demandops.service.ticket import Listener, Ticket, new_ticket
from demandops.service.worker import Worker
from demandops.staterepo.git import connect
from demandops.staterepo.git.signing import Signer
from demandops.staterepo.load.snapshot import Progress, Snapshot
from demandops.staterepo.write import commit_line
from demandops.staterepo.write.journal import Slot

log = logging.getLogger("demandops")

_STOP_TIMEOUT_S = 20.0


class Generator:
    """Takes demands from any thread and turns them into commits of one state repo."""

    def __init__(  # noqa: PLR0913 - one for each thing that a caller may set
        self,
        state_repo: str,
        *,
        data: Path | None = None,
        queue_limit: int = settings.QUEUE_LIMIT,
        patient: bool = True,
        with_targets: bool = False,
        fetch_interval: float = 0.0,
        signing_key: Path | None = None,
        progress: Progress = lambda done, total: None,
    ) -> None:
        """Open the state repo and start the worker; what an earlier run left over comes first.

        Args:
            state_repo: a folder with a bare repository, or a URL that git clones.
            data: where outbox and clone are kept; by default :func:`settings.data_home`.
            queue_limit: how many demands may wait.
            patient: whether to start while the remote is away, from what was fetched last.
            with_targets: whether receipts say which releases a demand needs.
            fetch_interval: seconds between two looks at what others published, while no demand
                comes; 0: a repository on this disk only, and seldom.
            signing_key: an SSH key that signs the commits (:mod:`demandops.staterepo.git.signing`).
            progress: told (files read, files in all) while the ledger is loaded.

        Raises:
            StateRepoError, InvalidInput: where the state repo or the key cannot be used.
        """
        signer = Signer(signing_key) if signing_key else None
        self._slot = Slot(data or settings.data_home(state_repo))
        try:
            repository = connect.connect(state_repo, self._slot.folder, log.info, patient=patient)
            repository.signer = signer
            snapshot = commit_line.first_snapshot(repository, progress)
        except BaseException:
            self._slot.close()
            raise
        self._repository = repository
        self.given_address = state_repo
        self.address = repository.address
        self.queue_limit = queue_limit
        self._queue = DemandQueue(self._slot.outbox, queue_limit)
        self._listeners: list[Callable[[Config], None]] = []
        self._approvals = Approvals(
            repository, self._queue, with_targets, settings.forge_token_file()
        )
        self._worker = Worker(
            repository,
            snapshot,
            self._queue,
            self._call_listeners,
            with_targets,
            self._approvals,
            fetch_interval,
        )
        self._finished: Future[bool] | None = None
        self._stop_lock = threading.Lock()
        for operation in self._queue.operations:
            log.info("taking up demand %s from the outbox", operation)
        self._thread = threading.Thread(target=self._run, name="demandops-writer", daemon=True)
        self._thread.start()

    @property
    def snapshot(self) -> Snapshot:
        """The newest published state; safe to read from any thread."""
        return self._worker.snapshot

    @property
    def state_repo_status(self) -> StateRepoStatus:
        """How it is with the state repo; safe to read from any thread."""
        snapshot = self.snapshot
        return StateRepoStatus(
            self._worker.fetcher.remote.status,
            snapshot.problems,
            self._queue.unpublished,
            str(snapshot.commit),
        )

    def fetch_now(self) -> None:
        """Have the state repo looked at now, for somebody pushed to it; from any thread."""
        self._worker.fetcher.fetch_now()

    def submit(
        self,
        goal: object,
        operation: str | None = None,
        listener: Listener = lambda stage, text: None,
    ) -> Ticket:
        """Hand in a demand; returns at once.

        Args:
            goal: the goal as plain data (:mod:`demandops.demand.deployment_request_goal`).
            operation: a unique id for this hand-in; one is made where it is left out.
            listener: told each stage, from the worker thread.

        Returns:
            A ticket whose future gives the :class:`Receipt`, or raises ``Refused`` with every
            fault, ``Withdrawn``, ``InvalidInput`` or ``StateRepoError``.

        Raises:
            ShuttingDown, QueueFull: where the demand is not taken at all.
        """
        ticket = new_ticket(goal, operation, listener)
        if not ticket.future.done():
            ticket.base = str(self.snapshot.commit)
            self._queue.add(ticket)
        return ticket

    def includes(self, commit: str, other: str) -> bool:
        """Tell whether ``commit`` is ``other`` or comes after it; from any thread."""
        return self._repository.includes(commit, other)

    def unchanged(self, commit: str, other: str, path: str) -> bool:
        """Tell whether two commits hold the same under ``path``; from any thread."""
        return self._repository.unchanged(commit, other, path)

    def changes_since(self, since: str) -> tuple[str, list[str] | None]:
        """Return the newest published commit and which paths changed since another.

        The paths are None where that other is not known. From any thread.
        """
        commit = str(self.snapshot.commit)
        return commit, self._repository.changed(since, commit)

    def withdraw(self, operation: str) -> bool:
        """Take a demand back. False once it is committed, or was never known."""
        return self._queue.withdraw(operation)

    def on_publish(self, on_published: Callable[[Config], None]) -> None:
        """Have ``on_published`` called after every push, in the worker thread.

        It is given the configuration in force and must return at once.
        """
        self._listeners.append(on_published)

    def _call_listeners(self, config: Config) -> None:
        for watcher in self._listeners:
            watcher(config)

    def stop(self, timeout: float = _STOP_TIMEOUT_S) -> Future[bool]:
        """Refuse further demands, finish what is in hand and stop; returns at once.

        Args:
            timeout: seconds to wait for a remote that is away; then what is left stays in the
                outbox for the next start, and its futures raise ``ShuttingDown``.

        Returns:
            A future that tells, when all has ended, whether everything was published.
        """
        with self._stop_lock:
            if self._finished is not None:
                return self._finished
            self._finished = finished = Future[bool]()
        self._queue.close()
        threading.Thread(
            target=self._end, args=(timeout, finished), name="demandops-stop", daemon=True
        ).start()
        return finished

    def _end(self, timeout: float, finished: Future[bool]) -> None:
        self._thread.join(timeout)
        if self._thread.is_alive():
            self._worker.stop_retrying()
        self._thread.join()
        left = self._queue.unpublished
        self._slot.close()
        finished.set_result(not left)

    def close(self, timeout: float = _STOP_TIMEOUT_S) -> bool:
        """Stop and wait for the end; return whether everything was published."""
        return self.stop(timeout).result()

    def _run(self) -> None:
        """Settle what comes until all is settled and no more is taken; in the worker thread."""
        while self._queue.wait(self._worker.seconds_until_due()):
            batch: list[Ticket] = []
            try:
                self._worker.take(batch)
                if not batch:
                    self._worker.fetch_if_due()
                else:
                    self._worker.publish(batch)
                    self._worker.retry_changes()
                    self._worker.tidy()
                self._worker.check_proposals()
            except ShuttingDown as error:
                self._queue.fail(batch, error, keep=True)
            except DemandOpsError as error:
                self._queue.fail(batch, error)
            except Exception as error:
                log.exception("a fault of the generator")
                told = StateRepoError(f"a fault of the generator: {error!r}; its log says more")
                self._queue.fail(batch, told)
        self._approvals.suspend()
