"""Claims: what one demand holds of one application or connection, and the files that record it.

A claim is one YAML file, ``ledger/<applications|connections>/<hh>/<subject>/<demand>.yaml``.
``subject`` and ``demand`` are slugs with a hash of the exact id, which the file contains. A demand
is refused if the path of its claim is that of another claim's file (:mod:`.collisions`).
"""

from __future__ import annotations

import json
import re
from collections.abc import Container, Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from demandops.base import naming, strict_yaml
from demandops.base.errors import InvalidInput
from demandops.base.naming import Subject, SubjectKind, TopicKey
from demandops.base.settings import LEDGER_API_VERSION
from demandops.connections.connection import Connection
from demandops.model.config.base_model import FrozenModel, Moment, parse, plain, time_text
from demandops.model.demand.demand import Application, Held, Lease

# The prefix of the demand ids of claims that overrides make; no other demand may use it
OVERRIDE_PREFIX = "override:"

LEDGER_ROOT = "ledger"


@dataclass(frozen=True, slots=True)
class ClaimKey:
    subject: Subject
    demand: str


@dataclass(frozen=True, slots=True)
class Claim:
    held: Held
    demand: str
    request: str
    requesters: tuple[str, ...]
    booked: datetime
    lease: Lease | None = None
    # A goal of the reference's action booked it; a shutdown takes holds only from such claims
    joined: bool = False

    @property
    def application(self) -> Application:
        assert isinstance(self.held, Application), self.subject  # noqa: S101
        return self.held

    @property
    def connection(self) -> Connection:
        assert isinstance(self.held, Connection), self.subject  # noqa: S101
        return self.held

    @property
    def subject(self) -> Subject:
        return self.held.subject

    @property
    def is_on_application(self) -> bool:
        return self.subject.kind is SubjectKind.APPLICATION

    @property
    def key(self) -> ClaimKey:
        return ClaimKey(self.subject, self.demand)

    @property
    def keeping_override(self) -> str | None:
        # the override that made the claim by its effect `keep`
        name = self.demand.removeprefix(OVERRIDE_PREFIX)
        return None if name == self.demand else name

    def index_entries(self) -> Iterator[tuple[str, ...]]:
        yield ("demand", self.demand)
        for requester in self.requesters:
            yield ("requester", requester)
        if self.keeping_override is not None:
            yield ("kept",)
            yield ("kept", self.subject.kind.value, self.subject.id)
        if self.lease:
            yield ("ends", minute_of(self.lease.expires_at))
        yield from self.held.index_entries()

    def without_topics(self, gone: Container[TopicKey]) -> Claim | None:
        held = self.held.without_topics(gone)
        return replace(self, held=held) if held else None

    def without_node(self, node: str) -> Claim | None:  # the claim must need the node
        held = self.held.without_node(node)
        return replace(self, held=held) if held else None


def minute_of(moment: datetime) -> str:
    # in UTC, and sorts like the time
    return moment.astimezone(timezone.utc).isoformat()[:16]  # strftime does not pad years


def requesters_of(claims: Iterable[Claim]) -> tuple[str, ...]:
    return tuple(sorted({who for claim in claims for who in claim.requesters}))


def demand_id(request: str, requesters: Iterable[str]) -> str:
    # a digest, so that every generator gives a repeated request the same demand id
    exact = json.dumps([request, sorted(set(requesters))], ensure_ascii=True)
    return naming.hash_of(exact, 20)


# ---- the file of a claim ----

_JOINED = re.compile(r"[0-9a-f]{20}")  # the form of what `demand_id` returns
# nine digits, because Python refuses to convert thousands of them
_VERSION = re.compile(r"^demandops\.ledger/v([0-9]{1,9})$")
_NEWEST = 3


def segment(exact: str) -> str:
    # readable, and safe on every file system
    return naming.slug_with_hash(exact, exact, 16)


def path_of(key: ClaimKey) -> str:
    return f"{folder_of(key.subject)}/{segment(key.demand)}.yaml"


def folder_of(subject: Subject) -> str:
    # many folders, because a Git tree with 100,000 entries adds 100 ms to each commit
    fan = naming.hash_of(subject.id, 2)
    return f"{LEDGER_ROOT}/{subject.kind.value}/{fan}/{segment(subject.id)}"


def kind_of(path: str) -> SubjectKind | None:
    # None if no claim file can have this path
    parts = path.split("/")
    if len(parts) != 5 or parts[0] != LEDGER_ROOT or not path.endswith(".yaml"):
        return None
    return next((kind for kind in SubjectKind if kind.value == parts[1]), None)


# a person may list one twice or in another order
Requesters = Annotated[
    tuple[str, ...],
    Field(min_length=1, strict=False),
    AfterValidator(lambda names: tuple(sorted(set(names)))),
]


class _ClaimFile(FrozenModel):
    apiVersion: Literal["demandops.ledger/v3"]
    kind: Literal["Claim"]
    action: Literal["DeploymentRequest"] | None = None
    demand: str = Field(min_length=1)
    request: str
    requesters: Requesters
    booked: Moment
    lease: Lease | None = None
    application: Application | None = None
    connection: Connection | None = None


def text_of(claim: Claim) -> str:
    data = plain(claim.held)
    if claim.is_on_application:
        for name in ("inputs", "parameters", "services", "moved", "held_for"):
            if name in data:
                data[name] = dict(sorted(data[name].items()))
    else:
        for route in data["topics"]:
            if route["source"] == route["target"]:
                del route["target"]
    return strict_yaml.dump(
        {
            "apiVersion": LEDGER_API_VERSION,
            "kind": "Claim",
            "demand": claim.demand,
            "request": claim.request,
            "requesters": list(claim.requesters),
            "booked": time_text(claim.booked),
            **({"action": "DeploymentRequest"} if claim.joined else {}),
            **({"lease": plain(claim.lease)} if claim.lease else {}),
            "application" if claim.is_on_application else "connection": data,
        }
    )


def read(text: str, path: str) -> Claim:
    data = strict_yaml.load(text, path)
    version = _VERSION.match(str(data.get("apiVersion", ""))) if isinstance(data, dict) else None
    # said before the fields are read, because a newer schema has fields that are unknown here
    if version and int(version[1]) > _NEWEST:
        message = (
            f"is {data['apiVersion']}, newer than this generator's {LEDGER_API_VERSION}; update "
            "the generator"
        )
        raise InvalidInput.at("apiVersion", message, file=path)
    if version and int(version[1]) < _NEWEST:
        data = _of_older_version(data)
    file = parse(_ClaimFile, data, path)
    held = file.application or file.connection
    if held is None or (file.application and file.connection) or not held.id:
        message = "has neither an application nor a connection with an id, or both; write one"
        raise InvalidInput.at("", message, file=path)
    if isinstance(held, Connection) and (held.type is None or not held.topics):
        message = "has no type or no topics; write both"
        raise InvalidInput.at("connection", message, file=path)
    key = ClaimKey(held.subject, file.demand)
    # a file that was moved would be a second claim with the same key
    if path_of(key) != path:
        message = (
            f"the ids in this file belong to {path_of(key)}; move the file to that path, or "
            "restore the ids"
        )
        raise InvalidInput.at("", message, file=path)
    return Claim(
        held=held.booked(),
        demand=file.demand,
        request=file.request,
        requesters=file.requesters,
        booked=file.booked,
        lease=file.lease,
        joined=file.action is not None,
    )


# In the files of versions 1 and 2, the fields of an application or a connection stood beside those
# of the claim, and each topic could list the requesters that held it.
_OF_CLAIM = ("demand", "request", "requesters", "booked", "action", "lease")


def _of_older_version(data: dict[str, Any]) -> dict[str, Any]:
    claim = {name: data[name] for name in _OF_CLAIM if name in data}
    held = {
        name: value
        for name, value in data.items()
        if name not in (*_OF_CLAIM, "apiVersion", "kind", "application", "connection", "definition")
    }
    # the first version had no field ``action``
    if data["apiVersion"].endswith("v1") and _JOINED.fullmatch(str(data.get("demand"))):
        claim["action"] = "DeploymentRequest"
    on = "application" if data.get("kind") == "ApplicationClaim" else "connection"
    held["id"] = data.get(on, "")
    if on == "application":
        held["type"] = data.get("definition", "")
        inputs = held.get("inputs")
        for topics in inputs.values() if isinstance(inputs, dict) else ():
            for topic in topics if isinstance(topics, list) else ():
                if isinstance(topic, dict):
                    topic.pop("requesters", None)
        place = held.get("place")
        if isinstance(place, dict) and isinstance(labels := place.get("labels"), dict):
            held["place"] = place | {"labels": [f"{key}={value}" for key, value in labels.items()]}
    elif isinstance(topics := held.get("topics"), dict):
        routes = []
        for source, given in topics.items():
            route = dict(given) if isinstance(given, dict) else {"target": given}
            route.pop("requesters", None)
            if str(held["id"]).startswith("derived/"):  # nobody can list such an id by chance
                route["implied"] = True
            routes.append({"source": source, **route})
        held["topics"] = routes
    return {"apiVersion": LEDGER_API_VERSION, "kind": "Claim", **claim, on: held}
