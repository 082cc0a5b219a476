"""The reference's ``DeploymentRequest`` goal as plain data, parsed into a :class:`DemandRequest`.

The ROS 2 node and ``demandops request FILE`` both use :func:`parse`, so files and messages have
the same rules. Absent fields have ROS's defaults, enums are integers, unknown fields are errors.
Faults name the fields of the message (``apps[0].header.node_id``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType
from typing import Annotated

from pydantic import Field

from demandops.base.errors import Fault, fault
from demandops.base.naming import absolute_topic
from demandops.connections.connection import Connection, Route
from demandops.connections.connection_types import by_number, type_numbered
from demandops.model.config.appdef import ApplicationDefinition
from demandops.model.config.base_model import FrozenModel
from demandops.model.demand.claim import Application, InputTopic
from demandops.model.demand.demand_goal import parse_valid_part
from demandops.model.demand.demand_request import Demanded, DemandRequest, Join, Shutdown

Uint8 = Annotated[int, Field(ge=0, le=255)]
AppdefByType = Callable[[int], ApplicationDefinition | None]


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


class WireGoal(FrozenModel):
    """``application_manager_interfaces/action/DeploymentRequest``, the goal."""

    apps: list[WireApplication] = Field(default_factory=list)
    connections: list[WireConnection] = Field(default_factory=list)
    id: str = ""
    shutdown: bool = False


_BODY = "object_detection_fusion_app"
_LISTS_OF_TEXT = ("requester_ids", "source_topics", "target_topics")


def _application_field(item: str, lists: Mapping[str, str], path: str) -> str:
    # `lists` maps roles to the lists of the goal
    name, _, within = path.partition(".")
    if name in ("id", "node"):
        return f"{item}.header.{'id' if name == 'id' else 'node_id'}"
    if name.startswith("requesters"):
        return f"{item}.{_BODY}.requester_ids{name.removeprefix('requesters')}"
    if name == "appdef":
        return f"{item}.type"
    if name != "inputs":
        return f"{item}.{path}"
    role, bracket, place = within.partition("[")
    place = place.replace("].topic", "].topic_name").replace("].source", "].source_node_id")
    field = f".{lists.get(role, role)}" if role else ""
    return f"{item}.{_BODY}{field}{bracket}{place}"


def _connection_field(item: str, path: str) -> str:
    if path.startswith("requesters"):
        return f"{item}.requester_ids{path.removeprefix('requesters')}"
    if path in ("source", "target", "broker"):
        return f"{item}.{path}_node_id"
    if path.startswith("topics"):
        place, _, name = path.removeprefix("topics").partition(".")
        return f"{item}.{'target' if name == 'target' else 'source'}_topics{place}"
    return f"{item}.{path}"


def parse(data: object, appdef_by_type: AppdefByType) -> tuple[DemandRequest | None, list[Fault]]:
    """Return the request and the faults of its form; one with faults must not be booked."""
    if not isinstance(data, dict):
        return None, [_not_a_mapping()]
    goal, faults = parse_valid_part(data, WireGoal, _LISTS_OF_TEXT)
    faulty = {fault.field for fault in faults}
    demanded: list[Demanded] = []
    for index, app in enumerate(goal.apps):
        appdef, body = appdef_by_type(app.type), app.object_detection_fusion_app
        wire = appdef.deployment_request if appdef else None
        roles = {str(name): role for name, role in wire.inputs.items()} if wire else {}
        inputs: dict[str, tuple[InputTopic, ...]] = {}
        for name in ("ego_data_topics", "pointcloud_topics"):
            topics: list[WireTopic] = getattr(body, name)
            role = roles.get(name) or name
            if topics:
                # the appdef may give both lists to one role
                inputs[role] = inputs.get(role, ()) + tuple(
                    InputTopic(absolute_topic(topic.topic_name), topic.source_node_id, topic.type)
                    for topic in topics
                )
        application = Application(
            id=app.header.id,
            appdef=appdef.name if appdef else f"#{app.type}",
            node=app.header.node_id,
            inputs=MappingProxyType(inputs),
        )
        lists = {role: name for name, role in roles.items()}
        place = partial(_application_field, f"apps[{index}]", lists)
        demanded.append(Demanded(application, tuple(dict.fromkeys(body.requester_ids)), place))
    for index, connection in enumerate(goal.connections):
        where = f"connections[{index}]"
        # an invalid type becomes None, so that nothing is checked that depends on the type
        kind = type_numbered(connection.type) if f"{where}.type" not in faulty else None
        sources, targets = connection.source_topics, connection.target_topics
        # If the lists are not equally long, the longer one fills up the shorter one, so that faults
        # of all topics are found too.
        pairs = zip(
            [*sources, *targets[len(sources) :]], [*targets, *sources[len(targets) :]], strict=True
        )
        held = Connection(
            id=connection.id,
            type=kind,
            source=connection.source_node_id,
            target=connection.target_node_id,
            topics=tuple(Route(absolute_topic(here), absolute_topic(to)) for here, to in pairs),
            broker=connection.broker_node_id,
        )
        requesters = tuple(dict.fromkeys(connection.requester_ids))
        demanded.append(Demanded(held, requesters, partial(_connection_field, where)))
        if kind is None and f"{where}.type" not in faulty:
            types = ", ".join(f"{kind.number} ({kind.name})" for kind in by_number())
            message = f"{connection.type} is not a connection type; known: {types}"
            faults.append(fault(f"{where}.type", message, code="unknown-connection-type"))
        if len(sources) != len(targets):
            message = (
                f"has {len(targets)} names, but source_topics has {len(sources)}; source topic i "
                "goes to target topic i, so both lists must have the same length"
            )
            faults.append(fault(f"{where}.target_topics", message))
    # if "shutdown" is invalid, treat the goal as a shutdown, because a join must obey all its rules
    operation = Shutdown if goal.shutdown or "shutdown" in faulty else Join
    return operation(id=goal.id, demanded=tuple(demanded)), faults


# those that need no configuration
def form_faults(data: object) -> list[Fault]:
    if not isinstance(data, dict):
        return [_not_a_mapping()]
    return parse_valid_part(data, WireGoal, _LISTS_OF_TEXT)[1]


def _not_a_mapping() -> Fault:
    message = (
        "a request is a mapping with the fields of a Demand (kind, demand, requesters and so on), "
        "or with id, apps, connections and shutdown"
    )
    return fault("", message)
