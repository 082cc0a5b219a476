"""What the worker does when nobody demands anything, and when; and its pauses and limits."""

from __future__ import annotations

import logging
import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from contextlib import suppress
from datetime import datetime, timedelta
from math import inf
from pathlib import Path
from typing import Literal, get_args

from demandops.base.errors import Fault, InvalidInput, OverBudget, OverLimit, fault
from demandops.base.quoting import quoted
from demandops.base.runtime import Runtime
from demandops.decide.booking import Drain
from demandops.decide.decision import Checkpoint, decide
from demandops.decide.state import State
from demandops.model.config.base_model import seconds_of
from demandops.model.config.config import Config
from demandops.model.config.repo_settings import ROOT_FILE, Limits
from demandops.model.demand.demand import Demand
from demandops.model.demand.goals import length_faults
from demandops.model.ledger.claim import Claim
from demandops.model.ledger.ledger import Ledger, World
from demandops.model.ledger.records import in_turn
from demandops.repo.write.commit_batch import CommitBatch
from demandops.serve.demands import Receipt, Ticket

log = logging.getLogger("demandops")

# The longest time between two looks at the list; short, because a person may set the clock.
LONGEST_WAIT_S = 60.0
# The pause after a failed try to end a lease or an override.
RETRY = timedelta(seconds=LONGEST_WAIT_S)

DEFAULT_INTERVAL = "30s"  # between two fetches
_SHORTEST_GAP_S = 0.5  # a Git server may report many pushes at once; they share a fetch
# The longest interval for a repository on this disk, where a check is cheap: it reads one file.
_LOCAL_S = 1.0

# The seconds between two checks of the branches, as only a check detects a deleted branch.
CHECK_LOCAL_S = 1.0
CHECK_REMOTE_S = 5.0
# How many times as long as the last check to pause before the check of a new main, so that checks
# take at most a tenth of the worker's time while main moves.
_PAUSE_FACTOR = 9

FIRST_REST_S, LONGEST_REST_S = 1.0, 60.0

What = Literal["leases", "own work", "fetch", "check"]


def parse_interval(text: str) -> float:
    """Return the seconds of a duration like ``30s`` or of a number, or raise ValueError."""
    if re.fullmatch(r"[0-9]{1,8}(\.[0-9]{1,6})?", text):
        return float(text)
    return float(seconds_of(text))


class Agenda:
    """The list of what is to be done without a new demand, and when.

    | what | when |
    | --- | --- |
    | leases | when the first one ends: a demand is released |
    | own work | ends of overrides, drains, demands that wait for room: each batch begins with it |
    | fetch | at an interval, and soon after a request |
    | check | of the proposals: soon after main has moved, else at an interval |

    After an error, the worker rests: it publishes demands, but does nothing of the list. Any thread
    may call :meth:`request_fetch`.
    """

    def __init__(self, fetch_interval: float, runtime: Runtime, *, local: bool = False) -> None:
        self._runtime, now = runtime, runtime.monotonic()
        self.leases = LeaseExpiry(runtime)
        self._draining = Draining(runtime)
        self.waiting_turns = WaitingTurns(runtime)
        # By name and end: an override whose end a person changes is tried again at once.
        self._retry_at: dict[tuple[str, datetime], datetime] = {}
        # Until then no own work counts as due, but each batch of demands still begins with it.
        self._postponed_until = now
        # the interval grows while fetches fail; if it is 0, only a request makes a fetch due
        self._interval = min(fetch_interval, _LOCAL_S) if local else fetch_interval
        self._pause = self._interval
        self._fetch_at = now if fetch_interval else inf
        self._fetched_at = now - _SHORTEST_GAP_S
        self._requested = runtime.event()
        self._check_interval = CHECK_LOCAL_S if local else CHECK_REMOTE_S
        self._checked: str | None = ""  # main at the last check; None if it failed
        self._check_began = self._check_at = self._check_new_main_at = 0.0
        self.rest_s, self._rest_until = FIRST_REST_S, now

    def seconds_until_due(self, state: State, main: str) -> dict[What, float]:
        # ``main`` is empty if no proposal awaits approval
        now, clock = self._runtime.monotonic(), self._runtime.now()
        if now < self._rest_until:
            return dict.fromkeys(get_args(What), self._rest_until - now)
        due = now + LONGEST_WAIT_S
        ends = [max(end, self._retry_at.get((name, end), end)) for end, name in _ends(state)]
        if ends:
            due = now + (min(ends) - clock).total_seconds() + 0.01
        # what was left off goes on at once, but after the demands that arrived meanwhile
        drained = state.config.drained_nodes
        if self.waiting_turns.is_due(state) or (drained and self._draining.is_due(state)):
            due = now
        fetch = self._fetch_at
        if self._requested.is_set():
            fetch = min(fetch, self._fetched_at + _SHORTEST_GAP_S)
        check = self._check_at if main else inf
        if main and self._checked not in (main, None):
            check = min(check, self._check_new_main_at)
        return {
            "leases": self.leases.seconds_until_due(state.ledger, LONGEST_WAIT_S),
            "own work": max(due, self._postponed_until, now) - now,
            "fetch": max(fetch, now) - now,
            "check": max(check, now) - now,
        }

    # ---- own work ----

    def commit_due(self, commits: CommitBatch) -> None:
        # what runs moves before what waits is booked
        state, now = commits.head.state, self._runtime.now()
        for end, name in sorted(_ends(state)):
            if max(end, self._retry_at.get((name, end), end)) > now:
                continue
            override = state.config.overrides[name]
            try:
                commits.end_override(override, now)
                log.info("%s ended as planned at %s", override.path, override.expires)
            except InvalidInput as error:
                self._retry_at[name, end] = now + RETRY
                for problem in error.faults:
                    log.error("%s cannot be ended: %s; trying again later", override.path, problem)
        if commits.head.state.config.drained_nodes:
            self._draining.move_due(commits)
        if self.waiting_turns.is_due(commits.head.state):
            self.waiting_turns.book_due(commits)

    def postpone(self) -> None:
        # because a fetch or a publication failed
        self._postponed_until = self._runtime.monotonic() + LONGEST_WAIT_S

    # ---- fetches ----

    def request_fetch(self) -> None:
        self._requested.set()

    def fetch_begins(self) -> None:
        self._requested.clear()  # before the fetch: a later push needs another one

    def fetched(self, *, reached: bool, at_least_s: float = 0.0) -> None:
        """Plan the next fetch after a fetch or a push, which both tell of others' commits."""
        self._fetched_at = self._runtime.monotonic()
        if self._interval:
            longest = max(60.0, self._interval)
            self._pause = self._interval if reached else min(self._pause * 2, longest)
            # a little less at random, so that generators do not fetch all at once
            pause = max(self._pause * self._runtime.uniform(0.8, 1.0), at_least_s)
            self._fetch_at = self._fetched_at + pause

    # ---- checks of the proposals ----

    def check_is_due(self, main: str, *, has_news: bool) -> bool:
        # after a failed check, news wait for the interval: the remote is likely away
        now = self._runtime.monotonic()
        if self._checked is None:
            return now >= self._check_at
        is_new = self._checked != main and now >= self._check_new_main_at
        return has_news or is_new or now >= self._check_at

    def check_begins(self) -> None:
        self._check_began = self._runtime.monotonic()
        # this plans the next check, in case this one fails
        self._check_at, self._checked = self._check_began + self._check_interval, None

    def checked(self, main: str) -> None:
        now = self._runtime.monotonic()
        self._checked = main
        self._check_new_main_at = now + _PAUSE_FACTOR * (now - self._check_began)

    # ---- the rest after an error ----

    @property
    def rest_left_s(self) -> float:
        return max(0.0, self._rest_until - self._runtime.monotonic())

    def rest(self) -> None:
        self._rest_until = self._runtime.monotonic() + self.rest_s
        self.rest_s = min(2 * self.rest_s, LONGEST_REST_S)


def _ends(world: World) -> list[tuple[datetime, str]]:
    # of the overrides in effect
    return [(override.end, override.name) for override in world.overrides if override.end]


# ---- the ends of leases ----
#
# A person may set the clock. A clock that is set back only delays the end of a lease. A clock that
# jumps forward would end leases that were renewed in time, so after a jump every lease gets its
# full term again. The sleep of a machine looks like a jump and has the same effect. While no
# generator ran, nobody could renew a lease, so after a start no lease ends before its term, or ten
# minutes of a longer one, have passed. Overrides get no more time after a jump or a start.

# By how much the clock may gain on the monotonic clock before leases get their full term again.
_JUMP = timedelta(seconds=30)
# The longest grace after a start. A client that is alive and failed to renew tries again within it;
# with more, a generator that is restarted each day would keep the day-long leases of vehicles that
# are gone for ever.
_LONGEST_GRACE_S = 600.0
# The ledger keeps a lease that has ended if its release failed, or if it got more time after a jump
# of the clock or a start. Without this minimum, the worker would then never wait.
_SHORTEST_S = 1.0


class LeaseExpiry:
    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._started = runtime.monotonic()
        self._last = (runtime.now(), self._started)
        self._jumped_at: datetime | None = None
        self._tried: dict[str, datetime] = {}
        self._first: object = None
        self._next_end: datetime | None = None

    def tickets(self, ledger: Ledger) -> list[Ticket]:
        # The tickets are correct only now: later, a requester may renew a lease, or a person may
        # set the clock. If one does not release its claims, the next comes at least a minute later.
        now, claims = self.ended_claims(ledger)
        ended = dict.fromkeys(claim.demand for claim in claims)
        # forget demands that were released or renewed meanwhile
        self._tried = {d: at for d, at in self._tried.items() if at > now - RETRY and d in ended}
        return [self._ticket(demand, now) for demand in ended if demand not in self._tried]

    def _ticket(self, demand: str, now: datetime) -> Ticket:
        ticket = Ticket(
            self._runtime.fresh_id(), Demand("expire", demand, demand=demand, is_complete=True), now
        )

        def tell(future: Future[Receipt]) -> None:
            self._tried[demand] = now
            error = future.exception()
            if isinstance(error, InvalidInput):  # no client gets this error, so report it here
                self._runtime.failed(f"end of the lease of {quoted(demand)}", error)
            elif error is None:
                outcome = future.result().outcome
                log.info("the lease of %s has ended: %s", quoted(demand), outcome)

        ticket.future.add_done_callback(tell)
        return ticket

    def ended_claims(self, ledger: Ledger) -> tuple[datetime, list[Claim]]:
        """Return the current time, and the claims whose lease has ended, earliest end first."""
        now = self._read_clocks()
        ended = ledger.ended_claims(now)
        # a demand's claims are released together, so if one gets more time, none is released
        granted = {claim.demand for claim in ended if not self._has_ended(claim, now)}
        return now, [claim for claim in ended if claim.demand not in granted]

    def seconds_until_due(self, ledger: Ledger, longest: float) -> float:
        first = ledger.first_to_end()
        if first is not self._first:  # a search is slow if many leases end at one time
            self._first, self._next_end = first, ledger.next_lease_end()
        end = self._next_end
        if end is None:
            return longest
        seconds = (end - self._read_clocks()).total_seconds() + 0.01
        return min(max(seconds, _SHORTEST_S), longest)

    def _read_clocks(self) -> datetime:
        wall, steady = self._runtime.now(), self._runtime.monotonic()
        expected = self._last[0] + timedelta(seconds=steady - self._last[1])
        if wall - expected > _JUMP:
            jump = (wall - expected).total_seconds()
            log.warning("the clock jumped forward by %.0f s, so leases get their full term", jump)
            self._jumped_at = wall
        self._last = (wall, steady)
        return wall

    def _has_ended(self, claim: Claim, now: datetime) -> bool:
        lease = claim.lease
        if lease is None:
            return False
        if self._runtime.monotonic() - self._started < min(lease.seconds, _LONGEST_GRACE_S):
            return False
        term = timedelta(seconds=lease.seconds + lease.slack)
        return self._jumped_at is None or now > self._jumped_at + term


# ---- drained nodes: placed applications and services move off them ----
#
# While any of them cannot move, another attempt is made each minute, and at each change of the
# configuration.


class Draining:
    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._tried: dict[str, tuple[Config, datetime]] = {}
        self._logged: dict[str, frozenset[str]] = {}
        # by node: the last application that was moved, if others are left for later
        self.after: dict[str, str] = {}

    def move_due(self, commits: CommitBatch) -> None:
        now = self._runtime.now()
        for node in self._due(commits.head.state, now):
            tried = (commits.head.state.config, now)
            after = self.after.pop(node, "")
            try:
                decision = commits.drain(node, after, self._runtime.fresh_id(), now)
            except InvalidInput as error:
                self._tried[node] = tried
                self._warn(node, map(str, error.faults))
                continue
            # a commit may fail to be published, so only a try without commit is recorded
            assert isinstance(decision.request, Drain)  # noqa: S101 - it was decided
            if decision.request.last:
                self.after[node] = decision.request.last
            elif not decision.files:
                self._tried[node] = tried
            for moved in decision.placed:
                log.info("'%s' is drained: %s", node, moved)
            self._warn(node, decision.warnings, continued=bool(after))

    def _warn(self, node: str, stays: Iterable[str], *, continued: bool = False) -> None:
        # the texts of the last try are not logged again, as a try comes each minute
        texts, logged = frozenset(stays), self._logged.get(node, frozenset())
        for text in sorted(texts - logged):
            log.warning("'%s' is drained: %s", node, text)
        self._logged[node] = texts | logged if continued else texts

    def is_due(self, world: World) -> bool:
        return bool(self._due(world, self._runtime.now()))

    def _due(self, world: World, now: datetime) -> list[str]:
        nodes = []
        for node in world.config.drained_nodes:
            # not for a minute after a try, unless a person changed the configuration or the clock
            config, at = self._tried.get(node, (None, now))
            is_new = config is not world.config or not at <= now < at + RETRY
            if is_new and world.ledger.applications_on.get(node):
                nodes.append(node)
        return nodes


# ---- the demands that wait for room: when they are tried again, and in which order ----
#
# If there may be room, the generator tries the waiting demands before it decides new demands. So no
# demand gets the room for which an earlier demand, or a demand of higher priority, was waiting.

# After this processor time, new demands come before the waiting demands that were not tried yet.
_LONGEST_ROUND_S = 0.25


class WaitingTurns:
    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._tried: World | None = None
        self.left: list[str] = []  # demands that the last round left for later

    def book_due(self, commits: CommitBatch) -> None:
        state = commits.head.state
        if not self._is_tried(state) or not self.left:
            self.left = [waiting.demand for waiting in in_turn(state.ledger.waiting)]
        end = self._runtime.processor_s() + _LONGEST_ROUND_S
        while self.left:
            demand = self.left.pop(0)
            state, now = commits.head.state, self._runtime.now()
            if (waiting := state.ledger.waiting.get(demand)) is None:  # it was released meanwhile
                continue
            checkpoint = within(state.config.repo_settings.limits, self._runtime)
            try:
                decision = decide(state, waiting.put, now, commits.read, checkpoint=checkpoint)
            except InvalidInput as error:
                log.debug("demand %s still waits: %s", quoted(demand), error)
                if isinstance(error, OverLimit):  # a template took too long, and the next may too
                    break
            else:
                if decision.outcome == "booked" and not decision.approval:
                    commits.commit(decision, self._runtime.fresh_id(), waiting.since, now)
                    log.info("demand %s no longer waits", quoted(demand))
            if self._runtime.processor_s() > end:  # after a try, so that each round gets on
                break
        self._tried = commits.head.state

    def follow(self, commits: CommitBatch, before: State) -> None:
        """Book waiting demands if the last demand, decided on ``before``, may have let them in."""
        if commits.awaited:
            commits.awaited = False
            self._tried = None
            if self.is_due(commits.head.state):
                self.book_due(commits)
        elif self._tried is before:  # the last demand let none in, so the tries are still valid
            self._tried = commits.head.state

    def is_due(self, state: State) -> bool:
        return bool(state.ledger.waiting) and (bool(self.left) or not self._is_tried(state))

    def _is_tried(self, state: World) -> bool:
        # by identity: ledger and configuration are frozen, and to compare their content takes long
        tried = self._tried
        return tried is not None and tried.ledger is state.ledger and tried.config is state.config


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
        self.begin_anew()

    def begin_anew(self) -> None:
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


# ---- the heartbeat, which a supervisor such as a pod's liveness probe reads ----


def heartbeat_in(file: Path | None) -> Callable[[], object]:
    # The worker calls it in each turn and at each wait for git. So the file grows old only if the
    # worker is stuck, and not because a remote is away.
    if file is None:
        return lambda: None
    # an earlier process may have left one; until the first turn there is none, because a start may
    # have to clone for long
    with suppress(OSError):
        file.unlink()

    def touch() -> None:
        with suppress(OSError):
            file.touch()

    return touch
