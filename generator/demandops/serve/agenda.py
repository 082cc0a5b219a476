"""What the worker does when nobody demands anything, and when; and its pauses and limits."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from contextlib import suppress
from datetime import datetime, timedelta
from functools import partial
from math import inf
from pathlib import Path
from typing import Literal

from demandops.base.errors import Fault, InvalidInput, OverBudget, OverLimit, fault
from demandops.base.quoting import quoted
from demandops.base.runtime import Runtime, log
from demandops.decide.booking import Drain
from demandops.decide.decision import Checkpoint, decide
from demandops.decide.state import State
from demandops.model.config.base_model import seconds_of
from demandops.model.config.config import Config
from demandops.model.config.repo_settings import ROOT_FILE, Limits
from demandops.model.demand.demand import Demand
from demandops.model.ledger.claim import Claim
from demandops.model.ledger.ledger import Ledger, World
from demandops.model.ledger.records import in_turn
from demandops.repo.write.commit_batch import CommitBatch
from demandops.serve.journal import Receipt, Ticket
from demandops.serve.node_discovery import NodeDiscovery

# The longest time between two looks at the list; short, because a person may set the clock.
LONGEST_WAIT_S = 60.0
# The first pause of the worker after an error.
FIRST_PAUSE_S = 1.0

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

# How many times the duration of a judgement passes before the next one: each renders all releases.
_JUDGING_PAUSE_FACTOR = 20

# By how much the clock may gain on the monotonic clock before this counts as a jump.
_JUMP_S = 30.0
# The shortest grace of a lease. The ledger keeps a lease that has ended while its grace lasts, and
# the worker then looks again after this pause.
_SHORTEST_GRACE_S = 60.0
_SHORTEST_LOOK_S = 1.0

# After this processor time, new demands come before the waiting demands that were not tried yet.
_LONGEST_ROUND_S = 0.25

What = Literal["leases", "own work", "fetch", "check", "judge"]


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
    | own work | ends of overrides, drains, changed nodes of clusters, demands that wait for room: \
    each batch begins with it |
    | fetch | at an interval, and soon after a request |
    | check | of the proposals: soon after main has moved, else at an interval |
    | judge | the configuration of main again, if it is not in effect and claims have ended |

    What failed waits, each time twice as long, up to a minute: one of these, the end of an override
    or of a lease, or the drain of a node. These last three are tried again at once if a person
    changes the configuration. After an error of the worker ("all"), it publishes demands, but does
    nothing of the list for that time. Any thread may set ``wants_fetch``.
    """

    def __init__(self, fetch_interval: float, runtime: Runtime, *, local: bool = False) -> None:
        self._runtime, now = runtime, runtime.monotonic()
        # what failed: its pause, and when the pause is over
        self._failed: dict[tuple[str, str], tuple[float, float]] = {}
        self._config: Config | None = None
        # if the interval is 0, only a request makes a fetch due
        self._interval = min(fetch_interval, _LOCAL_S) if local else fetch_interval
        self._fetch_at = now if fetch_interval else inf
        self._fetched_at = now - _SHORTEST_GAP_S
        self.wants_fetch = runtime.event()
        self._check_interval = CHECK_LOCAL_S if local else CHECK_REMOTE_S
        self._checked = ""  # main at the last check
        self._check_began = self._check_at = self._check_new_main_at = 0.0
        self._steady_since, self._has_jumped = now, False
        self._last_look = (runtime.now(), now)
        self._first_to_end: object = None
        self._next_end: datetime | None = None
        # by drained node: the last application that was moved, if others are left for later
        self._moved_last: dict[str, str] = {}
        self._logged: dict[str, frozenset[str]] = {}
        self._tried: World | None = None
        self.left: list[str] = []  # waiting demands that the last round left for later
        self.must_judge, self._judge_at = False, now
        self.nodes: list[NodeDiscovery] = []  # one, if clusters are asked for their nodes

    def due_in(self, state: State, main: str, *, has_news: bool = False) -> dict[What, float]:
        # in seconds; ``main`` is empty if no proposal awaits approval, and ``has_news`` says
        # whether one was changed
        now, rest = self._runtime.monotonic(), self.waits_s("all")
        fetch = max(self._fetch_at - now, self.waits_s("fetch"))
        if self.wants_fetch.is_set():
            fetch = min(fetch, self._fetched_at + _SHORTEST_GAP_S - now)
        check = (now if has_news else self._check_at) if main else inf
        if main and self._checked != main:
            check = min(check, self._check_new_main_at)
        # what was left off goes on at once, but after the demands that arrived meanwhile
        own_work = 0.0 if self.may_have_room(state) else LONGEST_WAIT_S
        for end, name in _ends(state):
            seconds = (end - self._runtime.now()).total_seconds() + 0.01
            own_work = min(own_work, max(seconds, self.waits_s("end", name)))
        drains = (self.waits_s("drain", node) for node in state.nodes_to_drain())
        own_work = min([own_work, *drains, *(nodes.due_in(state) for nodes in self.nodes)])
        first = state.ledger.first_to_end()
        if first is not self._first_to_end:  # a search is slow if many leases end at one time
            self._first_to_end, self._next_end = first, state.ledger.next_lease_end()
        leases = LONGEST_WAIT_S
        if self._next_end is not None:
            # one that has ended may have a grace, or its release failed
            seconds = (self._next_end - self._read_clocks()).total_seconds() + 0.01
            leases = min(max(seconds, _SHORTEST_LOOK_S), LONGEST_WAIT_S)
        due: dict[What, float] = {
            "leases": leases,
            "own work": max(own_work, self.waits_s("own work")),
            "fetch": fetch,
            # after a failure, the remote is likely away
            "check": max(check - now, self.waits_s("check")),
            "judge": self._judge_at - now if self.must_judge else inf,
        }
        return {what: max(seconds, rest, 0.0) for what, seconds in due.items()}

    # ---- what failed ----

    def failed(self, what: str, name: str = "", first: float = LONGEST_WAIT_S) -> float:
        # returns the pause, which is ``first`` if it has not failed for a minute
        now, longest = self._runtime.monotonic(), max(first, LONGEST_WAIT_S)
        pause, until = self._failed.get((what, name), (0.0, -inf))
        pause = min(2 * pause, longest) if now < until + LONGEST_WAIT_S else first
        # a little less at random, so that generators do not try again all at once
        self._failed[what, name] = pause, now + pause * self._runtime.uniform(0.8, 1.0)
        return pause

    def waits_s(self, what: str, name: str = "") -> float:
        _, until = self._failed.get((what, name), (0.0, -inf))
        return max(0.0, until - self._runtime.monotonic())

    # ---- own work ----

    def commit_due(self, commits: CommitBatch) -> None:
        state, now = commits.head.state, self._runtime.now()
        # forget failures that are long past, as vehicles come and go; and what a new configuration
        # may mend
        steady, is_new = self._runtime.monotonic(), state.config is not self._config
        self._config = state.config
        for (what, name), (_, until) in [*self._failed.items()]:
            if steady >= until + LONGEST_WAIT_S or (name and is_new):
                del self._failed[what, name]
        for end, name in sorted(_ends(state)):
            if end > now or self.waits_s("end", name):
                continue
            override = state.config.overrides[name]
            try:
                commits.end_override(override, now)
                log.info("%s ended as planned at %s", override.path, override.expires)
            except InvalidInput as error:
                self.failed("end", name)
                for problem in error.faults:
                    log.error("%s cannot be ended: %s; trying again later", override.path, problem)
        # what clusters say may drain a node
        for nodes in self.nodes:
            nodes.commit_due(commits)
        # what runs moves before what waits is booked
        for node in commits.head.state.nodes_to_drain():
            if not self.waits_s("drain", node):
                self._drain(commits, node)
        if self.may_have_room(commits.head.state):
            self.book_waiting(commits)

    def _drain(self, commits: CommitBatch, node: str) -> None:
        # placed applications and services move off it
        after = self._moved_last.pop(node, "")
        try:
            decision = commits.drain(node, after, self._runtime.fresh_id(), self._runtime.now())
        except InvalidInput as error:
            self.failed("drain", node)
            stays: Iterable[str] = map(str, error.faults)
            after = ""
        else:
            assert isinstance(decision.request, Drain)  # noqa: S101 - it was decided
            if decision.request.last:
                self._moved_last[node] = decision.request.last
            elif not decision.files:  # a commit may fail to be published
                self.failed("drain", node)
            for moved in decision.placed:
                log.info("'%s' is drained: %s", node, moved)
            stays = decision.warnings
        # the texts of the last try are not logged again, as a try comes each minute
        texts, logged = frozenset(stays), self._logged.get(node, frozenset())
        for text in sorted(texts - logged):
            log.warning("'%s' is drained: %s", node, text)
        self._logged[node] = texts | logged if after else texts

    # ---- the demands that wait for room ----
    #
    # If there may be room, the generator tries the waiting demands before it decides new demands.
    # So no demand gets the room for which an earlier demand, or one of higher priority, waits.

    def may_have_room(self, state: State) -> bool:
        return bool(state.ledger.waiting) and (bool(self.left) or not self._is_tried(state))

    def _is_tried(self, state: World) -> bool:
        # by identity: ledger and configuration are frozen, and to compare their content takes long
        tried = self._tried
        return tried is not None and tried.ledger is state.ledger and tried.config is state.config

    def book_waiting(self, commits: CommitBatch) -> None:
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

    def book_those_let_in(self, commits: CommitBatch, before: State) -> None:
        """Book waiting demands if the last demand, decided on ``before``, may have let them in."""
        if commits.awaited:
            commits.awaited = False
            self._tried = None
            if self.may_have_room(commits.head.state):
                self.book_waiting(commits)
        elif self._tried is before:  # the last demand let none in, so the tries are still valid
            self._tried = commits.head.state

    # ---- the ends of leases ----
    #
    # A person may set the clock. A clock that is set back only delays the end of a lease. A clock
    # that jumps forward would end leases that were renewed in time, and while no generator ran,
    # nobody could renew one. So after a jump or a start, a lease gets a grace: its slack, at least
    # a minute; after a jump its term too, because its client noticed nothing and renews when it
    # would have anyway. The sleep of a machine looks like a jump. With the term after a start, a
    # generator that is restarted each day would keep the day-long leases of vehicles that are gone.

    def lease_tickets(self, ledger: Ledger) -> list[Ticket]:
        # The tickets are correct only now: later, a requester may renew a lease, or a person may
        # set the clock. If one does not release its claims, the next comes at least a minute later.
        now, claims = self.ended_claims(ledger)
        tickets = list[Ticket]()

        def tell(demand: str, future: Future[Receipt]) -> None:
            self.failed("lease", demand)
            error = future.exception()
            if isinstance(error, InvalidInput):  # no client gets this error, so report it here
                self._runtime.failed(f"end of the lease of {quoted(demand)}", error)
            elif error is None:
                outcome = future.result().outcome
                log.info("the lease of %s has ended: %s", quoted(demand), outcome)

        for demand in dict.fromkeys(claim.demand for claim in claims):
            if not self.waits_s("lease", demand):
                request = Demand("expire", demand, demand=demand, is_complete=True)
                tickets.append(Ticket(self._runtime.fresh_id(), request, now))
                tickets[-1].future.add_done_callback(partial(tell, demand))
        return tickets

    def ended_claims(self, ledger: Ledger) -> tuple[datetime, list[Claim]]:
        """Return the current time, and the claims whose lease has ended, earliest end first."""
        now = self._read_clocks()
        ended = ledger.ended_claims(now)
        # a demand's claims are released together, so if one has a grace, none is released
        granted = {claim.demand for claim in ended if self._has_grace(claim)}
        return now, [claim for claim in ended if claim.demand not in granted]

    def _has_grace(self, claim: Claim) -> bool:
        lease = claim.lease
        if lease is None:
            return True
        grace = max(_SHORTEST_GRACE_S, lease.slack + (lease.seconds if self._has_jumped else 0))
        return self._runtime.monotonic() <= self._steady_since + grace

    def _read_clocks(self) -> datetime:
        now, steady = self._runtime.now(), self._runtime.monotonic()
        jump = (now - self._last_look[0]).total_seconds() - (steady - self._last_look[1])
        self._last_look = (now, steady)
        if jump > _JUMP_S:
            log.warning("the clock jumped forward by %.0f s, so leases get their full term", jump)
            self._steady_since, self._has_jumped = steady, True
        return now

    # ---- fetches ----

    def fetched(self, *, reached: bool, at_least_s: float = 0.0) -> None:
        """Plan the next fetch after a fetch or a push, which both tell of others' commits.

        ``at_least_s`` is for how long the server asks to be left alone.
        """
        self._fetched_at = self._runtime.monotonic()
        if reached:
            for what in ("fetch", "check"):
                self._failed.pop((what, ""), None)
        elif self._interval:
            self.failed("fetch", first=self._interval)
        if self._interval:
            pause = max(self._interval * self._runtime.uniform(0.8, 1.0), at_least_s)
            self._fetch_at = self._fetched_at + pause

    # ---- checks of the proposals ----

    def check_begins(self) -> None:
        self._check_began = self._runtime.monotonic()
        self.failed("check", first=self._check_interval)  # unless it ends

    def judged(self, began: float) -> None:
        now = self._runtime.monotonic()
        self._judge_at = now + _JUDGING_PAUSE_FACTOR * (now - began)

    def checked(self, main: str) -> None:
        now = self._runtime.monotonic()
        self._failed.pop(("check", ""), None)
        self._checked, self._check_at = main, self._check_began + self._check_interval
        self._check_new_main_at = now + _PAUSE_FACTOR * (now - self._check_began)


def _ends(world: World) -> list[tuple[datetime, str]]:
    # of the overrides in effect
    return [(override.end, override.name) for override in world.overrides if override.end]


# ---- the next attempt to publish: when, and with how many demands ----
#
# There are two kinds of delays: after another writer published first, and while the remote cannot
# be reached. Both kinds are jittered and bounded, so no writer starves, and the writers do not
# flood a remote that comes back.

FIRST_TURN_S = 0.05
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
        self._turn = self._away = FIRST_TURN_S

    def overtaken(self, size: int, evaluating_s: float, pushing_s: float) -> float:
        # The seconds to wait, as another writer published first. ``size`` counts the demands of the
        # attempt, which took ``evaluating_s`` to commit them, and ``pushing_s`` from then on.

        # a writer that evaluates for longer than its push takes always loses to faster writers
        self.max_demands = max(1, int(size * min(1.0, pushing_s / max(evaluating_s, 1e-9))))
        wait, self._turn = self._turn, min(self._turn * 2, LONGEST_TURN_S)
        self._away = FIRST_TURN_S
        return wait * self._runtime.uniform(0.5, 1.0)

    def unreachable(self) -> float:
        wait, self._away = self._away, min(self._away * 2, LONGEST_AWAY_S)
        return wait * self._runtime.uniform(0.5, 1.0)


# ---- the budget of one decision, because other demands wait meanwhile ----

# The usual demand lists a dozen topics; one of so many characters is decided in some 10 ms. What
# was decided before a longer one is published first.
USUAL_LENGTH = 20_000


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
        # by domain and requester: the operations of the last minute, with their times
        self._seen: dict[tuple[str, str], dict[str, datetime]] = {}

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
        # by the distance of times, because the clock may have been set back
        recent = {
            earlier: at
            for earlier, at in self._seen.pop(key, {}).items()
            if abs(received - at) <= _WINDOW
        }
        recent.setdefault(operation, received)  # one that is evaluated again keeps its number
        self._seen[key] = recent  # at the end, so that the requester that is idle longest is first
        # forget requesters that sent nothing for a minute, because vehicles come and go
        while all(abs(received - at) > _WINDOW for at in next(iter(self._seen.values())).values()):
            self._seen.pop(next(iter(self._seen)))
        return list(recent).index(operation) + 1


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
