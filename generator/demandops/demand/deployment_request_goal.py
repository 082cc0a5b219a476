"""The reference's ``DeploymentRequest`` goal as plain data, parsed into a :class:`DemandRequest`.

The ROS 2 node and ``demandops request FILE`` both use :func:`parse`, so files and messages have
the same rules. Absent fields have ROS's defaults, enums are integers, unknown fields are errors.
Faults name the fields of the message (``apps[0].header.node_id``).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Annotated

from pydantic import Field

from demandops.config.appdef import ApplicationDefinition
from demandops.config.base_model import FrozenModel
from demandops.connections.route import Route
from demandops.demand.demand_request import (
    AUTO,
    ApplicationDemand,
    ConnectionDemand,
    DemandRequest,
    InputTopic,
    Operation,
)
from demandops.demand.goal_validation import parse_valid_part
from demandops.errors import Fault, fault
from demandops.identifiers import absolute_topic

Uint8 = Annotated[int, Field(ge=0, le=255)]
AppdefByType = Callable[[int], ApplicationDefinition | None]
AppdefByName = Mapping[str, ApplicationDefinition]


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
_INPUT = re.compile(r"^applications\[(\d+)\]\.inputs\.(\w+)(\[\d+\])?(.*)$")
_LISTS_OF_TEXT = ("requester_ids", "source_topics", "target_topics")
_WIRE_NAMES = (
    (re.compile(r"^applications(\[\d+\])\.id$"), r"apps\1.header.id"),
    (re.compile(r"^applications(\[\d+\])\.node$"), r"apps\1.header.node_id"),
    (re.compile(r"^applications(\[\d+\])\.requesters"), rf"apps\1.{_BODY}.requester_ids"),
    (re.compile(r"^applications(\[\d+\])\.appdef$"), r"apps\1.type"),
    (re.compile(r"^applications(\[\d+\])\.inputs$"), rf"apps\1.{_BODY}"),
    (re.compile(r"^(connections\[\d+\])\.requesters"), r"\1.requester_ids"),
    (re.compile(r"^(connections\[\d+\])\.(source|target)$"), r"\1.\2_node_id"),
    (re.compile(r"^(connections\[\d+\])\.broker$"), r"\1.broker_node_id"),
    (re.compile(r"^(connections\[\d+\])\.topics(\[\d+\])\.(source|target)$"), r"\1.\3_topics\2"),
    (re.compile(r"^(connections\[\d+\])\.topics(\[\d+\])\.\w+$"), r"\1.source_topics\2"),
    (re.compile(r"^(connections\[\d+\])\.topics$"), r"\1.source_topics"),
)


def parse(data: object, appdef_by_type: AppdefByType) -> tuple[DemandRequest | None, list[Fault]]:
    """Parse a goal given as plain data.

    Args:
        data: the goal as a mapping, as ``ros2 action send_goal`` takes it.
        appdef_by_type: returns the appdef of a number in the message, or ``None``.

    Returns:
        The request and the faults of its form. Fields of the wrong form are left out of the
        request, so that the caller can check the others. A request with faults must not be booked.
        The request is ``None`` if ``data`` is not a mapping.
    """
    if not isinstance(data, dict):
        return None, [_not_a_mapping()]
    goal, faults = parse_valid_part(data, WireGoal, _LISTS_OF_TEXT)
    faulty = {found.field for found in faults}
    # without a valid "shutdown", only the rules of both operations apply, which are a shutdown's
    unclear = "shutdown" in faulty
    request = DemandRequest(
        id=goal.id,
        operation=Operation.SHUTDOWN if goal.shutdown or unclear else Operation.JOIN,
        applications=tuple(_application(app, appdef_by_type(app.type)) for app in goal.apps),
        connections=tuple(
            _connection(connection, valid_type=f"connections[{index}].type" not in faulty)
            for index, connection in enumerate(goal.connections)
        ),
    )
    for index, connection in enumerate(goal.connections):
        sources, targets = len(connection.source_topics), len(connection.target_topics)
        if sources != targets:
            faults.append(
                fault(
                    f"connections[{index}].target_topics",
                    f"has {targets} names for {sources} in source_topics; source topic i goes to "
                    "target topic i, so list as many of each",
                )
            )
    return request, faults


def form_faults(data: object) -> list[Fault]:
    """Return the faults of the form of ``data``: unknown fields, wrong types."""
    if not isinstance(data, dict):
        return [_not_a_mapping()]
    return parse_valid_part(data, WireGoal, _LISTS_OF_TEXT)[1]


def _not_a_mapping() -> Fault:
    return fault("", "a request is a mapping with id, apps, connections and shutdown")


def _wire_inputs(appdef: ApplicationDefinition | None) -> Mapping[str, str]:
    """Return the appdef's mapping of the message's topic lists to roles."""
    if appdef is None or appdef.deployment_request is None:
        return {}
    return {str(name): role for name, role in appdef.deployment_request.inputs.items()}


def _application(app: WireApplication, appdef: ApplicationDefinition | None) -> ApplicationDemand:
    body = app.object_detection_fusion_app
    wire_names = _wire_inputs(appdef)
    inputs: dict[str, tuple[InputTopic, ...]] = {}
    for name in ("ego_data_topics", "pointcloud_topics"):
        topics: list[WireTopic] = getattr(body, name)
        role = wire_names.get(name)
        if role and topics:
            inputs[role] = (*inputs.get(role, ()), *_topics(topics))
        elif topics:
            inputs[name] = _topics(topics)
    return ApplicationDemand(
        id=app.header.id,
        appdef=appdef.name if appdef else f"#{app.type}",
        node=app.header.node_id,
        requesters=tuple(dict.fromkeys(body.requester_ids)),
        inputs=MappingProxyType(inputs),
    )


def _topics(topics: Iterable[WireTopic]) -> tuple[InputTopic, ...]:
    return tuple(
        InputTopic(absolute_topic(topic.topic_name), topic.source_node_id, topic.type)
        for topic in topics
    )


def _connection(connection: WireConnection, *, valid_type: bool) -> ConnectionDemand:
    """Return a connection; ``AUTO`` replaces an invalid type, so that no type's rules apply."""
    sources, targets = connection.source_topics, connection.target_topics
    # the caller reports lists of unequal length; names of the longer fill the shorter
    pairs = zip(
        [*sources, *targets[len(sources) :]], [*targets, *sources[len(targets) :]], strict=True
    )
    return ConnectionDemand(
        id=connection.id,
        type=connection.type if valid_type else AUTO,
        source=connection.source_node_id,
        target=connection.target_node_id,
        topics=tuple(
            Route(absolute_topic(source), absolute_topic(target)) for source, target in pairs
        ),
        broker=connection.broker_node_id,
        requesters=tuple(dict.fromkeys(connection.requester_ids)),
    )


def goal_field(path: str, request: DemandRequest, appdefs: AppdefByName) -> str:
    """Return the message's field for a field of ``request``.

    ``applications[0].node`` is ``apps[0].header.node_id`` in the message. A role is the topic list
    that the appdef maps to it.
    """
    for pattern, replacement in _WIRE_NAMES:
        if pattern.match(path):
            path = pattern.sub(replacement, path)
            break
    match = _INPUT.match(path)
    if not match:
        return path
    app, role, place, leaf = match.groups()
    appdef = appdefs.get(request.applications[int(app)].appdef)
    wire = _wire_inputs(appdef)
    names = {wire_role: name for name, wire_role in wire.items()}
    leaf = {".topic": ".topic_name", ".source": ".source_node_id"}.get(leaf, leaf)
    return f"apps[{app}].{_BODY}.{names.get(role, role)}{place or ''}{leaf}"
