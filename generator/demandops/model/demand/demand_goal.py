"""A ``Demand`` as plain data, from ROS, a file or the journal, becomes a request."""

from __future__ import annotations

import json
import math
from collections.abc import Container, Sequence
from functools import partial
from types import MappingProxyType
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, Field, PlainValidator, ValidationError

from demandops.base import strict_yaml
from demandops.base.errors import MOST_FAULTS, Fault, Refused, fault, field_path
from demandops.base.naming import absolute_topic, one_form
from demandops.base.quoting import quoted
from demandops.base.settings import API_VERSION
from demandops.connections.connection import Connection, RouteOptions
from demandops.connections.connection_types import type_named, type_word
from demandops.model.config.base_model import FrozenModel, faults_of, seconds_of
from demandops.model.config.inventory import Coordinate, Position, read_condition
from demandops.model.demand.claim import Application, Delivery, InputTopic, Requirement
from demandops.model.demand.demand_request import Demanded, DemandRequest, Put, Release, Renew

# ---- the form of a goal: the valid part of plain data, and the faults ----
#
# Fields of the wrong form are left out, and the other fields are kept. So the caller can report
# faults of form and of content together.

# how deeply a goal may be nested: as deeply as a YAML file of the state repo
_DEEPEST_GOAL = 100

Goal = TypeVar("Goal", bound=BaseModel)


def parse_valid_part(
    data: dict[str, Any], model: type[Goal], lists_of_text: Container[str]
) -> tuple[Goal, list[Fault]]:
    """Return the part of ``data`` that has the form of ``model``, and a fault for each wrong part.

    Raises Refused with the first faults, if there are too many to look for others.
    """
    faults: list[Fault] = []
    pruned = _plain_part(data, (), faults)
    try:
        return model.model_validate(pruned), faults
    except ValidationError as error:
        if error.error_count() > MOST_FAULTS:  # so many only show a mistake in each item again
            raise Refused([*faults, *faults_of(error, model, most=MOST_FAULTS)]) from None
        faults += faults_of(error, model)
        for item in error.errors():
            pruned = _blank(pruned, item["loc"], lists_of_text)
        return model.model_validate(pruned), faults


# the values in these fields are the application's own, and stay as they are
_OWN_VALUES = frozenset({"parameters", "parameters_json"})


def _plain_part(
    data: Any,  # noqa: ANN401 - plain data
    location: tuple[int | str, ...],
    faults: list[Fault],
) -> Any:  # noqa: ANN401
    # without keys that are not Unicode text, without what is too deep, and with ids in one form
    if len(location) > _DEEPEST_GOAL and isinstance(data, dict | list):
        message = f"is nested deeper than {_DEEPEST_GOAL} levels; make it flatter"
        faults.append(fault(field_path(location[:2]), message))
        return None
    if isinstance(data, list):
        return [_plain_part(item, (*location, i), faults) for i, item in enumerate(data)]
    if isinstance(data, str) and not data.isascii() and _OWN_VALUES.isdisjoint(location):
        return one_form(data)
    if not isinstance(data, dict):
        return data
    kept = {}
    for key, value in data.items():
        if isinstance(key, str) and is_unicode(key):
            kept[key] = _plain_part(value, (*location, key), faults)
        else:
            remedy = "write whole characters" if isinstance(key, str) else "put it in quotes"
            message = f"the key {strict_yaml.short_repr(key)} must be text; {remedy}"
            faults.append(fault(field_path(location), message))
    return kept


def is_unicode(text: str) -> bool:
    # JSON can escape half of a surrogate pair, and no file in UTF-8 can contain the result
    return not any("\ud800" <= char <= "\udfff" for char in text)


def _blank(
    data: dict[str, Any], location: Sequence[int | str], lists_of_text: Container[str]
) -> dict[str, Any]:
    # removes the value at `location` in place
    *parents, last = location
    node: Any = data
    within = ""
    for head in parents:
        if isinstance(node, dict) and head in node:
            within = str(head)
        elif not isinstance(node, list) or not isinstance(head, int):
            return data
        node = node[head]
    if isinstance(node, list) and isinstance(last, int):
        # an empty item, because later faults name the positions of later items
        node[last] = "" if within in lists_of_text else {}
    elif isinstance(node, dict):
        node.pop(last, None)  # so that the field's default applies
    return data


# ---- goals of ``demandops_interfaces/action/Demand``, and YAML of the kind ``Demand`` ----


class GoalTopic(FrozenModel):
    """An input topic of an application, and the node that publishes it."""

    topic: str = ""
    source: str = ""
    type: str = ""


class GoalPlace(FrozenModel):
    """Requirements on the node of an application; ``labels`` are ``key=value``.

    ``properties`` are ``name=value``, ``name>=number`` or ``name<=number``.
    """

    role: str = ""
    labels: list[str] = Field(default_factory=list)
    capabilities: list[str] = Field(default_factory=list)
    properties: list[str] = Field(default_factory=list)


class GoalDelivery(FrozenModel):
    """An output of an application, and the node that it is brought to."""

    output: str = ""
    node: str = ""
    topic: str = ""


class GoalPosition(FrozenModel):
    """A position for a node that has none in the inventory: metres in the node's map frame."""

    node: str = ""
    x: Coordinate = 0.0
    y: Coordinate = 0.0


class GoalApplication(FrozenModel):
    """One application: its id, type (the name of an appdef), node and inputs by role.

    ``parameters`` maps names to values, and ``parameters_json`` maps names to values as JSON text.
    ``version`` is a version or a channel of the registry. ``connect`` is the type of the derived
    connections for the application's flows and deliveries: ``auto`` derives them with any type,
    ``none`` derives none. What a connection of the demand carries needs no derived connection.
    ``services`` maps service names to nodes.
    """

    id: str = ""
    type: str = ""
    node: str = ""
    services: dict[str, str] = Field(default_factory=dict)
    inputs: dict[str, list[GoalTopic]] = Field(default_factory=dict)
    parameters: dict[str, Any] = Field(default_factory=dict)
    parameters_json: dict[str, str] = Field(default_factory=dict)
    version: str = ""
    connect: Annotated[str, type_word("auto", after=("none",))] = "auto"
    place: GoalPlace = GoalPlace()
    deliver: list[GoalDelivery] = Field(default_factory=list)


class GoalRoute(RouteOptions):
    """A topic of a connection; without ``target`` it has the same name at both ends."""

    source: str = ""
    target: str = ""


class GoalConnection(FrozenModel):
    """One connection and the topics that it carries."""

    id: str = ""
    type: Annotated[str, type_word("auto")] = "auto"
    source: str = ""
    target: str = ""
    broker: str = ""
    topics: list[GoalRoute] = Field(default_factory=list)


def _lease_form(value: object) -> object:
    # without this validator, pydantic reports one fault for each type in the union
    if value is None or (isinstance(value, str | int) and not isinstance(value, bool)):
        return value
    raise ValueError(
        f"must be a duration like 10m, or whole seconds, not {strict_yaml.short_repr(value)}"
    )


Lease = Annotated[str | int | None, PlainValidator(_lease_form)]


class DemandGoal(FrozenModel):
    """A demand. ``lease`` is a duration like ``10m``, or whole seconds."""

    apiVersion: Literal["demandops/v1"] = API_VERSION
    kind: Literal["Demand"] = "Demand"
    operation: Literal["put", "release", "renew"] = "put"
    demand: str = ""
    request: str = ""
    requesters: list[str] = Field(default_factory=list)
    lease: Lease = None
    applications: list[GoalApplication] = Field(default_factory=list)
    connections: list[GoalConnection] = Field(default_factory=list)
    priority: Annotated[int, Field(ge=-(2**31), lt=2**31)] = 0
    positions: list[GoalPosition] = Field(default_factory=list)
    answer: Literal["pushed", "reconciled", "healthy"] = "pushed"


# How many levels a parameter's value may have. It is a part of a claim's file, which may have 100.
_DEEPEST = 50
_TOO_DEEP = f"is nested deeper than {_DEEPEST} levels; make it flatter"
# How many characters a key in a parameter's value may have. YAML reads keys of at most 1024
# characters, in which an escape counts as several.
_LONGEST_KEY = 128
_LISTS_OF_TEXT = ("requesters", "labels", "capabilities", "properties")


def is_demand_goal(data: dict[str, Any]) -> bool:
    # the reference's goals have neither of these fields
    return "kind" in data or "apiVersion" in data


def parse(data: dict[str, Any]) -> tuple[DemandRequest, list[Fault]]:
    """Return the request and the faults of its form; one with faults must not be booked."""
    goal, faults = parse_valid_part(data, DemandGoal, _LISTS_OF_TEXT)
    requesters = tuple(goal.requesters)
    id = goal.request or goal.demand
    lease_s: int | None = None
    if isinstance(goal.lease, str):
        try:
            lease_s = seconds_of(goal.lease)
        except ValueError as error:
            faults.append(fault("lease", str(error)))
    else:
        lease_s = goal.lease
    if goal.operation != "put":
        verb = goal.operation
        if lease_s is not None:
            message = "is set by a put; leave it out, or put the demand again"
            faults.append(fault("lease", message))
        if goal.applications or goal.connections:
            remedy = "leave the field out; to change the demand, send a put"
            if verb == "release":
                remedy = "to release a part of the demand, put the demand without that part"
            field = "applications" if goal.applications else "connections"
            faults.append(fault(field, f"a {verb} names only its demand; {remedy}"))
        if goal.priority:
            message = f"a {verb} does not wait for room; leave priority out"
            faults.append(fault("priority", message))
        if goal.positions:
            message = f"a {verb} chooses no node; leave the positions out"
            faults.append(fault("positions", message))
        operation = Release if goal.operation == "release" else Renew
        return operation(id, demand=goal.demand, own_requesters=requesters), faults
    applications = (
        Demanded(
            _application(f"applications[{index}]", app, faults),
            requesters,
            partial(_field, f"applications[{index}]"),
            connect=app.connect,
        )
        for index, app in enumerate(goal.applications)
    )
    connections = (
        Demanded(
            Connection(
                id=connection.id,
                type=None if connection.type == "auto" else type_named(connection.type),
                source=connection.source,
                target=connection.target,
                topics=tuple(
                    r.route(absolute_topic(r.source), absolute_topic(r.target or r.source))
                    for r in connection.topics
                ),
                broker=connection.broker,
            ),
            requesters,
            partial(_field, f"connections[{index}]"),
        )
        for index, connection in enumerate(goal.connections)
    )
    positions: dict[str, Position] = {}
    for index, position in enumerate(goal.positions):
        if position.node in positions:
            message = f"{quoted(position.node)} has another position above; give only one"
            faults.append(fault(f"positions[{index}].node", message))
        positions[position.node] = Position(x=position.x, y=position.y)
    put = Put(
        id,
        demand=goal.demand,
        own_requesters=requesters,
        demanded=(*applications, *connections),
        lease_s=lease_s,
        positions=positions,
        priority=goal.priority,
    )
    return put, faults


def _field(item: str, path: str) -> str:
    # the requesters are a field of the goal, and the appdef is its field ``type``
    if path.startswith("requesters"):
        return path
    return f"{item}.{'type' if path == 'appdef' else path}"


def _requirement(where: str, place: GoalPlace, faults: list[Fault]) -> Requirement | None:
    if place == GoalPlace():
        return None
    # a text of the wrong type was reported and is empty now, which would be a second fault
    told = {fault.field for fault in faults}
    labels = [tuple(label.split("=", 1)) for label in place.labels]
    for index, label in enumerate(labels):
        field = f"{where}.labels[{index}]"
        if (len(label) < 2 or not label[0]) and field not in told:
            message = f"{quoted(place.labels[index])} is not a label; write it as key=value"
            faults.append(fault(field, message))
    for index, capability in enumerate(place.capabilities):
        field = f"{where}.capabilities[{index}]"
        if not capability and field not in told:
            faults.append(fault(field, "is empty; name a capability, or leave it out"))
    for index, text in enumerate(place.properties):
        field = f"{where}.properties[{index}]"
        if read_condition(text) is None and field not in told:
            message = f"{quoted(text)} is not a property; write name=value, name>=8 or name<=8"
            faults.append(fault(field, message))
    pairs = tuple((label[0], label[1]) for label in labels if len(label) > 1)
    return Requirement(place.role, pairs, tuple(place.capabilities), tuple(place.properties))


def _application(where: str, app: GoalApplication, faults: list[Fault]) -> Application:
    parameters: dict[str, Any] = {}
    for name, value in app.parameters.items():
        parameters[name] = _storable(f"{where}.parameters.{name}", value, faults)
    for name, text in app.parameters_json.items():
        place = f"{where}.parameters_json.{name}"
        if name in parameters:
            faults.append(fault(place, "is already given in parameters; give it once"))
            continue
        try:
            parameters[name] = _storable(place, json.loads(text), faults)
        except json.JSONDecodeError:
            message = 'is not JSON; text needs its own quotes, as in "\\"fast\\""'
            faults.append(fault(place, message))
        except RecursionError:
            faults.append(fault(place, _TOO_DEEP))
        except ValueError:  # Python refuses to convert integers of more than 4300 digits
            faults.append(fault(place, "has an integer of too many digits; write a shorter one"))
    return Application(
        id=app.id,
        appdef=app.type,
        node=app.node,
        inputs=MappingProxyType(
            {
                role: tuple(InputTopic(absolute_topic(t.topic), t.source, t.type) for t in topics)
                for role, topics in app.inputs.items()
                if topics
            }
        ),
        parameters=MappingProxyType(parameters),
        version=app.version,
        deliver=tuple(
            Delivery(item.output, item.node, absolute_topic(item.topic) if item.topic else "")
            for item in app.deliver
        ),
        place=_requirement(f"{where}.place", app.place, faults),
        services=MappingProxyType(dict(app.services)),
        named=tuple(sorted(app.services)),
    )


def _storable(where: str, value: object, faults: list[Fault]) -> object:
    # None stands for a value that the ledger cannot store; the fault keeps it from being booked
    problem = _value_problem(value, 0)
    if problem:
        faults.append(fault(where, problem))
    return None if problem else value


def _value_problem(value: object, depth: int) -> str:
    if depth > _DEEPEST:
        return _TOO_DEEP
    if isinstance(value, float) and not math.isfinite(value):
        return f"holds {value}, which is not a finite number; give another value, or leave it out"
    if isinstance(value, str) and not is_unicode(value):
        return f"holds {quoted(value)}, which is not Unicode text; write whole characters"
    if isinstance(value, dict) and (long := [key for key in value if len(key) > _LONGEST_KEY]):
        length = f"{len(long[0])} characters, but at most {_LONGEST_KEY} are allowed"
        return f"has the key {quoted(long[0])} of {length}"
    parts = [*value, *value.values()] if isinstance(value, dict) else value
    nested = parts if isinstance(parts, list) else ()
    return next(filter(None, (_value_problem(part, depth + 1) for part in nested)), "")
