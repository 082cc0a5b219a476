"""The parameters of the node: its own, and those of the reference's node that it understands."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import click
from demandops.base import settings
from demandops.base.quoting import quoted
from demandops.model.config.config import (
    BROKERS_FILE,
    DOMAINS_FILE,
    IMAGES_FILE,
    NODES_FILE,
    Config,
)
from demandops.serve.agenda import DEFAULT_INTERVAL, parse_interval
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterException
from rclpy.node import Node

from demandops_ros.messages import ANSWER_LEVELS

# ---- the parameters of the reference's node, and warnings about those without effect ----
#
# A fleet may start our node with the parameter file of the reference's node. The file calls that
# node ``application_manager``. Our node takes the action's name from the file. Brokers, topics,
# namespaces and the image registry come from the state repo. If the file names one that the state
# repo lacks, the node warns. The node also warns about parameters that it replaces by other means.

ACTION_NAME = "deployment_action_name"
_RENAMES = re.compile(r".*__(node|name):=.*")
_BROKER = re.compile(r"connections\.communication_broker(_params\.(?P<node>.+))?\.host")

_REPLACED = {
    "cluster_config": "a GitOps controller applies what is committed; if the node shall not "
    "answer a goal before its releases are reconciled or healthy, give --clusters, and set the "
    "parameter answer to one of them",
    "helm_release_tag": "the GitOps controller removes releases that are no longer demanded",
    "url_application_registry": "registry/charts.yaml names where each chart comes from",
    "applications": "values of services are in the application definitions, appdefs/",
}


def read_reference_parameters(ros_args: Sequence[str]) -> dict[str, Any]:
    # a rule that renames our node would rename the temporary one, and hide the file's section
    renames = {
        at
        for at, word in enumerate(ros_args)
        if _RENAMES.fullmatch(word) and ros_args[at - 1] in ("-r", "--remap")
    }
    args = [word for at, word in enumerate(ros_args) if not {at, at + 1} & renames]
    probe = Node(
        "application_manager",
        cli_args=args,
        use_global_arguments=False,
        start_parameter_services=False,
        enable_rosout=False,
        automatically_declare_parameters_from_overrides=True,
    )
    try:
        parameters = probe.get_parameters_by_prefix("")
        return {name: parameter.value for name, parameter in parameters.items()}
    finally:
        probe.destroy_node()


def warnings(values: Mapping[str, Any], config: Config) -> Iterator[str]:
    for name in dict.fromkeys(dotted.partition(".")[0] for dotted in values):
        if name in _REPLACED:
            yield f"parameter {name} of the reference is not used: {_REPLACED[name]}"
    namespaces = {domain.namespace for domain in config.domains.values()}
    if values.get("namespace") not in (None, *namespaces):
        yield (
            f"parameter namespace of the reference is not used: {quoted(values['namespace'])} is "
            f"not a namespace in {config.place_of(DOMAINS_FILE)}; services run in the namespace of "
            "their access domain"
        )
    registry = values.get("k3d_image_registry")
    images = config.images.values()
    if registry and not all(image.repository.startswith(f"{registry}/") for image in images):
        yield (
            "parameter k3d_image_registry of the reference is not used: set the field 'registry' "
            f"to {registry} in {config.place_of(IMAGES_FILE)}, and give the images the "
            "names that they have in that registry (docs/migration.md)"
        )
    for name, host in values.items():
        if (match := _BROKER.fullmatch(name)) is None:
            continue
        port, node = values.get(f"{name.removesuffix('host')}port"), match["node"]
        # the host in the inventory may end in the namespace, as in broker.c-its
        is_there = any(
            port in (None, broker.port) and f"{broker.host}.".startswith(f"{host}.")
            for broker_node, broker in config.brokers.items()
            if node in (None, broker_node)
        )
        if not is_there:
            place = f"of node {quoted(node)} " if node else ""
            address = host if port is None else f"{host}:{port}"
            yield (
                f"parameter {name} of the reference is not used: the broker {place}at "
                f"{address} is not in {config.place_of(BROKERS_FILE)}; add it there"
            )
    topics = values.get("connections.init_comm_topics") or ()
    bridged = {
        topic for node in config.nodes.values() for to in node.bridged.values() for topic in to
    }
    if missing := [topic for topic in topics if topic not in bridged]:
        yield (
            "parameter connections.init_comm_topics of the reference is not used: add "
            f"{', '.join(missing)} to the field 'bridged' of the source node in "
            f"{config.place_of(NODES_FILE)}"
        )


# ---- the node's parameters: their defaults, descriptions and ranges ----

LOG_LEVELS = ("debug", "info", "warn", "error", "fatal")
_CHOICES = {
    "answer": ANSWER_LEVELS,
    "deployment_request_ids": ("use", "ignore"),
    "log_level": LOG_LEVELS,
}
DEFAULTS: dict[str, Any] = {
    "action_name": settings.DEFAULT_ACTION_NAME,
    "demand_action_name": settings.DEFAULT_DEMAND_ACTION_NAME,
    "answer": ANSWER_LEVELS[0],
    "answer_timeout": 120.0,
    "deployment_request_ids": "use",
    "state_repo": "",
    "fetch_interval": DEFAULT_INTERVAL,
    "requester_queue_limit": settings.REQUESTER_QUEUE_LIMIT,
    "log_level": "info",
}
_DESCRIPTIONS = {
    "action_name": "Name of the action DeploymentRequest, which the reference's clients use.",
    "demand_action_name": "Name of the action Demand.",
    "answer": "When a DeploymentRequest is answered.",
    "answer_timeout": "How many seconds a goal may take to be reconciled or healthy.",
    "deployment_request_ids": "Whether the id of a DeploymentRequest tells apart what is demanded; "
    "ignored, all are booked under one id.",
    "state_repo": "Folder or URL of the state repo.",
    "fetch_interval": "How often people's commits are fetched while no demand comes; 0 means no "
    "fetches at an interval.",
    "requester_queue_limit": "How many demands of one requester may be without an answer; more "
    "are rejected.",
    "log_level": "Lowest level of messages in the log.",
}

_SECONDS = [FloatingPointRange(from_value=0.001, to_value=86_400.0)]
_COUNT = [IntegerRange(from_value=1, to_value=settings.QUEUE_LIMIT, step=1)]
_RANGES: dict[str, Any] = {
    "answer_timeout": {"floating_point_range": _SECONDS},
    "requester_queue_limit": {"integer_range": _COUNT},
}


def read_node_parameters(given: Mapping[str, str | None]) -> dict[str, Any]:
    """Return all values; ``given`` replaces defaults, and the ROS arguments replace both."""
    # a temporary node reads them, because the generator starts before the node
    defaults = DEFAULTS | {name: value for name, value in given.items() if value}
    probe = Node("demandops", start_parameter_services=False, enable_rosout=False)
    try:
        values = {
            name: probe.declare_parameter(name, default, descriptor(name)).value
            for name, default in defaults.items()
        }
    except ParameterException as error:
        raise click.UsageError(str(error)) from None
    finally:
        probe.destroy_node()
    interval = values["fetch_interval"]  # ROS reads 30 as a number and 30s as text
    values["fetch_interval"] = f"{interval:g}" if isinstance(interval, float) else str(interval)
    if not values["state_repo"]:
        raise click.UsageError(
            "no state repo given; use --state-repo URL_OR_DIR, DEMANDOPS_STATE_REPO or the ROS "
            "parameter state_repo"
        )
    try:
        parse_interval(values["fetch_interval"])
    except ValueError as error:
        raise click.UsageError(f"fetch interval: {error}") from None
    for name, choices in _CHOICES.items():
        if values[name] not in choices:
            raise click.UsageError(
                f"parameter {name} is '{values[name]}'; it takes {', '.join(choices)}"
            )
    return values


def descriptor(name: str, *, read_only: bool = False) -> ParameterDescriptor:
    choices = _CHOICES.get(name)
    return ParameterDescriptor(
        description=_DESCRIPTIONS[name],
        additional_constraints=f"one of {', '.join(choices)}" if choices else "",
        read_only=read_only,
        dynamic_typing=name == "fetch_interval",
        **_RANGES.get(name, {}),
    )
