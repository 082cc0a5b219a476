"""Finds, from the bookkeeping, the events that had started before a restart."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from demandops.detection.events.detection_state import Key
from demandops.detection.rules.rule_demand import BookedDemand, Goal
from demandops.detection.rules.rule_file import RuleFile


def booked_events(file: RuleFile, bookkeeping: Mapping[str, Any]) -> dict[Key, Goal]:
    """Return each event whose demand is booked or waits for room, with a goal that can end it.

    ``bookkeeping`` has the form that ``demandops bookkeeping --output json`` prints.
    """
    demands = []
    for id, entry in bookkeeping.get("demands", {}).items():
        own_id = id if entry["action"] == "Demand" else ""
        demands.append(BookedDemand(own_id, entry["request"], tuple(entry["requesters"])))
    for entry in bookkeeping.get("waiting", ()):
        demands.append(BookedDemand(entry["demand"], "", tuple(entry["requesters"])))
    goals: dict[Key, Goal] = {}
    for demand in demands:
        for rule in file.rules:
            values = rule.template.subjects_of(demand, rule.subjects, rule.name)
            if values is not None:
                subjects = tuple(str(values[name]) for name in rule.subjects)
                if rule.is_for(*subjects):
                    goal = rule.template.outline({"rule": rule.name, **values})
                    goals[rule.name, subjects] = goal
                    break
    return goals
