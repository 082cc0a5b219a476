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
        self.timeouts = {
            name: float(seconds_of(source.timeout)) for name, source in file.sources.items()
        }
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

        ``held`` are the events whose demands are already booked. Events that no rule is for are
        left out. Their entities count as gone if they stay unseen for ``settle_s`` seconds, or for
        the timeout of their source if that is longer.
        """
        keys, settle = tuple(held), settle_s
        # A count is complete only when each of its entities had the time to report.
        for name, _ in keys:
            rule = self.rules.get(name)
            if isinstance(rule, AreaRule) and rule.count is not None:
                settle = max(settle, self.timeouts[rule.sources[0]])
        step = EngineStep(self, State(now, due=-inf, settled=now + settle, hours_due=now))
        for key in keys:
            step.resume(key, settle_s)
        return step.result()

    def step(
        self, state: State, observations: Iterable[Observation], now: float
    ) -> tuple[State, tuple[Event, ...]]:
        """Return the new state, and the events that observations and passing time cause.

        The observations are in the order in which they were made. One of a source that the file
        lacks is left out. One earlier than ``state.now`` counts as made then, and one later than
        ``now`` as made at ``now``.
        """
        step = EngineStep(self, state)
        for observation in observations:
            if observation.source in self.timeouts:
                step.pass_time(min(observation.at, now))
                step.observe(observation)
        step.pass_time(now)
        return step.result(), tuple(step.events)
