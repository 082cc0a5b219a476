"""The files of the ledger that are not claims: waiting demands, and overrides that have ended."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal, TypeAlias

from pydantic import Field
from rpds import HashTrieMap

from demandops.base import naming, strict_yaml
from demandops.base.errors import InvalidInput
from demandops.base.settings import LEDGER_API_VERSION
from demandops.model.config.base_model import FrozenModel, Moment, parse_file, parse_time, time_text
from demandops.model.config.override import Override, format_time
from demandops.model.demand.demand import Demand, Operation
from demandops.model.demand.goals import read_goal
from demandops.model.ledger.claim import LEDGER_ROOT, segment

# Folders of records that earlier versions wrote: ignored, and removed by ``demandops upgrade``
GONE_ROOTS = (f"{LEDGER_ROOT}/replicas/", f"{LEDGER_ROOT}/shutdowns/")

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
    put: Demand
    since: datetime  # when it was first received

    @property
    def demand(self) -> str:
        return self.put.demand

    @property
    def requesters(self) -> tuple[str, ...]:
        return tuple(sorted(self.put.requesters()))

    def __eq__(self, other: object) -> bool:
        # by the goal as it was sent
        if not isinstance(other, WaitingDemand):
            return NotImplemented
        return (self.put.goal, self.since) == (other.put.goal, other.since)

    def __hash__(self) -> int:
        return hash((self.demand, self.since))


# by demand id
WaitingDemands: TypeAlias = "HashTrieMap[str, WaitingDemand]"


@dataclass(frozen=True, slots=True)
class Wait(Demand):
    """What a demand that must wait becomes; its ``notes`` say why."""

    operation: Operation = "wait"
    is_complete: bool = True
    waiting: WaitingDemand | None = None


def in_turn(waiting: WaitingDemands) -> list[WaitingDemand]:  # the first is tried first
    return sorted(waiting.values(), key=lambda each: (-each.put.priority, each.since, each.demand))


def waiting_path(demand: str) -> str:
    return f"{WAITING_ROOT}/{naming.hash_of(demand, 2)}/{segment(demand)}.yaml"


def waiting_text(waiting: WaitingDemand) -> str:
    return strict_yaml.dump(
        {
            "apiVersion": LEDGER_API_VERSION,
            "kind": "WaitingDemand",
            "since": time_text(waiting.since),
            "goal": waiting.put.goal,
        }
    )


class _WaitingFile(FrozenModel):
    apiVersion: Literal["demandops.ledger/v2", "demandops.ledger/v3"]
    kind: Literal["WaitingDemand"]
    since: Moment
    goal: dict[str, Any]
    # version 2 repeated these fields of the goal
    demand: str = ""
    request: str = ""
    requesters: tuple[str, ...] = Field(default=(), strict=False)
    priority: int = 0


def read_waiting(text: str, path: str) -> WaitingDemand | None:
    # a person may have written the file; a mistake in it must not stop demands
    try:
        file = parse_file(_WaitingFile, text, path)
        put = read_goal(file.goal)
    except InvalidInput:
        return None
    if put.operation != "put" or path != waiting_path(put.demand):
        return None
    return WaitingDemand(put, file.since)


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
    apiVersion: Literal["demandops.ledger/v1", "demandops.ledger/v2", "demandops.ledger/v3"]
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
