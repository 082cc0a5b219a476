"""Waiting demands: no node has room for them, so the ledger keeps them until a node has room.

A waiting demand holds nothing. When room may be free, the generator tries to book the waiting
demands: those with the highest priority first and, if the priority is the same, the oldest first. A
demand that still does not fit does not delay the other waiting demands.

Each waiting demand is one file: ``ledger/waiting/<hh>/<demand>.yaml``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal, TypeAlias

from pydantic import Field
from rpds import HashTrieMap

from demandops import naming, strict_yaml
from demandops.config.base_model import FrozenModel, parse_file
from demandops.demand import demand_goal
from demandops.demand.demand_request import DemandRequest, Put
from demandops.errors import InvalidInput
from demandops.ledger.claim_file import (
    LEDGER_ROOT,
    Timestamp,
    format_timestamp,
    parse_timestamp,
    segment,
)
from demandops.settings import LEDGER_API_VERSION

WAITING_ROOT = f"{LEDGER_ROOT}/waiting"


@dataclass(frozen=True, slots=True)
class WaitingDemand:
    """A demand that waits for room; ``since`` is when it was first received."""

    demand: str
    request: str
    requesters: tuple[str, ...]
    since: datetime
    priority: int
    goal: Mapping[str, Any]

    @property
    def turn(self) -> tuple[int, datetime, str]:
        """The key by which waiting demands are sorted: the lowest is tried first."""
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
    """Return the waiting demands in the order in which the generator tries to book them."""
    return sorted(waiting.values(), key=lambda demand: demand.turn)


def path_of(demand: str) -> str:
    return f"{WAITING_ROOT}/{naming.hash_of(demand, 2)}/{segment(demand)}.yaml"


def text_of(waiting: WaitingDemand) -> str:
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


def read(text: str, path: str) -> WaitingDemand | None:
    """Return the waiting demand in a file, or ``None`` if the file is not valid.

    The put in a valid file may have faults.
    """
    try:
        file = parse_file(_WaitingFile, text, path)
        if not demand_goal.is_demand_goal(file.goal):
            return None
        put, _ = demand_goal.parse(file.goal)  # the booking reports the goal's faults
    except InvalidInput:
        return None
    if not isinstance(put, Put) or put.demand != file.demand:
        return None
    if path != path_of(file.demand):
        return None
    since = parse_timestamp(file.since)
    return WaitingDemand(
        file.demand, file.request, file.requesters, since, file.priority, file.goal
    )


def read_all(files: Mapping[str, str]) -> WaitingDemands:
    """Return the waiting demands in ``files`` (path to text); invalid files are skipped."""
    demands = (demand for path, text in files.items() if (demand := read(text, path)))
    return HashTrieMap({each.demand: each for each in demands})
