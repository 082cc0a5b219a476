"""From observations to goals: the detector without ROS."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from heapq import heappop, heappush
from math import inf
from typing import Any, Literal

from demandops.detect.event_engine import Event, EventEngine, Key, Observation
from demandops.detect.rule_file import BookedDemand, Goal, RuleFile, Values
from demandops.model.config.base_model import seconds_of

# ---- after a restart: the events that had started before it, found in the bookkeeping ----


def booked_events(file: RuleFile, bookkeeping: Mapping[str, Any]) -> dict[Key, Goal]:
    """Return each booked or waiting event, with a goal that can end its demand."""
    demands: list[BookedDemand] = []
    for id, entry in bookkeeping.get("demands", {}).items():
        own_id = id if entry["action"] == "Demand" else entry["request"]
        demands.append((entry["action"], own_id, entry["requesters"]))
    for entry in bookkeeping.get("waiting", ()):
        demands.append(("Demand", entry["demand"], entry["requesters"]))
    goals: dict[Key, Goal] = {}
    for demand in demands:
        for rule in file.rules:
            values = rule.template.subjects_of(demand, rule.subjects, rule.name)
            if values is not None:
                subjects = tuple(str(values[name]) for name in rule.subjects)
                if rule.is_for(subjects):
                    goal = rule.template.outline({"rule": rule.name, **values})
                    goals[rule.name, subjects] = goal
                    break
    return goals


# ---- the detector holds the rules in effect and the engine's state ----
#
# The caller reads files and clocks, and sends the goals.


@dataclass(frozen=True, slots=True)
class Want:
    """The goal that an event wants from now on; ``None`` ends the event's demand.

    ``retry_s`` is how many seconds to wait before a refused goal is sent again. ``renew_s`` is how
    often to send a ``DeploymentRequest`` again, 0 for never.
    """

    key: Key
    goal: Goal | None
    retry_s: float = 30.0
    renew_s: float = 0.0


class Detector:
    def __init__(self, file: RuleFile, now: float) -> None:
        self.file = file
        self._engine = EventEngine(file)
        self._state = self._engine.start(now)
        self._values: dict[Key, Values] = {}

    @property
    def lasting(self) -> frozenset[Key]:
        return self._state.lasting

    @property
    def entities(self) -> int:
        return len(self._state.seen)

    def resume(self, booked: Mapping[Key, Goal], now: float, settle_s: float) -> list[Want]:
        """Continue the events whose demands were booked before, perhaps with outlines as goals.

        Call this before the first step, because it forgets what steps have found. An event that no
        rule is for any longer wants the end of its demand.
        """
        self._state = self._engine.start(now, booked, settle_s)
        lasting = self._state.lasting
        return [self._want(key, goal if key in lasting else None) for key, goal in booked.items()]

    def step(self, observations: Iterable[Observation], now: float) -> list[tuple[Event, Want]]:
        self._state, events = self._engine.step(self._state, observations, now)
        wants = []
        for event in events:
            goal = None
            if event.starts:
                self._values[event.key] = event.values
                goal = self._engine.rules[event.rule].template.filled(event.values)
            else:
                self._values.pop(event.key, None)
            wants.append((event, self._want(event.key, goal)))
        return wants

    def set_clock(self, seconds: float) -> None:
        # The clock was set forward by ``seconds``, or back, so all recorded times move with it.
        self._state = self._state.shifted(seconds)

    def replace_rules(self, file: RuleFile, now: float, settle_s: float) -> list[Want]:
        """Replace the rules; return what changes for the events that have not ended.

        An event ends if its rule is gone or is no longer for its entities. If the rule has changed,
        the event wants the goal of the changed rule. Dwell times begin anew. As in :meth:`resume`,
        the entities of lasting events count as gone if unseen for ``settle_s``.
        """
        before, old = self._state.lasting, self._engine.rules
        self.file, self._engine = file, EventEngine(file)
        self._state = self._engine.start(now, sorted(before), settle_s)
        changed = []
        for key in sorted(before):
            name, subjects = key
            if key not in self._state.lasting:
                self._values.pop(key, None)
                changed.append(Want(key, None))
            elif old[name] != (rule := self._engine.rules[name]):
                entities = dict(zip(rule.subjects, subjects, strict=True))
                values: Values = {**self._values.get(key, {}), "rule": name, **entities}
                # After a restart, the values at the start of an event are not known, for example
                # ``distance``. An event whose new demand needs such a value keeps the old one.
                if rule.template.names() <= set(values):
                    changed.append(self._want(key, rule.template.filled(values)))
        return changed

    def _want(self, key: Key, goal: Goal | None) -> Want:
        if (rule := self._engine.rules.get(key[0])) is None:
            return Want(key, goal)
        renew_s = seconds_of(rule.renew) if rule.renew else 0
        return Want(key, goal, seconds_of(rule.retry), renew_s)


# ---- which demands are wanted, which are held, and which goal to send next ----
#
# The caller sends what :meth:`WantedDemands.next` returns and reports the outcome. Each event has
# at most one goal under way. If an event ends before its demand was sent, nothing is sent for it.

Purpose = Literal["start", "renew", "end"]

# The fraction of a lease after which to renew it, so that time is left for more attempts.
_RENEW_AFTER = 1 / 3
# How many seconds until the next try if no node took the goal. A refused goal waits for its rule's
# ``retry`` instead.
_RETRY_S = 5.0
# How many seconds until the next try while another event holds a demand with the same id.
_OTHER_S = 0.2
# The code if nobody knows whether the node booked the goal.
_UNKNOWN = "timeout"
# The codes of outcomes in which no node took the goal, as far as is known.
_NOT_TAKEN = frozenset({"no-server", "rejected", _UNKNOWN})


@dataclass(frozen=True, slots=True)
class Sending:
    key: Key
    purpose: Purpose
    goal: Goal


@dataclass(frozen=True, slots=True)
class Outcome:
    """The answer to a goal: ``code`` is empty if it succeeded, ``lease_s`` 0 without a lease."""

    code: str = ""
    message: str = ""
    lease_s: float = 0.0


@dataclass(slots=True)
class _Entry:
    """One event's demand; ``held`` is booked, for certain only if ``is_sure``."""

    wanted: Goal | None = None
    held: Goal | None = None
    is_sure: bool = True
    is_under_way: bool = False
    not_before: float = -inf
    renew_at: float = inf
    retry_s: float = 30.0
    renew_s: float = 0.0
    refusal: str = ""

    def next(self, now: float) -> tuple[Purpose, Goal] | None:
        wanted, held = self.wanted, self.held
        if self.is_under_way or now < self.not_before:
            return None
        if held is not None:
            # A ``Demand`` replaces the one with its id and requesters; only they may put it anew.
            # Any other held demand is ended first.
            is_replaced = wanted is not None and (
                wanted == held
                or (
                    wanted.action == held.action == "Demand"
                    and (wanted.id, wanted.requesters) == (held.id, held.requesters)
                )
            )
            if not is_replaced:
                return "end", held.ended()
        if wanted is None:
            return None
        if wanted != held or not self.is_sure:
            return "start", wanted
        return ("renew", wanted.renewed()) if now >= self.renew_at else None

    def due(self) -> float:
        """Return the time from which :meth:`next` may have a goal; infinite if nothing remains."""
        if self.is_under_way:
            return inf
        is_steady = self.wanted is not None and self.wanted == self.held and self.is_sure
        return max(self.not_before, self.renew_at if is_steady else -inf)


class WantedDemands:
    def __init__(self) -> None:
        self._entries: dict[Key, _Entry] = {}
        self._owners: dict[str, Key] = {}  # which event has a demand id
        self._queue: list[tuple[float, int, Key]] = []
        self._number = 0

    def want(self, want: Want) -> None:
        entry = self._entries.setdefault(want.key, _Entry())
        entry.wanted, entry.not_before, entry.refusal = want.goal, -inf, ""
        entry.retry_s, entry.renew_s = want.retry_s, want.renew_s
        self._enqueue(want.key, entry)

    def hold(self, key: Key, goal: Goal) -> None:
        """Record a demand that was booked before; the caller then wants it or its end."""
        entry = self._entries.setdefault(key, _Entry())
        # Nobody knows how much time its lease has left, so it is renewed at once.
        entry.held, entry.renew_at = goal, -inf
        self._reserve(key, goal)
        self._enqueue(key, entry)

    def next(self, now: float) -> Sending | None:
        """Return a goal to send now; it is under way until :meth:`answered` is called for it."""
        while self._queue and self._queue[0][0] <= now:
            _, _, key = heappop(self._queue)
            entry = self._entries.get(key)
            if entry is not None and (due := entry.next(now)):
                purpose, goal = due
                if self._reserve(key, goal):
                    entry.is_under_way = True
                    return Sending(key, purpose, goal)
                entry.not_before = now + _OTHER_S
                self._enqueue(key, entry)
        return None

    def _reserve(self, key: Key, goal: Goal) -> bool:
        """Reserve the demand id of a goal for an event; return false if another event has it."""
        # After a rule is renamed, an event of the old name and an event of the new name may want
        # demands with the same id. The second then waits until the first has ended its demand.
        # A ``DeploymentRequest`` has no demand id, so there is nothing to reserve.
        return goal.action != "Demand" or self._owners.setdefault(goal.id, key) == key

    def next_at(self) -> float:
        """Return when to call :meth:`next` again, unless another call here comes first."""
        return self._queue[0][0] if self._queue else inf

    def answered(self, sending: Sending, outcome: Outcome, now: float) -> str:
        """Record a goal's outcome; return why the goal failed, if the log should say so."""
        entry, text, is_start = self._entries[sending.key], "", sending.purpose == "start"
        entry.is_under_way = False
        is_over = outcome.code == "not-held" and not is_start
        if outcome.code and not is_over:
            # The node may have booked the goal, so it must be ended if it is wanted no longer.
            if outcome.code == _UNKNOWN and is_start:
                entry.held, entry.is_sure = sending.goal, False
            entry.not_before = now + (_RETRY_S if outcome.code in _NOT_TAKEN else entry.retry_s)
            text = outcome.message if outcome.message != entry.refusal else ""
            entry.refusal = outcome.message
        elif sending.purpose == "end" or is_over:
            entry.held, entry.is_sure, entry.refusal = None, True, ""
        else:
            if is_start:
                entry.held, entry.is_sure = sending.goal, True
            pause = outcome.lease_s * _RENEW_AFTER or entry.renew_s
            entry.renew_at, entry.refusal = now + pause if pause else inf, ""
        if entry.held is None and self._owners.get(sending.goal.id) == sending.key:
            del self._owners[sending.goal.id]
        self._enqueue(sending.key, entry)
        return text

    def _enqueue(self, key: Key, entry: _Entry) -> None:
        if entry.wanted is None and entry.held is None and not entry.is_under_way:
            del self._entries[key]
        elif (at := entry.due()) < inf:
            self._number += 1
            heappush(self._queue, (at, self._number, key))

    # ---- the state, for log and diagnostics ----

    def __len__(self) -> int:
        return len(self._entries)

    def unanswered(self) -> int:
        entries = self._entries.values()
        return sum(entry.wanted != entry.held or not entry.is_sure for entry in entries)

    def refusals(self) -> Iterator[tuple[Key, str]]:
        for key, entry in self._entries.items():
            if entry.refusal:
                yield key, entry.refusal
