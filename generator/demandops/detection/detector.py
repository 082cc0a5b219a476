"""The detector without ROS: it turns observations into the goals that its rules want.

The detector holds the rules in effect and the engine's state. The caller reads files and clocks,
and sends the goals.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from demandops.config.durations import seconds_of
from demandops.detection.events.detection_state import Event, Key, Observation
from demandops.detection.events.event_engine import EventEngine
from demandops.detection.rules.rule_demand import Goal
from demandops.detection.rules.rule_file import RuleFile
from demandops.detection.rules.rule_template import Values


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
        self._rules = {rule.name: rule for rule in file.rules}
        self._engine = EventEngine(file)
        self._state = self._engine.start(now)
        self._values: dict[Key, Values] = {}

    @property
    def lasting(self) -> frozenset[Key]:
        return self._state.lasting

    @property
    def entities(self) -> int:
        """How many entities have been seen and do not count as gone."""
        return len(self._state.seen)

    def resume(self, booked: Mapping[Key, Goal], now: float, settle_s: float) -> list[Want]:
        """Continue the events whose demands were booked before the detector started.

        Call this before the first step, because it forgets what steps have found. ``booked`` has a
        goal for each event, which may lack everything except the demand's id and requesters. The
        events' entities count as gone if they stay unseen for ``settle_s`` seconds, or for the
        timeout of their source if that is longer.

        Return what each event wants: its demand or, if no rule is for the event any longer, the end
        of its demand.
        """
        self._state = self._engine.start(now, booked, settle_s)
        lasting = self._state.lasting
        return [self._want(key, goal if key in lasting else None) for key, goal in booked.items()]

    def step(self, observations: Iterable[Observation], now: float) -> list[tuple[Event, Want]]:
        """Return the events that start or stop by now, each with what it wants."""
        self._state, events = self._engine.step(self._state, observations, now)
        wants = []
        for event in events:
            goal = None
            if event.starts:
                self._values[event.key] = event.values
                goal = self._rules[event.rule].template.goal(event.values)
            else:
                self._values.pop(event.key, None)
            wants.append((event, self._want(event.key, goal)))
        return wants

    def set_clock(self, seconds: float) -> None:
        """Shift all recorded times, because the clock was set forward by ``seconds``, or back."""
        self._state = self._state.shifted(seconds)

    def replace_rules(self, file: RuleFile, now: float, settle_s: float) -> list[Want]:
        """Replace the rules; return what changes for the events that have not ended.

        An event ends if its rule is gone or is no longer for its entities. If the rule has changed,
        the event wants the goal of the changed rule. Dwell times begin anew. As in :meth:`resume`,
        the entities of lasting events count as gone if unseen for ``settle_s``.
        """
        before, old = self._state.lasting, self._rules
        self.file, self._engine = file, EventEngine(file)
        self._rules = {rule.name: rule for rule in file.rules}
        self._state = self._engine.start(now, sorted(before), settle_s)
        changed = []
        for key in sorted(before):
            name, subjects = key
            if key not in self._state.lasting:
                self._values.pop(key, None)
                changed.append(Want(key, None))
            elif old[name] != self._rules[name]:
                rule = self._rules[name]
                entities = dict(zip(rule.subjects, subjects, strict=True))
                values: Values = {**self._values.get(key, {}), "rule": name, **entities}
                # After a restart, the values at the start of an event are not known, for example
                # ``distance``. An event whose new demand needs such a value keeps the old one.
                if rule.template.names() <= set(values):
                    changed.append(self._want(key, rule.template.goal(values)))
        return changed

    def _want(self, key: Key, goal: Goal | None) -> Want:
        rule = self._rules.get(key[0])
        if rule is None:
            return Want(key, goal)
        renew_s = seconds_of(rule.renew) if rule.renew else 0
        return Want(key, goal, seconds_of(rule.retry), renew_s)
