"""Claim files: one YAML file for each claim, with a schema version.

The path is ``ledger/<applications|connections>/<hh>/<subject>/<demand>.yaml``. ``subject`` and
``demand`` are slugs with a hash of the exact id, which the file contains. A demand is refused if
the path of its claim is that of another claim's file (:mod:`.collisions`).
"""

from __future__ import annotations

import re
from datetime import datetime, timezone
from types import MappingProxyType
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from demandops.base import naming, strict_yaml
from demandops.base.errors import InvalidInput
from demandops.base.naming import Subject, SubjectKind
from demandops.base.quoting import quoted
from demandops.base.settings import LEDGER_API_VERSION
from demandops.connections.connection import Connection, RouteOptions
from demandops.connections.connection_types import type_named, type_word
from demandops.model.config.base_model import FrozenModel, parse
from demandops.model.demand.claim import (
    LONGEST_S,
    UNSTARTED,
    Application,
    Claim,
    ClaimKey,
    Delivery,
    InputTopic,
    Lease,
    Requirement,
)

LEDGER_ROOT = "ledger"

_JOINED = re.compile(r"[0-9a-f]{20}")  # the form of what `claim.demand_id` returns
# nine digits, because Python refuses to convert thousands of them
_VERSION = re.compile(r"^demandops\.ledger/v([0-9]{1,9})$")


def segment(exact: str) -> str:
    # readable, and safe on every file system
    return naming.slug_with_hash(exact, exact, 16)


def path_of(key: ClaimKey) -> str:
    return f"{folder_of(key.subject)}/{segment(key.demand)}.yaml"


def folder_of(subject: Subject) -> str:
    # many folders, because a Git tree with 100,000 entries adds 100 ms to each commit
    fan = naming.hash_of(subject.id, 2)
    return f"{LEDGER_ROOT}/{subject.kind.value}/{fan}/{segment(subject.id)}"


def parse_timestamp(text: str) -> datetime:
    try:
        moment = datetime.fromisoformat(text.replace("Z", "+00:00"))
        in_utc = moment.astimezone(timezone.utc)
    except (ValueError, OverflowError):
        message = f"{quoted(text)} is not a time like 2026-01-31T12:00:00.000000Z"
        raise ValueError(message) from None
    if moment.tzinfo is None:
        raise ValueError(f"{quoted(text)} has no time zone; end it in Z")
    return in_utc


def minute_of(moment: datetime) -> str:
    # in UTC, and sorts like the time
    return moment.astimezone(timezone.utc).strftime("%Y-%m-%dT%H:%M")


Timestamp = Annotated[str, AfterValidator(lambda text: parse_timestamp(text) and text)]


def _end_of_lease(text: str) -> str:
    if parse_timestamp(text) >= UNSTARTED:
        raise ValueError(f"{quoted(text)} is after the year 8999; write an earlier time")
    return text


_EndOfLease = Annotated[str, AfterValidator(_end_of_lease)]
# a person may list one twice or in another order
_Requesters = Annotated[tuple[str, ...], AfterValidator(lambda names: tuple(sorted(set(names))))]
# Older files name the requesters of a topic that only some of the claim's requesters held. Today
# all of them hold all topics, so what is demanded by anybody stays.
_NotRead = Annotated[object, Field(exclude=True)]


class _Topic(FrozenModel):
    topic: str
    source: str
    type: str = ""
    further: bool = False
    requesters: _NotRead = None


class _Place(FrozenModel):
    role: str = ""
    labels: dict[str, str] = Field(default_factory=dict)
    capabilities: tuple[str, ...] = Field(default=(), strict=False)
    properties: tuple[str, ...] = Field(default=(), strict=False)

    def requirement(self) -> Requirement:
        labels = tuple(sorted(self.labels.items()))
        capabilities, properties = {*self.capabilities}, {*self.properties}
        return Requirement(
            self.role, labels, tuple(sorted(capabilities)), tuple(sorted(properties))
        )


class _Delivery(FrozenModel):
    output: str
    node: str
    topic: str = ""


class _Route(RouteOptions):
    target: str
    requesters: _NotRead = None


# most routes are written as /a: /b, because they have no options
_RouteEntry = Annotated[
    _Route, BeforeValidator(lambda value: {"target": value} if isinstance(value, str) else value)
]


class _Lease(FrozenModel):
    seconds: int = Field(ge=1, le=LONGEST_S)
    slack: int = Field(default=0, ge=0, le=LONGEST_S)
    until: _EndOfLease | None = None  # None: the lease starts when the claim is approved

    def lease(self) -> Lease:
        until = parse_timestamp(self.until) if self.until else UNSTARTED
        return Lease(self.seconds, self.slack, until)


class _Claim(FrozenModel):
    apiVersion: Literal["demandops.ledger/v1", "demandops.ledger/v2"]
    action: Literal["DeploymentRequest"] | None = None
    demand: str = Field(min_length=1)
    request: str
    requesters: _Requesters = Field(min_length=1, strict=False)
    booked: Timestamp
    lease: _Lease | None = None

    def held(self) -> Application | Connection:
        raise NotImplementedError

    def claim(self) -> Claim:
        return Claim(
            held=self.held(),
            demand=self.demand,
            request=self.request,
            requesters=self.requesters,
            booked=parse_timestamp(self.booked),
            lease=self.lease.lease() if self.lease else None,
            # the first version of claim files had no field ``action``
            joined=self.action is not None
            or (self.apiVersion == "demandops.ledger/v1" and bool(_JOINED.fullmatch(self.demand))),
        )


class _ApplicationFile(_Claim):
    kind: Literal["ApplicationClaim"]
    application: str = Field(min_length=1)
    definition: str
    node: str
    inputs: dict[str, list[_Topic]] = Field(default_factory=dict)
    parameters: dict[str, Any] = Field(default_factory=dict)
    version: str = ""
    deliver: tuple[_Delivery, ...] = Field(default=(), strict=False)
    place: _Place | None = None
    separate: bool = False
    services: dict[str, str] = Field(default_factory=dict)
    moved: dict[str, str] = Field(default_factory=dict)
    named: tuple[str, ...] = Field(default=(), strict=False)

    def held(self) -> Application:
        inputs = {
            role: tuple(sorted(InputTopic(t.topic, t.source, t.type, t.further) for t in topics))
            for role, topics in sorted(self.inputs.items())
            if topics
        }
        return Application(
            self.application,
            self.definition,
            self.node,
            MappingProxyType(inputs),
            MappingProxyType(self.parameters),
            self.version,
            tuple(sorted(Delivery(item.output, item.node, item.topic) for item in self.deliver)),
            self.place.requirement() if self.place else None,
            self.separate,
            MappingProxyType(self.services),
            MappingProxyType(self.moved),
            tuple(sorted({*self.named})),
        )


class _ConnectionFile(_Claim):
    kind: Literal["ConnectionClaim"]
    connection: str = Field(min_length=1)
    type: Annotated[str, type_word()]
    source: str
    target: str
    broker: str = ""
    topics: dict[str, _RouteEntry] = Field(min_length=1)

    def held(self) -> Connection:
        topics = tuple(
            topic.route(source, topic.target) for source, topic in sorted(self.topics.items())
        )
        ends = (self.source, self.target)
        return Connection(self.connection, type_named(self.type), *ends, self.broker, topics)


def text_of(claim: Claim) -> str:
    held = claim.held

    data: dict[str, Any]
    if isinstance(held, Application):
        inputs: dict[str, list[dict[str, Any]]] = {role: [] for role in held.inputs}
        for role, topic in held.all_inputs():
            entry: dict[str, Any] = {"topic": topic.topic, "source": topic.source}
            entry |= {"type": topic.type} if topic.type else {}
            entry |= {"further": True} if topic.further else {}
            inputs[role].append(entry)
        deliver = [{k: v for k, v in item._asdict().items() if v} for item in held.deliver]
        # Empty fields are left out, so that a new field leaves other claims' files as they are
        further = {
            "parameters": dict(sorted(held.parameters.items())),
            "version": held.version,
            "separate": held.separate,
            "deliver": deliver,
            "services": dict(sorted(held.services.items())),
            "named": list(held.named),
            "moved": dict(sorted(held.moved.items())),
        }
        kind, data = "Application", {"definition": held.appdef, "node": held.node, "inputs": inputs}
        data |= {name: value for name, value in further.items() if value}
        data |= {"place": place_data(held.place)} if held.place else {}
    else:
        topics: dict[str, str | dict[str, Any]] = {}
        for route in held.topics:
            options = route.options()
            topics[route.source] = {"target": route.target, **options} if options else route.target
        kind, data = "Connection", {"type": held.known_type.word, "source": held.source}
        data |= {"target": held.target} | ({"broker": held.broker} if held.broker else {})
        data["topics"] = topics
    lease: dict[str, object] = {}
    if claim.lease is not None:
        lease = {"seconds": claim.lease.seconds, "slack": claim.lease.slack}
        if claim.lease.has_started:
            lease["until"] = format_timestamp(claim.lease.until)
    return strict_yaml.dump(
        {
            "apiVersion": LEDGER_API_VERSION,
            "kind": f"{kind}Claim",
            kind.lower(): held.id,
            "demand": claim.demand,
            "request": claim.request,
            "requesters": list(claim.requesters),
            "booked": format_timestamp(claim.booked),
            **({"action": "DeploymentRequest"} if claim.joined else {}),
            **data,
            **({"lease": lease} if lease else {}),
        }
    )


def place_data(place: Requirement) -> dict[str, Any]:
    listed = {
        "role": place.role,
        "labels": dict(place.labels),
        "capabilities": list(place.capabilities),
        "properties": list(place.properties),
    }
    return {name: value for name, value in listed.items() if value}


def format_timestamp(moment: datetime) -> str:
    in_utc = moment.astimezone(timezone.utc).isoformat(timespec="microseconds")
    return f"{in_utc.removesuffix('+00:00')}Z"


def read(text: str, path: str) -> Claim:
    data = strict_yaml.load(text, path)
    kind = data.get("kind") if isinstance(data, dict) else None
    version = _VERSION.match(str(data.get("apiVersion", ""))) if isinstance(data, dict) else None
    # said before the fields are read, because a newer schema has fields that are unknown here
    if version and int(version[1]) > 2:
        message = (
            f"is {data['apiVersion']}, newer than this generator's {LEDGER_API_VERSION}; update "
            "the generator"
        )
        raise InvalidInput.at("apiVersion", message, file=path)
    file: _Claim
    if kind == "ApplicationClaim":
        file = parse(_ApplicationFile, data, path)
    elif kind == "ConnectionClaim":
        file = parse(_ConnectionFile, data, path)
    else:
        message = f"is {kind!r}, but must be ApplicationClaim or ConnectionClaim"
        raise InvalidInput.at("kind", message, file=path)
    claim = file.claim()
    # a file that was moved would be a second claim with the same key
    if path_of(claim.key) != path:
        message = (
            f"the ids in this file belong to {path_of(claim.key)}; move the file to that path, or "
            "restore the ids"
        )
        raise InvalidInput.at("", message, file=path)
    return claim


def kind_of(path: str) -> SubjectKind | None:
    # None if no claim file can have this path
    parts = path.split("/")
    if len(parts) != 5 or parts[0] != LEDGER_ROOT or not path.endswith(".yaml"):
        return None
    return next((kind for kind in SubjectKind if kind.value == parts[1]), None)
