"""When and how long: pauses, intervals, the sign of life, budgets and rates."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from datetime import datetime, timedelta
from pathlib import Path

from demandops.base.errors import Fault, OverBudget, fault
from demandops.base.runtime import Runtime
from demandops.decide.decision import Checkpoint
from demandops.model.config.base_model import seconds_of
from demandops.model.config.config import Config
from demandops.model.config.repo_settings import ROOT_FILE, Limits
from demandops.model.demand.demand import Demand
from demandops.model.demand.goals import length_faults

# ---- the next attempt to publish: when, and with how many demands ----
#
# There are two kinds of delays: after another writer published first, and while the remote cannot
# be reached. Both kinds are jittered and bounded, so no writer starves, and the writers do not
# flood a remote that comes back.

FIRST_PAUSE_S = 0.05
LONGEST_AWAY_S = 10.0  # while the remote cannot be reached
# After another writer published first; a writer that waits longer loses again to the others.
LONGEST_TURN_S = 0.4
# The most demands to publish together. A push takes about 50 ms, but moving a branch of a
# repository on this disk takes less than 1 ms.
LIMIT_LOCAL = 20
LIMIT_REMOTE = 200

# After this time, what was evaluated of a batch is published, and the other demands go back to the
# queue. There, requesters take turns, so a demand that arrived meanwhile may come first. So it
# waits for this time and for one decision, which has a limit too (limits.decisionMilliseconds).
LONGEST_EVALUATION_S = 0.25


class Backoff:
    def __init__(self, limit: int, runtime: Runtime) -> None:
        self._limit, self._runtime = limit, runtime
        self.published()

    def published(self) -> None:
        self.max_demands = self._limit
        self._turn = self._away = FIRST_PAUSE_S

    def overtaken(self, size: int, evaluating_s: float, pushing_s: float) -> float:
        # The seconds to wait, as another writer published first. ``size`` counts the demands of the
        # attempt, which took ``evaluating_s`` to commit them, and ``pushing_s`` from then on.

        # a writer that evaluates for longer than its push takes always loses to faster writers
        self.max_demands = max(1, int(size * min(1.0, pushing_s / max(evaluating_s, 1e-9))))
        wait, self._turn = self._turn, min(self._turn * 2, LONGEST_TURN_S)
        self._away = FIRST_PAUSE_S
        return self._jittered(wait)

    def unreachable(self) -> float:
        wait, self._away = self._away, min(self._away * 2, LONGEST_AWAY_S)
        return self._jittered(wait)

    def _jittered(self, seconds: float) -> float:
        return seconds * self._runtime.uniform(0.5, 1.0)


# ---- a pause after an error: the worker does not fetch, but still publishes demands ----

FIRST_S, LONGEST_S = 1.0, 60.0


class Rest:
    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._next, self._until = FIRST_S, runtime.monotonic()

    def __bool__(self) -> bool:
        return self._runtime.monotonic() < self._until

    @property
    def follows_success(self) -> bool:
        return self._next == FIRST_S

    def seconds_left(self) -> float:
        return self._until - self._runtime.monotonic()

    def begin(self) -> None:
        self._until = self._runtime.monotonic() + self._next
        self._next = min(2 * self._next, LONGEST_S)

    def succeeded(self) -> None:
        self._next = FIRST_S


# ---- when to fetch from the state repo while no demand comes ----

DEFAULT_INTERVAL = "30s"
_SHORTEST_GAP_S = 0.5  # a Git server may report many pushes at once; they share a fetch
# The longest interval for a repository on this disk, where a check is cheap: it reads one file.
_LOCAL_S = 1.0


def parse_interval(text: str) -> float:
    """Return the seconds of a duration like ``30s`` or of a number, or raise ValueError."""
    if re.fullmatch(r"[0-9]{1,8}(\.[0-9]{1,6})?", text):
        return float(text)
    return float(seconds_of(text))


class PollTimer:
    # any thread may call `request`, but only one thread may call the other methods
    def __init__(self, interval: float, runtime: Runtime, *, local: bool = False) -> None:
        # the interval grows while fetches fail; if it is 0, only `request` makes a fetch due
        self._interval = min(interval, _LOCAL_S) if local else interval
        self._runtime = runtime
        self._pause = self._interval
        self._last = runtime.monotonic() - _SHORTEST_GAP_S
        self._next = runtime.monotonic() if interval else None
        self._requested = runtime.event()

    def request(self) -> None:
        self._requested.set()

    def seconds_until_due(self) -> float | None:
        times = [] if self._next is None else [self._next]
        if self._requested.is_set():
            times.append(self._last + _SHORTEST_GAP_S)
        return max(min(times) - self._runtime.monotonic(), 0.0) if times else None

    def start_if_due(self) -> bool:
        due = self.seconds_until_due() == 0.0
        if due:  # clear before the fetch: a later push needs another one
            self._requested.clear()
        return due

    def finished(self, *, reached: bool) -> None:
        """Plan the next fetch after a fetch or a push, which both tell of others' commits."""
        longest = max(60.0, self._interval)
        self._last = self._runtime.monotonic()
        if self._next is not None:
            self._pause = self._interval if reached else min(self._pause * 2, longest)
            # a little less at random, so that generators do not fetch all at once
            self._next = self._last + self._pause * self._runtime.uniform(0.8, 1.0)


# ---- the sign of life, for a supervisor such as a pod's liveness probe ----


class Heartbeat:
    # The worker calls it in each turn and at each wait for git. So the file grows old only if the
    # worker is stuck, and not because a remote is away.
    def __init__(self, file: Path | None) -> None:
        self._file = file
        # an earlier process may have left one; until the first turn there is none, because a start
        # may have to clone for long
        if file is not None:
            with suppress(OSError):
                file.unlink()

    def __call__(self) -> None:
        if self._file is not None:
            with suppress(OSError):
                self._file.touch()


# ---- the budget of one decision, because other demands wait meanwhile ----

# The usual demand lists a dozen topics; one of this size is decided in some 10 ms.
_USUAL = Limits.model_validate({"demandItems": 200, "demandCharacters": 20_000})


def may_take_long(demand: Demand) -> bool:
    # what was decided before such a demand is published first
    return any(True for _ in length_faults(demand.goal, _USUAL))


def within(limits: Limits, runtime: Runtime) -> Checkpoint:
    # Only a refusal may depend on it, because another machine takes another time. Processor time,
    # because other programs on this machine must not get a demand refused.
    most = limits.decision_milliseconds
    end = runtime.processor_s() + most / 1000

    def checkpoint() -> None:
        if runtime.processor_s() > end:
            raise OverBudget(
                f"takes more than {most} ms of processor time to decide, while other demands wait; "
                "split the demand, or name nodes instead of 'place'; a platform engineer may raise "
                f"limits.decisionMilliseconds in {ROOT_FILE}"
            )

    return checkpoint


# ---- the rate of a requester, by the quotas of the access domains ----
#
# A generator counts only the demands that it receives itself. It counts a demand once, even if it
# evaluates the demand several times.

_WINDOW = timedelta(minutes=1)


class RateLimit:
    def __init__(self) -> None:
        self._seen: dict[tuple[str, str], deque[tuple[datetime, str]]] = {}

    def faults(
        self, request: Demand, config: Config, operation: str, received: datetime
    ) -> Iterator[Fault]:
        # A demand counts even if it is refused afterwards. A request that adds no claims is not
        # limited.
        if not request.adds_claims:
            return
        homes = (config.domain_of.get(demanded.held.home) for demanded in request.demanded)
        domains = {domain.name: domain for domain in homes if domain is not None}
        for domain in domains.values():
            most = domain.quotas.demands_per_minute
            for requester in request.requesters() if most else ():
                if self._count((domain.name, requester), operation, received) > (most or 0):
                    message = (
                        f"'{requester}' sent more than {most} demands in a minute, the limit in "
                        f"quotas.demandsPerMinute of access domain '{domain.name}'; send the "
                        "demand again later"
                    )
                    yield fault("", message, code="quota")

    def _count(self, key: tuple[str, str], operation: str, received: datetime) -> int:
        # forget requesters that sent nothing for a minute, because vehicles come and go
        while self._seen:
            idlest = next(iter(self._seen))
            if (times := self._seen[idlest]) and abs(received - times[-1][0]) <= _WINDOW:
                break
            del self._seen[idlest]
        seen = self._seen.pop(key, None) or deque()
        self._seen[key] = seen  # at the end, so that the requester that is idle longest is first
        while seen and abs(received - seen[0][0]) > _WINDOW:  # the clock may have been set back
            seen.popleft()
        # a demand that is evaluated again keeps its number
        operations = [earlier for _, earlier in seen]
        if operation in operations:
            return operations.index(operation) + 1
        seen.append((received, operation))
        return len(seen)
