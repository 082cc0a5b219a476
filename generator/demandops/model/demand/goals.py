"""Reads the goals of both actions, as plain data from ROS, a file or the journal, into demands.

A goal in a file has the fields of the message, so files and messages have the same rules. Absent
fields have their defaults, and unknown fields are errors.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal

from pydantic import Field, PlainValidator, ValidationError

from demandops.base import strict_yaml
from demandops.base.errors import MOST_FAULTS, Fault, Refused, fault, field_path
from demandops.base.naming import id_problem, one_form
from demandops.base.quoting import quoted
from demandops.base.ros_parameters import LARGEST_EXACT
from demandops.base.settings import API_VERSION
from demandops.connections import connection_types
from demandops.connections.connection import Connection, Route
from demandops.model.config.base_model import GOAL, FrozenModel, Items, faults_of, seconds_of
from demandops.model.config.inventory import Coordinate, Position
from demandops.model.config.repo_settings import ROOT_FILE, Limits
from demandops.model.demand.demand import (
    DECOMMISSIONED,
    Application,
    Decommission,
    Demand,
    Held,
    InputTopic,
    Item,
    Rollback,
)

# ---- goals of ``demandops_interfaces/action/Demand``, and YAML of the kind ``Demand`` ----


class GoalPosition(FrozenModel):
    """A position for a node that has none in the inventory: metres in the node's map frame."""

    node: str = ""
    x: Coordinate = 0.0
    y: Coordinate = 0.0


def _lease_form(value: object) -> object:
    # without this validator, pydantic reports one fault for each type in the union
    if value is None or (isinstance(value, int) and not isinstance(value, bool)):
        return value
    if isinstance(value, str):
        return seconds_of(value)
    raise ValueError(
        f"must be a duration like 10m, or whole seconds, not {strict_yaml.short_repr(value)}"
    )


class DemandGoal(FrozenModel):
    """A demand. ``lease`` is a duration like ``10m``, or whole seconds."""

    apiVersion: Literal["demandops/v1"] = API_VERSION
    kind: Literal["Demand"] = "Demand"
    operation: Literal["put", "release", "renew"] = "put"
    demand: str = ""
    request: str = ""
    requesters: list[str] = Field(default_factory=list)
    lease: Annotated[
        int | None, PlainValidator(_lease_form, json_schema_input_type=str | int | None)
    ] = None
    applications: Items[Application] = ()
    connections: Items[Connection] = ()
    priority: Annotated[int, Field(ge=-(2**31), lt=2**31)] = 0
    positions: list[GoalPosition] = Field(default_factory=list)
    answer: Literal["pushed", "reconciled", "healthy"] = "pushed"

    def faults(self) -> Iterator[Fault]:  # noqa: PLR0912 - a branch for each fault
        if verb := self.operation if self.operation != "put" else "":
            listed = "applications" if self.applications else "connections"
            remedy = "leave the field out; to change the demand, send a put"
            if verb == "release":
                remedy = "to release a part of the demand, put the demand without that part"
            if self.lease is not None:
                yield fault("lease", "is set by a put; leave it out, or put the demand again")
            if self.applications or self.connections:
                yield fault(listed, f"a {verb} names only its demand; {remedy}")
            if self.priority:
                message = f"a {verb} does not wait for room; leave priority out"
                yield fault("priority", message)
            if self.positions:
                yield fault("positions", f"a {verb} chooses no node; leave the positions out")
        for index, app in enumerate(self.applications):
            for role, topics in app.inputs.items():
                for place, topic in enumerate(topics):
                    where = f"applications[{index}].inputs.{role}[{place}]"
                    if (topic.application or topic.output) and (topic.topic or topic.source):
                        message = "names both a topic and an output of an application; name one"
                        yield fault(where, message)
                    elif bool(topic.application) != bool(topic.output):
                        missing = "output" if topic.application else "application"
                        message = "is missing: an output is named by 'application' and 'output'"
                        yield fault(f"{where}.{missing}", f"{message}; add it")
        placed = set[str]()
        for index, position in enumerate(self.positions):
            if position.node in placed:
                message = f"{quoted(position.node)} has another position above; give only one"
                yield fault(f"positions[{index}].node", message)
            placed.add(position.node)

    def read(self) -> Demand:
        requesters = tuple(self.requesters)
        # the services whose node the demand names
        apps = (replace(app, named=tuple(sorted(app.services))) for app in self.applications)
        lists: dict[str, Iterable[Held]] = {"applications": apps, "connections": self.connections}
        return Demand(
            self.operation,
            self.request or self.demand,
            tuple(
                Item(held, requesters, f"{name}[{index}]")
                for name, listed in lists.items()
                for index, held in enumerate(listed)
            ),
            self.demand,
            requesters,
            self.lease,
            {each.node: Position(x=each.x, y=each.y) for each in self.positions},
            self.priority,
        )


def _with_parameters(index: int, app: Any, faults: list[Fault]) -> Any:  # noqa: ANN401 - plain data
    """Return an application with ``parameters_json`` read into ``parameters``; collect faults."""
    given = app.get("parameters", {}) if isinstance(app, dict) else None
    texts = app.get("parameters_json", {}) if isinstance(app, dict) else None
    if not isinstance(given, dict) or not isinstance(texts, dict):
        return app
    where, values = f"applications[{index}]", dict(given)
    problems = {f"{where}.parameters.{name}": _value_problem(given[name], 0) for name in given}
    for name, text in texts.items():
        try:
            if name in given:
                problem = "is already given in parameters; give it once"
            else:
                values[name] = json.loads(text)
                problem = _value_problem(values[name], 0)
        except (json.JSONDecodeError, TypeError):
            problem = 'is not JSON; text needs its own quotes, as in ""fast""'
        except RecursionError:
            problem = _TOO_DEEP
        except ValueError:  # Python refuses to convert integers of more than 4300 digits
            problem = "has an integer of too many digits; write a shorter one"
        problems[f"{where}.parameters_json.{name}"] = problem
    faults.extend(fault(field, problem) for field, problem in problems.items() if problem)
    others = {name: value for name, value in app.items() if name != "parameters_json"}
    return others | ({"parameters": values} if values else {})


# How many levels a parameter's value may have. It is a part of a claim's file, which may have 100.
_DEEPEST = 50
_TOO_DEEP = f"is nested deeper than {_DEEPEST} levels; make it flatter"
# How many characters a key in a parameter's value may have. YAML reads keys of at most 1024
# characters, in which an escape counts as several.
_LONGEST_KEY = 128

# Helm's toJson writes these as they are, and no YAML may have them: the release would fail for all.
_CONTROL = re.compile("[\x7f-\x9f\ufffe\uffff]")


def _value_problem(value: object, depth: int) -> str:
    if depth > _DEEPEST:
        return _TOO_DEEP
    if isinstance(value, float) and not math.isfinite(value):
        return f"holds {value}, which is not a finite number; give another value, or leave it out"
    if isinstance(value, str) and _HALF.search(value):
        return f"holds {quoted(value)}, which is not Unicode text; write whole characters"
    texts = [value, *value] if isinstance(value, dict) else [value]
    if any(isinstance(text, str) and _CONTROL.search(text) for text in texts):
        return f"holds {quoted(str(value))}, which no chart can write; leave out control characters"
    if type(value) is int and abs(value) > LARGEST_EXACT:
        return f"holds {value}, which Helm rounds; give at most {LARGEST_EXACT}, or a text"
    if isinstance(value, dict) and (long := [key for key in value if len(key) > _LONGEST_KEY]):
        length = f"{len(long[0])} characters, but at most {_LONGEST_KEY} are allowed"
        return f"has the key {quoted(long[0])} of {length}"
    parts = [*value, *value.values()] if isinstance(value, dict) else value
    nested = parts if isinstance(parts, list) else ()
    return next(filter(None, (_value_problem(part, depth + 1) for part in nested)), "")


# ---- goals of the reference's action ``DeploymentRequest`` ----

Uint8 = Annotated[int, Field(ge=0, le=255)]


class WireTopic(FrozenModel):
    """``application_manager_interfaces/msg/Topic``."""

    topic_name: str = ""
    source_node_id: str = ""
    type: str = ""


class WireHeader(FrozenModel):
    """``application_manager_interfaces/msg/ApplicationHeader``."""

    id: str = ""
    node_id: str = ""


class WireBody(FrozenModel):
    """``application_manager_interfaces/msg/ObjectDetectionFusionApp``."""

    requester_ids: list[str] = Field(default_factory=list)
    ego_data_topics: list[WireTopic] = Field(default_factory=list)
    pointcloud_topics: list[WireTopic] = Field(default_factory=list)


class WireApplication(FrozenModel):
    """``application_manager_interfaces/msg/Application``."""

    header: WireHeader = WireHeader()
    type: Uint8 = 0
    object_detection_fusion_app: WireBody = WireBody()


class WireConnection(FrozenModel):
    """``application_manager_interfaces/msg/Connection``."""

    id: str = ""
    broker_node_id: str = ""
    requester_ids: list[str] = Field(default_factory=list)
    source_node_id: str = ""
    source_topics: list[str] = Field(default_factory=list)
    target_node_id: str = ""
    target_topics: list[str] = Field(default_factory=list)
    type: Uint8 = 0


# The lists of inputs in a goal, which stand for roles until the decision knows the definition.
WIRE_LISTS = ("ego_data_topics", "pointcloud_topics")


class WireGoal(FrozenModel):
    """``application_manager_interfaces/action/DeploymentRequest``, the goal."""

    apps: list[WireApplication] = Field(default_factory=list)
    connections: list[WireConnection] = Field(default_factory=list)
    id: str = ""
    shutdown: bool = False

    def faults(self) -> Iterator[Fault]:
        kinds = {kind.number: kind.name for kind in connection_types.CONNECTION_TYPES}
        for index, connection in enumerate(self.connections):
            sources, targets = connection.source_topics, connection.target_topics
            if connection.type not in kinds:
                types = ", ".join(f"{number} ({name})" for number, name in sorted(kinds.items()))
                message = f"{connection.type} is not a connection type; known: {types}"
                yield fault(f"connections[{index}].type", message, code="unknown-connection-type")
            if len(sources) != len(targets):
                message = (
                    f"has {len(targets)} names, but source_topics has {len(sources)}; source "
                    "topic i goes to target topic i, so both lists must have the same length"
                )
                yield fault(f"connections[{index}].target_topics", message)

    def read(self) -> Demand:
        items = []
        for index, app in enumerate(self.apps):
            body = app.object_detection_fusion_app
            held = Application(
                app.header.id,
                f"#{app.type}",
                app.header.node_id,
                {
                    name: tuple(
                        InputTopic(topic.topic_name, topic.source_node_id, topic.type)
                        for topic in topics
                    )
                    for name in WIRE_LISTS
                    if (topics := getattr(body, name))
                },
            )
            requesters = tuple(dict.fromkeys(body.requester_ids))
            items.append(Item(held, requesters, f"applications[{index}]"))
        kinds = {kind.number: kind for kind in connection_types.CONNECTION_TYPES}
        for index, connection in enumerate(self.connections):
            topics = zip(connection.source_topics, connection.target_topics, strict=True)
            carried = Connection(
                connection.id,
                kinds[connection.type],
                connection.source_node_id,
                connection.target_node_id,
                connection.broker_node_id,
                tuple(Route(source, target) for source, target in topics),
            )
            requesters = tuple(dict.fromkeys(connection.requester_ids))
            items.append(Item(carried, requesters, f"connections[{index}]"))
        return Demand("shutdown" if self.shutdown else "join", self.id, tuple(items))


# ---- the way in: a goal becomes a demand, or is refused with the faults of its form ----

_NOT_A_MAPPING = (
    "a request is a mapping with the fields of a Demand (kind, demand, requesters and so on), or "
    "with id, apps, connections and shutdown"
)
_NOT_PLAIN = fault(
    "",
    f"the goal is not plain data, or is nested more than {strict_yaml.MAX_DEPTH} deep; give only "
    "text, numbers, true, false, null, lists and mappings",
)


def form_faults(goal: object) -> Sequence[Fault]:
    """Return the faults of a goal that need no configuration, such as unknown fields."""
    try:
        read_goal(goal)
    except Refused as refused:
        return refused.faults
    return ()


def is_demand_goal(goal: Mapping[str, Any]) -> bool:
    # the reference's goals have neither of these fields
    return "kind" in goal or "apiVersion" in goal


def read_goal(goal: object, limits: Limits = Limits()) -> Demand:  # noqa: B008 - it is frozen
    """Return the demand that a goal of either action is; raise Refused with all faults of form."""
    if isinstance(goal, Demand):
        return goal
    try:
        text = json.dumps(goal, separators=(",", ":"))
    except (TypeError, ValueError, RecursionError):
        raise Refused([_NOT_PLAIN]) from None
    # before anything is parsed, because the parser's work grows with the goal
    if len(text) > (most := limits.demand_characters):
        message = _too_large(f"has {len(text)} characters", "demandCharacters", most)
        raise Refused.at("", message, code="too-large")
    # exactly what a restart would read from the journal, so that it decides the same
    goal = json.loads(text)
    faults: list[Fault] = []
    data = _in_one_form(goal, (), faults)
    if not isinstance(data, dict):
        raise Refused([fault("", _NOT_A_MAPPING)])
    if faults:
        raise Refused(faults)
    model: type[DemandGoal | WireGoal] = DemandGoal if is_demand_goal(data) else WireGoal
    united, apps = data, data.get("applications") if model is DemandGoal else None
    if isinstance(apps, list):
        read = [_with_parameters(index, app, faults) for index, app in enumerate(apps)]
        united = data | {"applications": read}
    try:
        parsed = model.model_validate(united, context=GOAL)
    except ValidationError as error:
        raise Refused([*faults, *faults_of(error, model, most=MOST_FAULTS)]) from None
    if faults := [*faults, *parsed.faults()]:
        raise Refused(faults)
    demand = replace(parsed.read(), goal=data)
    if faults := [*size_faults(demand, limits)]:
        raise Refused(faults)
    return demand


# JSON can escape half of a surrogate pair, and no file in UTF-8 can contain the result
_HALF = re.compile("[\ud800-\udfff]")

# the values in these fields are the application's own, and stay as they are
_OWN_VALUES = frozenset({"parameters", "parameters_json"})


def _in_one_form(value: Any, location: tuple[int | str, ...], faults: list[Fault]) -> Any:  # noqa: ANN401
    """Return plain data with its ids in one form of Unicode; collect a fault for each wrong key."""
    if isinstance(value, dict | list) and len(location) >= strict_yaml.MAX_DEPTH:
        raise Refused([_NOT_PLAIN])
    if isinstance(value, list):
        return [_in_one_form(part, (*location, at), faults) for at, part in enumerate(value)]
    if isinstance(value, dict):
        for key in value:
            if _HALF.search(key):
                message = f"the key {strict_yaml.short_repr(key)} is not text"
                faults.append(fault(field_path(location), f"{message}; write whole characters"))
        return {key: _in_one_form(part, (*location, key), faults) for key, part in value.items()}
    is_id = isinstance(value, str) and _OWN_VALUES.isdisjoint(location)
    return one_form(value) if is_id else value


# ---- operators' demands, which no action and no file can express; only the journal has them ----


def decommission(name: str, kinds: frozenset[str], by: str, reason: str) -> Decommission:
    goal = {"kind": "Decommission", "name": name, "as": sorted(kinds), "by": by}
    return read_journaled(goal | ({"reason": reason} if reason else {}))  # type: ignore[return-value]


def rollback(
    to: str, *, drop_newer: bool, reason: str, who: tuple[str, str], **only: str
) -> Rollback:
    # ``only`` names a `demand` or an `application`
    goal = {"kind": "Rollback", "to": to, "dropNewer": drop_newer, "by": list(who), **only}
    return read_journaled(goal | {"reason": " ".join(reason.split())})  # type: ignore[return-value]


def read_journaled(goal: Any) -> Demand:  # noqa: ANN401 - plain data
    kind = goal.get("kind") if isinstance(goal, dict) else None
    if kind == "Decommission":
        name = goal.get("name")
        problem = id_problem(name) if isinstance(name, str) else "must be text"
        if problem:
            raise Refused.at("name", problem)
        kinds = frozenset(kind for kind in goal.get("as", ()) if kind in DECOMMISSIONED)
        by, reason = (str(goal.get(key) or "") for key in ("by", "reason"))
        return Decommission(id=str(name), kinds=kinds, by=by, reason=reason, goal=goal)
    if kind == "Rollback":
        by, email = goal["by"]
        return Rollback(
            to=str(goal["to"]),
            drop_newer=bool(goal["dropNewer"]),
            reason=str(goal["reason"]),
            demand=str(goal.get("demand", "")),
            application=str(goal.get("application", "")),
            by=by,
            email=email,
            goal=goal,
        )
    return read_goal(goal)


# ---- the field of a goal that a fault is about ----

_LISTED = re.compile(r"applications\[(\d+)\]\.?(.*)|connections\[(\d+)\]\.?(.*)")
_BODY = "object_detection_fusion_app"


def goal_field(field: str, demand: Demand, roles: Mapping[str, Mapping[str, str]]) -> str:
    """Return the field of the demand's goal for the field of a fault.

    For example, ``applications[0].inputs.ego_data[2].source`` becomes
    ``apps[0].object_detection_fusion_app.ego_data_topics[2].source_node_id``. ``roles`` maps the
    lists of a goal of the reference's action to roles, for each application definition.
    """
    match = _LISTED.fullmatch(field)
    if match is None:
        return field
    if not demand.is_reference:
        path = match[2] or match[4] or ""
        return path if path.startswith("requesters") else field
    if match[1] is None:
        item, path = f"connections[{match[3]}]", match[4]
        if path.startswith("requesters"):
            return f"{item}.requester_ids{path.removeprefix('requesters')}"
        if path in ("source", "target", "broker"):
            return f"{item}.{path}_node_id"
        if path.startswith("topics"):
            place, _, name = path.removeprefix("topics").partition(".")
            return f"{item}.{'target' if name == 'target' else 'source'}_topics{place}"
        return f"{item}.{path}".rstrip(".")
    item, path = f"apps[{match[1]}]", match[2]
    name, _, within = path.partition(".")
    if name in ("id", "node"):
        return f"{item}.header.{'id' if name == 'id' else 'node_id'}"
    if name.startswith("requesters"):
        return f"{item}.{_BODY}.requester_ids{name.removeprefix('requesters')}"
    if name != "inputs":
        return f"{item}.{path}".rstrip(".")
    role, bracket, place = within.partition("[")
    place = place.replace("].topic", "].topic_name").replace("].source", "].source_node_id")
    held = demand.demanded[int(match[1])].held
    of_role = roles.get(held.appdef, {}) if isinstance(held, Application) else {}
    listed = next((wire for wire, own in of_role.items() if own == role), role)
    return f"{item}.{_BODY}{f'.{listed}' if listed else ''}{bracket}{place}"


# ---- the size of a demand ----


def items_of(request: Demand) -> int:
    items = len(request.own_requesters) + len(request.positions)
    for item in request.demanded:
        held = item.held
        if isinstance(held, Application):
            topics = sum(map(len, held.inputs.values()))
            items += len(held.deliver) + len(held.named) + (held.place.size if held.place else 0)
        else:
            topics = len(held.topics)
        items += len(item.requesters) if request.is_reference else 0
        # each requester holds each topic of its item, so a topic counts once for each of them
        items += (1 + topics) * max(1, len(item.requesters))
    return items


def size_faults(request: Demand, limits: Limits) -> Iterator[Fault]:
    for item in request.demanded:
        held = item.held
        if isinstance(held, Application) and held.parameters:
            size = len(json.dumps(dict(held.parameters), default=str))
            if size > limits.parameter_bytes:
                message = _too_large(f"have {size} bytes", "parameterBytes", limits.parameter_bytes)
                yield item.fault("parameters", message, code="too-large")
    items = items_of(request)
    if items > limits.demand_items:
        listed = (
            f"lists {items} items (applications, connections, topics, requesters and so on, also "
            "of the connections that it needs)"
        )
        message = _too_large(listed, "demandItems", limits.demand_items)
        yield fault("id" if request.is_reference else "demand", message, code="too-large")


def _too_large(size: str, limit: str, most: int) -> str:
    return (
        f"{size}, but at most {most} are allowed; a platform engineer may raise limits.{limit} in "
        f"{ROOT_FILE}"
    )
