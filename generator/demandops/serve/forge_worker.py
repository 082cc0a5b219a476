"""Keeps pull requests in step with proposals, in a thread of its own."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from demandops.base.runtime import Runtime, Thread
from demandops.base.settings import MAIN_BRANCH
from demandops.model.config.repo_settings import Proposals
from demandops.repo.forge import Forge, ForgeError, PullRequest, forge_for

# ---- the pull requests ----
#
# A slow or unreachable forge delays no demand and no proposal, because a branch can be merged
# without a pull request.

log = logging.getLogger("demandops")

# The seconds between two queries to the forge, to learn which pull requests were closed.
POLL_S = 30.0
_REST_S = 60.0  # how long to pause after a forge has answered that it got too many requests


@dataclass(frozen=True, slots=True)
class _Task:
    forge: Proposals
    branch: str  # of a proposal, or the commit whose pull request gets a comment
    title: str
    body: str
    closed_as: str = ""  # why to close the pull request; empty to open it
    is_comment: bool = False


class ForgeWorker:
    # only the worker thread calls its public methods
    def __init__(
        self, token_file: Path | None, on_update: Callable[[str], None], runtime: Runtime
    ) -> None:
        self._token_file, self._on_update, self._runtime = token_file, on_update, runtime
        self._tasks: deque[_Task] = deque()
        self._due = runtime.event()
        self._wanted: dict[str, _Task] = {}
        self._pull_requests: dict[str, PullRequest | None] = {}
        self._lock = runtime.lock()
        self._thread: Thread | None = None
        self._last_error = ""
        self._closed = False

    def close(self) -> None:
        self._closed = True  # the thread still does its tasks; the pull requests stay
        self._due.set()

    def open(self, forge: Proposals, branch: str, title: str, body: str) -> None:
        if branch not in self._wanted:
            task = _Task(forge, branch, title, body)
            with self._lock:
                self._wanted[branch] = task
            self._enqueue(task)

    def comment(self, forge: Proposals, commit: str, text: str) -> None:
        self._enqueue(_Task(forge, commit, "", text, is_comment=True))

    def was_queried(self, branch: str) -> bool:
        # also true if the forge cannot be queried now
        return branch in self._pull_requests

    def pull_request(self, branch: str) -> PullRequest | None:
        return self._pull_requests.get(branch)

    def forget(self, branch: str, closed_as: str) -> None:
        with self._lock:
            task = self._wanted.pop(branch, None)
            pull_request = self._pull_requests.pop(branch, None)
        # closed by a person
        is_closed = pull_request is not None and pull_request.state == "closed"
        if task is not None and closed_as and not is_closed:
            self._enqueue(replace(task, closed_as=closed_as))

    def _enqueue(self, task: _Task) -> None:
        self._tasks.append(task)
        self._due.set()
        if self._thread is None:  # most state repos have no forge, and need no thread for it
            self._thread = self._runtime.keep_running("forge", self._run)

    # ---- in the forge's thread ----

    def _run(self) -> None:
        poll_at = self._runtime.monotonic() + POLL_S
        while not self._closed:
            self._due.wait(max(0.0, poll_at - self._runtime.monotonic()))
            self._due.clear()
            if self._runtime.monotonic() >= poll_at:
                poll_at = self._runtime.monotonic() + POLL_S
                with self._lock:
                    self._tasks.extend(self._wanted.values())
            while self._tasks:
                task = self._tasks.popleft()
                pull_request = self._pull_requests.get(task.branch)
                try:
                    if (forge := forge_for(task.forge, self._token_file)) is None:
                        continue
                    if task.is_comment:
                        forge.comment(task.branch, task.body)
                        continue
                    pull_request = self._handle(task, forge, pull_request)
                except ForgeError as error:
                    if str(error) != self._last_error:
                        log.warning("%s: %s", task.branch, error)
                    self._last_error = str(error)
                    if error.asks_to_wait or error.status is None:
                        # notify the requesters now, not only once the forge answers again
                        for waiting in (task, *self._tasks):
                            self._remember(waiting, self._pull_requests.get(waiting.branch))
                    if error.asks_to_wait:
                        self._tasks.appendleft(task)
                        self._runtime.sleep(_REST_S)
                        continue
                except Exception as error:  # one pull request must not stop the others
                    self._runtime.failed(f"forge of {task.branch}", error)
                self._remember(task, pull_request)

    @staticmethod
    def _handle(task: _Task, forge: Forge, known: PullRequest | None) -> PullRequest | None:
        if not task.closed_as and known is None:
            return forge.open(task.branch, MAIN_BRANCH, task.title, task.body)
        current = forge.find(task.branch, MAIN_BRANCH) or known
        if task.closed_as and current is not None and current.state != "merged":
            # the forge may have closed it already, because its branch is gone
            forge.close(current, f"Closed: {task.closed_as}\n\n{task.body}")
        return current

    def _remember(self, task: _Task, pull_request: PullRequest | None) -> None:
        with self._lock:
            if (
                task.is_comment or task.closed_as or task.branch not in self._wanted
            ):  # forgotten during the query
                return
            before = self._pull_requests.get(task.branch, "not queried")
            self._pull_requests[task.branch] = pull_request
        if before != pull_request:
            self._on_update(task.branch)
