"""The files of the ledger that are not claims: what the generator must remember between commits."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from itertools import islice
from typing import Any, Literal, TypeAlias

from pydantic import Field
from rpds import HashTrieMap, HashTrieSet

from demandops.base import naming, strict_yaml
from demandops.base.errors import InvalidInput
from demandops.base.settings import LEDGER_API_VERSION
from demandops.model.config.base_model import FrozenModel, parse_file
from demandops.model.config.override import Override, format_time, parse_time
from demandops.model.demand import demand_goal
from demandops.model.demand.demand_request import DemandRequest, Put, Shutdown
from demandops.model.ledger.claim_file import (
    LEDGER_ROOT,
    Timestamp,
    format_timestamp,
    minute_of,
    parse_timestamp,
    segment,
)

# Earlier versions recorded here for how long a service kept replicas that no demand needed. Such
# files are ignored, and `demandops upgrade` deletes them.
REPLICAS_ROOT = f"{LEDGER_ROOT}/replicas"

# ---- recent shutdowns ----
#
# A client that lost the answer sends its shutdown again, perhaps to another generator. Without a
# record of the first shutdown, the repeat could release another demand of the same requesters. If a
# join or a restoration books something for one of the requesters, the record is removed, because
# the next shutdown may mean what was booked.
#
# Each record is one file: ``ledger/shutdowns/<hh>/<digest>.yaml``.

SHUTDOWNS_ROOT = f"{LEDGER_ROOT}/shutdowns"

# how long after a shutdown the same shutdown counts as a repeat, not as a new one
REMEMBERED = timedelta(minutes=15)

# How old a record must be before forget removes it because of its age. This is longer than
# REMEMBERED, because a repeat that was received in time may wait in a journal before it is decided.
_KEPT = timedelta(hours=1)

# How many old records one request removes at most, so that its commit stays small. It adds one
# record, so old records do not pile up.
_FORGOTTEN = 10

_Index: TypeAlias = "HashTrieMap[str, HashTrieSet[str]]"


@dataclass(frozen=True, slots=True)
class RecentShutdown:
    """The record of a shutdown that released something."""

    digest: str
    request: str
    requesters: tuple[str, ...]
    at: datetime  # when it was received

    @classmethod
    def of(cls, request: Shutdown, at: datetime) -> RecentShutdown:
        # what is listed twice or in another order is the same shutdown
        listed = {
            (
                item.held.subject.kind.value,
                item.held.subject.id,
                tuple(sorted(set(item.requesters))),
                item.held.distinguishing_values(),
                tuple(sorted({words for words, _ in item.held.listed_topics(item.held)})),
            )
            for item in request.demanded
        }
        exact = json.dumps([request.id, sorted(listed)], ensure_ascii=True)
        digest = hashlib.sha256(exact.encode()).hexdigest()[:20]
        return cls(digest, request.id, tuple(sorted(request.requesters())), at)


@dataclass(frozen=True, slots=True)
class RecentShutdowns:
    by_digest: HashTrieMap[str, RecentShutdown] = field(default_factory=HashTrieMap)
    by_requester: _Index = field(default_factory=HashTrieMap)
    by_minute: _Index = field(default_factory=HashTrieMap)

    def earlier(self, shutdown: RecentShutdown) -> RecentShutdown | None:
        record = self.by_digest.get(shutdown.digest)
        # a person may have written a record that has this digest and other requesters
        same = record is not None and replace(record, at=shutdown.at) == shutdown
        return record if record and same and abs(shutdown.at - record.at) <= REMEMBERED else None

    def replace(self, digest: str, shutdown: RecentShutdown | None) -> RecentShutdowns:
        old = self.by_digest.get(digest)
        if old == shutdown:
            return self
        by_digest, by_requester, by_minute = self.by_digest, self.by_requester, self.by_minute
        if old is not None:
            by_digest = by_digest.remove(digest)
            by_minute = _removed(by_minute, minute_of(old.at), digest)
            for who in old.requesters:
                by_requester = _removed(by_requester, who, digest)
        if shutdown is not None:
            by_digest = by_digest.insert(digest, shutdown)
            by_minute = _added(by_minute, minute_of(shutdown.at), digest)
            for who in shutdown.requesters:
                by_requester = _added(by_requester, who, digest)
        return RecentShutdowns(by_digest, by_requester, by_minute)

    def forget(
        self, now: datetime, requesters: Iterable[str] = ()
    ) -> tuple[RecentShutdowns, tuple[str, ...]]:
        """Return the records that are left, and the digests of those that are removed."""
        ended = sorted(minute for minute in self.by_minute if minute < minute_of(now - _KEPT))
        old = (digest for minute in ended for digest in sorted(self.by_minute[minute]))
        forgotten = {*islice(old, _FORGOTTEN)}
        forgotten |= {digest for who in requesters for digest in self.by_requester.get(who, ())}
        left = self
        for digest in forgotten:
            left = left.replace(digest, None)
        return left, tuple(sorted(forgotten))


def _added(index: _Index, key: str, digest: str) -> _Index:
    return index.insert(key, index.get(key, HashTrieSet()).insert(digest))


def _removed(index: _Index, key: str, digest: str) -> _Index:
    left = index[key].remove(digest)
    return index.insert(key, left) if left else index.remove(key)


def shutdowns_path(digest: str) -> str:
    return f"{SHUTDOWNS_ROOT}/{digest[:2]}/{digest}.yaml"


def digest_in(path: str) -> str:
    return path.rsplit("/", 1)[-1].removesuffix(".yaml")


def shutdowns_text(shutdown: RecentShutdown) -> str:
    return strict_yaml.dump(
        {
            "apiVersion": LEDGER_API_VERSION,
            "kind": "Shutdown",
            "digest": shutdown.digest,
            "request": shutdown.request,
            "requesters": list(shutdown.requesters),
            "at": format_timestamp(shutdown.at),
        }
    )


class _ShutdownFile(FrozenModel):
    apiVersion: Literal["demandops.ledger/v2"]
    kind: Literal["Shutdown"]
    digest: str = Field(pattern=r"^[0-9a-f]{20}$")
    request: str
    requesters: tuple[str, ...] = Field(min_length=1, strict=False)
    at: Timestamp


def read_shutdowns(text: str, path: str) -> RecentShutdown | None:
    try:
        file = parse_file(_ShutdownFile, text, path)
    except InvalidInput:
        return None
    requesters = tuple(sorted(set(file.requesters)))  # a person may have listed one twice
    record = RecentShutdown(file.digest, file.request, requesters, parse_timestamp(file.at))
    return record if path == shutdowns_path(file.digest) else None


def read_all_shutdowns(files: Mapping[str, str]) -> RecentShutdowns:
    shutdowns = RecentShutdowns()
    for path, text in files.items():
        if record := read_shutdowns(text, path):
            shutdowns = shutdowns.replace(record.digest, record)
    return shutdowns


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
