"""Claim files: one YAML file for each claim, with a schema version.

The path is ``ledger/<applications|connections>/<hh>/<subject>/<demand>.yaml``. ``hh`` spreads the
folders, because a Git tree with 100,000 entries costs 100 ms a commit. Path segments are slugs with
a hash of the exact id. The file holds the exact ids, so a moved file is noticed.
"""

from __future__ import annotations

import hashlib
import re
from datetime import datetime, timezone
from types import MappingProxyType
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from demandops import strict_yaml
from demandops.config.base_model import FrozenModel, parse
from demandops.connections.connection_types import type_named, type_word
from demandops.connections.route import Route, RouteOptions
from demandops.demand.claim import (
    ApplicationClaim,
    Claim,
    ClaimKey,
    ConnectionClaim,
    Subject,
    SubjectKind,
)
from demandops.demand.demand_request import InputTopic
from demandops.demand.lease import LONGEST_S, UNSTARTED, Lease
from demandops.errors import InvalidInput, fault
from demandops.settings import LEDGER_API_VERSION

LEDGER_ROOT = "ledger"

_VERSION = re.compile(r"^demandops\.ledger/v(\d+)$")


def segment(exact: str) -> str:
    """Return a path segment for an id: readable, safe on every file system, and unique."""
    digest = hashlib.sha256(exact.encode()).hexdigest()[:16]
    slug = re.sub(r"[^a-z0-9]+", "-", exact.lower()).strip("-")[:40].rstrip("-")
    return f"{slug}-{digest}" if slug else digest


def path_of(key: ClaimKey) -> str:
    """Return the path of a claim's file in the state repo."""
    return f"{folder_of(key.subject)}/{segment(key.demand)}.yaml"


def folder_of(subject: Subject) -> str:
    """Return the folder of all claims on an application or a connection."""
    fan = hashlib.sha256(subject.id.encode()).hexdigest()[:2]
    return f"{LEDGER_ROOT}/{subject.kind.value}/{fan}/{segment(subject.id)}"


def _timestamp(text: str) -> str:
    _time(text)
    return text


def _time(text: str) -> datetime:
    try:
        moment = datetime.fromisoformat(text.replace("Z", "+00:00"))
    except ValueError:
        raise ValueError(f"'{text}' is not a time like 2026-01-31T12:00:00.000000Z") from None
    if moment.tzinfo is None:
        raise ValueError(f"'{text}' has no time zone; end it in Z")
    return moment.astimezone(timezone.utc)


Timestamp = Annotated[str, AfterValidator(_timestamp)]


class _Topic(FrozenModel):
    topic: str
    source: str
    type: str = ""


class _Route(RouteOptions):
    target: str


def _plain_route(value: object) -> object:
    """Read ``/a: /b`` as a route without options."""
    return {"target": value} if isinstance(value, str) else value


class _Lease(FrozenModel):
    seconds: int = Field(ge=1, le=LONGEST_S)
    slack: int = Field(default=0, ge=0, le=LONGEST_S)
    until: Timestamp | None = None  # None: the lease starts with the approval

    def lease(self) -> Lease:
        until = _time(self.until) if self.until else UNSTARTED
        return Lease(self.seconds, self.slack, until)


class _Claim(FrozenModel):
    apiVersion: Literal["demandops.ledger/v1"]
    demand: str = Field(min_length=1)
    request: str
    requesters: tuple[str, ...] = Field(min_length=1, strict=False)
    booked: Timestamp
    lease: _Lease | None = None


class _ApplicationFile(_Claim):
    kind: Literal["ApplicationClaim"]
    application: str = Field(min_length=1)
    definition: str
    node: str
    inputs: dict[str, list[_Topic]] = Field(default_factory=dict)
    parameters: dict[str, Any] = Field(default_factory=dict)
    version: str = ""


class _ConnectionFile(_Claim):
    kind: Literal["ConnectionClaim"]
    connection: str = Field(min_length=1)
    type: Annotated[str, type_word()]
    source: str
    target: str
    broker: str = ""
    topics: dict[str, Annotated[_Route, BeforeValidator(_plain_route)]] = Field(min_length=1)


def text_of(claim: Claim) -> str:
    """Return the text of a claim's file. The same claim gives the same bytes."""
    head: dict[str, Any] = {"apiVersion": LEDGER_API_VERSION}
    tail: dict[str, Any]
    if isinstance(claim, ApplicationClaim):
        head |= {"kind": "ApplicationClaim", "application": claim.application}
        tail = {
            "definition": claim.appdef,
            "node": claim.node,
            "inputs": {
                role: [_topic(topic) for topic in topics] for role, topics in claim.inputs.items()
            },
        }
        if claim.parameters:
            tail["parameters"] = dict(sorted(claim.parameters.items()))
        if claim.version:
            tail["version"] = claim.version
    else:
        head |= {"kind": "ConnectionClaim", "connection": claim.connection}
        tail = {"type": claim.type.word, "source": claim.source, "target": claim.target}
        if claim.broker:
            tail["broker"] = claim.broker
        tail["topics"] = {source: _route(route) for source, route in claim.topics.items()}
    if claim.lease is not None:
        lease: dict[str, object] = {"seconds": claim.lease.seconds, "slack": claim.lease.slack}
        if claim.lease.has_started:
            lease["until"] = _written(claim.lease.until)
        tail["lease"] = lease
    return strict_yaml.dump(
        {
            **head,
            "demand": claim.demand,
            "request": claim.request,
            "requesters": list(claim.requesters),
            "booked": _written(claim.booked),
            **tail,
        }
    )


def _written(moment: datetime) -> str:
    return moment.astimezone(timezone.utc).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def _topic(topic: InputTopic) -> dict[str, str]:
    entry = {"topic": topic.topic, "source": topic.source}
    return entry | {"type": topic.type} if topic.type else entry


def _route(route: Route) -> str | dict[str, Any]:
    options = route.options()
    return {"target": route.target, **options} if options else route.target


def read(text: str, path: str) -> Claim:
    """Parse a claim's file.

    Raises:
        InvalidInput: with every fault, also if the path does not match the ids in the file.
    """
    try:
        data = strict_yaml.load(text)
    except InvalidInput as error:
        raise InvalidInput(strict_yaml.faults_in(error, path)) from None
    kind = data.get("kind") if isinstance(data, dict) else None
    version = _VERSION.match(str(data.get("apiVersion", ""))) if isinstance(data, dict) else None
    if version and int(version[1]) > 1:
        raise InvalidInput(
            [
                fault(
                    "apiVersion",
                    f"is {data['apiVersion']}, newer than this generator's "
                    f"{LEDGER_API_VERSION}; update the generator",
                ).within(path)
            ]
        )
    if kind == "ApplicationClaim":
        claim = _application(parse(_ApplicationFile, data, path))
    elif kind == "ConnectionClaim":
        claim = _connection(parse(_ConnectionFile, data, path))
    else:
        raise InvalidInput(
            [
                fault(
                    "kind", f"is {kind!r}, but must be ApplicationClaim or ConnectionClaim"
                ).within(path)
            ]
        )
    if path_of(claim.key) != path:
        raise InvalidInput(
            [
                fault(
                    "",
                    f"its ids belong to {path_of(claim.key)}; move the file there, or restore "
                    "the ids",
                ).within(path)
            ]
        )
    return claim


def _application(file: _ApplicationFile) -> Claim:
    inputs = {
        role: tuple(sorted(InputTopic(t.topic, t.source, t.type) for t in topics))
        for role, topics in sorted(file.inputs.items())
    }
    return ApplicationClaim(
        application=file.application,
        demand=file.demand,
        request=file.request,
        requesters=tuple(sorted(set(file.requesters))),
        booked=_time(file.booked),
        appdef=file.definition,
        node=file.node,
        inputs=MappingProxyType({role: topics for role, topics in inputs.items() if topics}),
        parameters=MappingProxyType(file.parameters),
        version=file.version,
        lease=file.lease.lease() if file.lease else None,
    )


def _connection(file: _ConnectionFile) -> Claim:
    return ConnectionClaim(
        connection=file.connection,
        demand=file.demand,
        request=file.request,
        requesters=tuple(sorted(set(file.requesters))),
        booked=_time(file.booked),
        type=type_named(file.type),
        source=file.source,
        target=file.target,
        broker=file.broker,
        topics=MappingProxyType(
            {
                source: topic.route(source, topic.target)
                for source, topic in sorted(file.topics.items())
            }
        ),
        lease=file.lease.lease() if file.lease else None,
    )


def kind_of(path: str) -> SubjectKind | None:
    """Return the kind of claim that a path holds, or ``None`` for other files."""
    parts = path.split("/")
    if len(parts) != 5 or parts[0] != LEDGER_ROOT or not path.endswith(".yaml"):
        return None
    return next((kind for kind in SubjectKind if kind.value == parts[1]), None)
