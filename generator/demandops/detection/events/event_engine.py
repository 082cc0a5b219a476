"""The engine, which turns observations into events by the rules of one file.

``step`` changes none of its arguments and reads no clock. The same observations give the same
events, however they are split into steps.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from math import inf

from demandops.config.durations import seconds_of
from demandops.detection.events.area_grid import AreaGrid
from demandops.detection.events.compiled_rule import (
    AreaRule,
    CompiledRule,
    HoursRule,
    PairRule,
    ThresholdRule,
    compiled,
)
from demandops.detection.events.detection_state import Event, Key, Observation, State
from demandops.detection.events.engine_step import EngineStep
from demandops.detection.rules.rule_file import RuleFile


class EventEngine:
    """The rules of a file, indexed by source and area; :meth:`step` applies them."""

    def __init__(self, file: RuleFile) -> None:
        self.rules: dict[str, CompiledRule] = {}
        self.timeouts = {name: float(seconds_of(one.timeout)) for name, one in file.sources.items()}
        self.hours: list[HoursRule] = []
        self.thresholds: dict[str, list[ThresholdRule]] = {name: [] for name in file.sources}
        self.pairs: dict[str, list[PairRule]] = {name: [] for name in file.sources}
        areas = defaultdict[str, list[AreaRule]](list)
        for each in file.rules:
            rule = self.rules[each.name] = compiled(each)
            for source in dict.fromkeys(rule.sources):
                if isinstance(rule, AreaRule):
                    areas[source].append(rule)
                elif isinstance(rule, PairRule):
                    self.pairs[source].append(rule)
                elif isinstance(rule, ThresholdRule):
                    self.thresholds[source].append(rule)
            if isinstance(rule, HoursRule):
                self.hours.append(rule)
        self.areas = {
            name: AreaGrid((rule, rule.area, rule.stop) for rule in areas[name])
            for name in file.sources
        }

    def start(self, now: float, held: Iterable[Key] = (), settle_s: float = 0.0) -> State:
        """Return the state with which the engine starts.

        Args:
            now: the time.
            held: the events whose demands are already booked. Events that no rule is for are
                left out.
            settle_s: how many seconds the entities of these events may stay unseen until they count
                as gone. If their source's timeout is longer, the timeout counts instead.
        """
        keys = tuple(held)
        settled = now + max((settle_s, *map(self._timeout_of_count, keys)))
        step = EngineStep(self, State(now, due=-inf, settled=settled, hours_due=now))
        for key in keys:
            step.resume(key, settle_s)
        return step.result()

    def _timeout_of_count(self, key: Key) -> float:
        """Return the timeout of the entities that the event's rule counts; 0 without a count."""
        rule = self.rules.get(key[0])
        is_count = isinstance(rule, AreaRule) and rule.count is not None
        return self.timeouts[rule.sources[0]] if rule and is_count else 0.0

    def step(
        self, state: State, observations: Iterable[Observation], now: float
    ) -> tuple[State, tuple[Event, ...]]:
        """Return the new state, and the events that observations and passing time cause.

        Args:
            state: the state before the step; it is not changed.
            observations: in the order in which they were made. An observation of a source that
                the file lacks is left out. An observation earlier than
                ``state.now`` counts as made at ``state.now``. An observation later than ``now``
                counts as made at ``now``.
            now: the time.
        """
        step = EngineStep(self, state)
        for one in observations:
            if one.source in self.timeouts:
                step.pass_time(min(one.at, now))
                step.observe(one)
        step.pass_time(now)
        return step.result(), tuple(step.events)
