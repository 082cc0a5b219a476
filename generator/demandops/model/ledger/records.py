"""The files of the ledger that are not claims: what the generator must remember between commits."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from itertools import pairwise
from typing import Any, Literal, NamedTuple, TypeAlias

from pydantic import Field
from rpds import HashTrieMap, HashTrieSet

from demandops.base import naming, strict_yaml
from demandops.base.errors import InvalidInput
from demandops.base.settings import LEDGER_API_VERSION
from demandops.model.config.base_model import FrozenModel, parse_file
from demandops.model.config.override import Override, format_time, parse_time
from demandops.model.demand import demand_goal
from demandops.model.demand.demand_request import DemandRequest, Put
from demandops.model.ledger.claim_file import (
    LEDGER_ROOT,
    Timestamp,
    format_timestamp,
    minute_of,
    parse_timestamp,
    segment,
)

# Folders of records that earlier versions wrote: ignored, and removed by ``demandops upgrade``
GONE_ROOTS = (f"{LEDGER_ROOT}/shutdowns",)

# ---- kept replicas ----
#
# A definition may set how long a service keeps replicas (``scaling.downAfter``). Then the service
# has the highest number of replicas that its demands needed within this time. Its record, the file
# ``ledger/replicas/<hh>/<name>.yaml``, lists each number above the present need, with the time
# until which it is kept. When that time passes, the generator removes the number by a commit. The
# replicas depend on the record, never on the clock, so ``demandops verify`` computes the same bytes
# again.

REPLICAS_ROOT = f"{LEDGER_ROOT}/replicas"

# the key of a service instance: the text ``replicas``, then the values of _FIELDS
Instance: TypeAlias = "tuple[str, ...]"

_FIELDS = ("service", "node", "application", "source", "topic", "version", "scope")


# One step of scaling down
class Kept(NamedTuple):
    replicas: int
    until: datetime


# each step has fewer replicas and a later end than the previous one
Steps: TypeAlias = "tuple[Kept, ...]"


# `until` is the end of a new step
def extended(steps: Steps, needed: int, was_needed: int, now: datetime, until: datetime) -> Steps:
    if was_needed > needed:
        # the new step ends last, so it covers each step with as many replicas or fewer
        steps = (*(step for step in steps if step.replicas > was_needed), Kept(was_needed, until))
    left: list[Kept] = []
    for step in steps:
        # the clock may have been set back, so a later step may end first
        if step.replicas > needed and step.until > (left[-1].until if left else now):
            left.append(step)
    return tuple(left)


@dataclass(frozen=True, slots=True)
class KeptReplicas:
    steps: HashTrieMap[Instance, Steps] = field(default_factory=HashTrieMap)
    # by the minute in which the first step ends, so that the next end is found without a scan
    by_minute: HashTrieMap[str, HashTrieSet[Instance]] = field(default_factory=HashTrieMap)

    def replace(self, instance: Instance, steps: Steps) -> KeptReplicas:
        old = self.steps.get(instance) or ()
        if old == steps:
            return self
        all_steps, by_minute = self.steps, self.by_minute
        if old:
            minute = minute_of(old[0].until)
            left = by_minute[minute].remove(instance)
            by_minute = by_minute.insert(minute, left) if left else by_minute.remove(minute)
            all_steps = all_steps.remove(instance)
        if steps:
            minute = minute_of(steps[0].until)
            others = by_minute.get(minute) or HashTrieSet()
            by_minute = by_minute.insert(minute, others.insert(instance))
            all_steps = all_steps.insert(instance, steps)
        return KeptReplicas(all_steps, by_minute)

    def due(self, now: datetime) -> list[Instance]:
        return sorted(
            instance
            for minute in self.by_minute
            if minute <= minute_of(now)
            for instance in self.by_minute[minute]
            if self.steps[instance][0].until <= now
        )

    def next_end(self) -> datetime | None:
        if not self.by_minute:
            return None
        first = self.by_minute[min(self.by_minute)]
        return min(self.steps[instance][0].until for instance in first)


def replicas_path(instance: Instance) -> str:
    exact = json.dumps(instance[1:], ensure_ascii=True)
    return f"{REPLICAS_ROOT}/{naming.hash_of(exact, 2)}/{segment(exact)}.yaml"


def replicas_text(instance: Instance, steps: Steps) -> str:
    named = zip(_FIELDS, instance[1:], strict=True)
    return strict_yaml.dump(
        {
            "apiVersion": LEDGER_API_VERSION,
            "kind": "KeptReplicas",
            **{name: value for name, value in named if value},
            "keeps": [
                {"replicas": step.replicas, "until": format_timestamp(step.until)} for step in steps
            ],
        }
    )


class _Kept(FrozenModel):
    replicas: int = Field(ge=1, le=1000)
    until: Timestamp


class _KeptReplicasFile(FrozenModel):
    apiVersion: Literal["demandops.ledger/v2"]
    kind: Literal["KeptReplicas"]
    service: str
    node: str
    application: str = ""
    source: str = ""
    topic: str = ""
    version: str = ""
    scope: Literal["", "cluster"] = ""
    keeps: tuple[_Kept, ...] = Field(min_length=1, strict=False)


def read_replicas(text: str, path: str) -> tuple[Instance, Steps] | None:
    # a person may have written the file; a mistake in it must not stop demands
    try:
        file = parse_file(_KeptReplicasFile, text, path)
    except InvalidInput:
        return None
    instance = ("replicas", *(getattr(file, name) for name in _FIELDS))
    steps = tuple(Kept(step.replicas, parse_timestamp(step.until)) for step in file.keeps)
    falls = all(a.replicas > b.replicas and a.until < b.until for a, b in pairwise(steps))
    return (instance, steps) if falls and path == replicas_path(instance) else None


def read_all_replicas(files: Mapping[str, str]) -> KeptReplicas:
    kept = KeptReplicas()
    for path, text in files.items():
        if record := read_replicas(text, path):
            kept = kept.replace(*record)
    return kept


# ---- waiting demands, which the ledger keeps until a node has room ----
#
# A waiting demand holds nothing. When room may be free, the generator tries to book the waiting
# demands: those with the highest priority first and, if the priority is the same, the oldest first.
# A demand that still does not fit does not delay the other waiting demands.
#
# Each waiting demand is one file: ``ledger/waiting/<hh>/<demand>.yaml``.

WAITING_ROOT = f"{LEDGER_ROOT}/waiting"


@dataclass(frozen=True, slots=True)
class WaitingDemand:
    """A demand that waits for room."""

    demand: str
    request: str
    requesters: tuple[str, ...]
    since: datetime  # when it was first received
    priority: int
    goal: Mapping[str, Any]

    @property
    def turn(self) -> tuple[int, datetime, str]:  # the lowest is tried first
        return -self.priority, self.since, self.demand


# by demand id
WaitingDemands: TypeAlias = "HashTrieMap[str, WaitingDemand]"


@dataclass(frozen=True, slots=True)
class Wait(DemandRequest):
    """The request of a demand that must wait; ``reasons`` say why."""

    waiting: WaitingDemand | None = None
    reasons: tuple[str, ...] = ()

    operation = "wait"


def in_turn(waiting: WaitingDemands) -> list[WaitingDemand]:
    return sorted(waiting.values(), key=lambda demand: demand.turn)


def waiting_path(demand: str) -> str:
    return f"{WAITING_ROOT}/{naming.hash_of(demand, 2)}/{segment(demand)}.yaml"


def waiting_text(waiting: WaitingDemand) -> str:
    return strict_yaml.dump(
        {
            "apiVersion": LEDGER_API_VERSION,
            "kind": "WaitingDemand",
            "demand": waiting.demand,
            "request": waiting.request,
            "requesters": list(waiting.requesters),
            "since": format_timestamp(waiting.since),
            "priority": waiting.priority,
            "goal": dict(waiting.goal),
        }
    )


class _WaitingFile(FrozenModel):
    apiVersion: Literal["demandops.ledger/v2"]
    kind: Literal["WaitingDemand"]
    demand: str = Field(min_length=1)
    request: str
    requesters: tuple[str, ...] = Field(min_length=1, strict=False)
    since: Timestamp
    priority: int = 0
    goal: dict[str, Any]


def read_waiting(text: str, path: str) -> WaitingDemand | None:
    try:
        file = parse_file(_WaitingFile, text, path)
        if not demand_goal.is_demand_goal(file.goal):
            return None
        put, _ = demand_goal.parse(file.goal)  # the booking reports the goal's faults
    except InvalidInput:
        return None
    if not isinstance(put, Put) or put.demand != file.demand:
        return None
    if path != waiting_path(file.demand):
        return None
    since = parse_timestamp(file.since)
    return WaitingDemand(
        file.demand, file.request, file.requesters, since, file.priority, file.goal
    )


def read_all_waiting(files: Mapping[str, str]) -> WaitingDemands:
    demands = (demand for path, text in files.items() if (demand := read_waiting(text, path)))
    return HashTrieMap({demand.demand: demand for demand in demands})


# ---- markers: which overrides ended, and when ----
#
# The repo alone, not the clock, decides whether an override applies, because a replay and
# ``verify`` must give the same bytes as the original run. So the generator commits a marker when an
# override ends. If a person then writes another end into the override, or removes the end, the
# override is in effect again.

MARKERS_ROOT = f"{LEDGER_ROOT}/overrides"


class _Marker(FrozenModel):
    apiVersion: Literal["demandops.ledger/v1", "demandops.ledger/v2"]
    kind: Literal["EndedOverride"]
    override: str
    expires: str


def ended_override_path(name: str) -> str:
    return f"{MARKERS_ROOT}/{name}.yaml"


def ended_override_text(override: Override) -> str:
    assert override.end is not None  # noqa: S101 - only an override with an end ends
    return strict_yaml.dump(
        {
            "apiVersion": LEDGER_API_VERSION,
            "kind": "EndedOverride",
            "override": override.name,
            "expires": format_time(override.end),
        }
    )


def read_ended_override(files: Mapping[str, str]) -> dict[str, str]:
    # by name; `stale_markers` lists what is not valid, so that it is removed
    ended = {}
    for path, text in files.items():
        name = path.removeprefix(f"{MARKERS_ROOT}/").removesuffix(".yaml")
        try:
            marker = parse_file(_Marker, text, path)
            if marker.override == name and path == ended_override_path(name):
                ended[name] = format_time(parse_time(marker.expires))
        except (InvalidInput, ValueError):
            continue
    return ended


def stale_markers(files: Mapping[str, str], overrides: Mapping[str, Override]) -> list[str]:
    # A marker is stale if it is not valid, its override is gone, or the override's end was changed
    ended = read_ended_override(files)
    current = {
        ended_override_path(name)
        for name, override in overrides.items()
        if override.end is not None and ended.get(name) == format_time(override.end)
    }
    return sorted({*files} - current)
