"""The desk: asks a forge for merge requests in a thread of its own, and remembers the answers.

A forge that is slow or away holds up neither demands nor proposals: a branch without a request can
be merged all the same.
"""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from demandops.config.repo_settings import Proposals
from demandops.forge import ForgeError, PullRequest, forge_for
from demandops.settings import MAIN_BRANCH

log = logging.getLogger("demandops")

POLL_S = 30.0
"""Between two looks at what became of the requests: a closed one leaves its branch as it is."""


@dataclass(frozen=True, slots=True)
class _Task:
    forge: Proposals
    branch: str
    title: str
    body: str


class ForgeWorker:
    """Opens, watches and closes requests. All but :meth:`_run` is for one other thread."""

    def __init__(self, token_file: Path | None, on_news: Callable[[str], None]) -> None:
        self._token_file = token_file
        self._on_update = on_news
        self._tasks: queue.Queue[tuple[_Task, bool]] = queue.Queue()
        self._wanted: dict[str, _Task] = {}
        self._pull_requests: dict[str, PullRequest | None] = {}
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._last_error = ""

    def open(self, forge: Proposals, branch: str, title: str, body: str) -> None:
        """Have a request opened for a branch, unless that was said before."""
        if branch in self._wanted:
            return
        task = _Task(forge, branch, title, body)
        with self._lock:
            self._wanted[branch] = task
        self._enqueue(task, close=False)

    def has_answered(self, branch: str) -> bool:
        """Tell whether the forge was asked about a branch, with or without success."""
        return branch in self._pull_requests

    def pull_request(self, branch: str) -> PullRequest | None:
        """Return what is known of the request for a branch."""
        return self._pull_requests.get(branch)

    def forget(self, branch: str, *, close: bool) -> None:
        """Watch a request no more; ``close`` it where it is open."""
        with self._lock:
            task = self._wanted.pop(branch, None)
            self._pull_requests.pop(branch, None)
        if task is not None and close:
            self._enqueue(task, close=True)

    def _enqueue(self, task: _Task, *, close: bool) -> None:
        self._tasks.put((task, close))
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="demandops-desk", daemon=True)
            self._thread.start()

    # ---- in the desk's own thread ----

    def _run(self) -> None:
        while True:
            try:
                task, close = self._tasks.get(timeout=POLL_S)
            except queue.Empty:
                with self._lock:
                    tasks = list(self._wanted.values())
                for task in tasks:
                    self._handle(task, close=False)
                continue
            try:
                self._handle(task, close=close)
            finally:
                self._tasks.task_done()

    def _handle(self, task: _Task, *, close: bool) -> None:
        known = self._pull_requests.get(task.branch)
        found = known
        try:
            forge = forge_for(task.forge, self._token_file)
            if forge is None:
                return
            if close:
                found = forge.find(task.branch, MAIN_BRANCH)
                if found is not None and found.state == "open":
                    forge.close(found)
                return
            if known is None:
                found = forge.open(task.branch, MAIN_BRANCH, task.title, task.body)
            else:
                found = forge.find(task.branch, MAIN_BRANCH) or known
        except ForgeError as error:
            if str(error) != self._last_error:
                log.warning("%s: %s", task.branch, error)
            self._last_error = str(error)
        except Exception:
            log.exception("a fault of the generator, at the request for %s", task.branch)
        self._remember(task, found)

    def _remember(self, task: _Task, found: PullRequest | None) -> None:
        with self._lock:
            if task.branch not in self._wanted:
                return
            news = (
                task.branch not in self._pull_requests or self._pull_requests[task.branch] != found
            )
            self._pull_requests[task.branch] = found
        if news:
            self._on_update(task.branch)
