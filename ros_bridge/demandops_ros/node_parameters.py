"""The parameters of our nodes, and those of the reference's node that ours understands."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import click
from demandops.base import settings
from demandops.base.quoting import one_line, quoted
from demandops.model.config.config import (
    BROKERS_FILE,
    DOMAINS_FILE,
    IMAGES_FILE,
    NODES_FILE,
    Config,
)
from demandops.serve.agenda import DEFAULT_INTERVAL, parse_interval
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node
from rclpy.validate_full_topic_name import validate_full_topic_name

from demandops_ros.messages import ANSWER_LEVELS

# ---- the parameters of a node: what each is, and how it is read ----
#
# ROS takes the type of a parameter from its text, so 2024 is a number even where a name is due. We
# read the values as ROS has them, and declare them afterwards.


def text(value: object) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, int) and not isinstance(value, bool):
        return str(value)
    raise ValueError("takes text; put it in quotes")


def ros_name(value: object) -> str:
    name = text(value)
    try:
        validate_full_topic_name(expand_topic_name(name, "demandops", "/"))
    except Exception as error:  # rclpy raises errors of many kinds
        reason = one_line(str(error)).partition(", at /")[0]
        raise ValueError(f"takes a ROS name, such as /fleet/demand ({reason})") from None
    return name


def ros_name_or_none(value: object) -> str:
    return ros_name(value) if value else ""


def duration(value: object) -> str:
    written = f"{value:g}" if isinstance(value, float) else text(value)
    try:
        parse_interval(written)
    except ValueError:
        raise ValueError("takes a duration like 90s, 10m or 1h30m, or seconds") from None
    return written


@dataclass(frozen=True, slots=True)
class Parameter:
    default: Any
    description: str
    span: tuple[float, float] | None = None  # of a number, whose type is that of the default
    choices: Sequence[str] = ()
    read: Callable[[object], str] = text  # if it is no number; raises ValueError

    def value(self, name: str, given: object) -> Any:  # noqa: ANN401 - of the default's type
        try:
            kind = type(self.default)
            if self.span is None:
                if (value := self.read(given)) not in (self.choices or [value]):
                    raise ValueError(f"takes {', '.join(self.choices)}")
                return value
            if isinstance(given, bool) or not isinstance(given, (int, kind)):
                raise ValueError("takes a whole number" if kind is int else "takes a number")
            if not self.span[0] <= given <= self.span[1]:
                raise ValueError(f"takes a number from {self.limits}")
            return kind(given)
        except ValueError as error:
            shown = one_line(str(given))
            raise click.UsageError(f"parameter {name} is {shown!r}; it {error}") from None

    @property
    def limits(self) -> str:
        if self.span is not None:
            return f"{self.span[0]:g} to {self.span[1]:g}"
        return f"one of {', '.join(self.choices)}" if self.choices else ""


LOG_LEVELS = ("debug", "info", "warn", "error", "fatal")
LOG_LEVEL = Parameter("info", "Lowest level of messages in the log.", choices=LOG_LEVELS)


def read_overrides(node_name: str, args: Sequence[str] | None = None) -> dict[str, Any]:
    # as the ROS arguments of the process, or only ``args``, set them; by a temporary node
    probe = Node(
        node_name,
        cli_args=args,
        use_global_arguments=args is None,
        start_parameter_services=False,
        enable_rosout=False,
        automatically_declare_parameters_from_overrides=True,
    )
    try:
        parameters = probe.get_parameters_by_prefix("")
        return {name: parameter.value for name, parameter in parameters.items()}
    finally:
        probe.destroy_node()


def read_parameters(
    node_name: str, parameters: Mapping[str, Parameter], given: Mapping[str, object]
) -> dict[str, Any]:
    """Return all values; ``given`` replaces defaults, and the ROS arguments replace both."""
    named = {name: value for name, value in given.items() if value} | read_overrides(node_name)
    return {
        name: each.value(name, named.get(name, each.default)) for name, each in parameters.items()
    }


def declare(node: Node, parameters: Mapping[str, Parameter], values: Mapping[str, Any]) -> None:
    for name, each in parameters.items():
        described = ParameterDescriptor(
            description=each.description,
            additional_constraints=each.limits,
            read_only=True,  # because a later change would have no effect
        )
        node.declare_parameter(name, values[name], described, ignore_override=True)


# ---- the parameters of the reference's node, and warnings about those without effect ----
#
# A fleet may start our node with the parameter file of the reference's node. The file calls that
# node ``application_manager``. Our node takes the action's name from the file. Brokers, topics,
# namespaces and the image registry come from the state repo. If the file names one that the state
# repo lacks, the node warns. The node also warns about parameters that it replaces by other means.

ACTION_NAME = "deployment_action_name"
_RENAMES = re.compile(r".*__(node|name):=.*")
_BROKER = re.compile(r"connections\.communication_broker(_params\.(?P<node>.+))?\.host")

_TOPICS = "connections.init_comm_topics"

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
    values = read_overrides("application_manager", args)
    for name, value in values.items():
        if name in (ACTION_NAME, "namespace", "k3d_image_registry") or _BROKER.fullmatch(name):
            read = ros_name_or_none if name == ACTION_NAME else text
            values[name] = Parameter("", "", read=read).value(name, value)
    topics = values.get(_TOPICS) or []
    if not isinstance(topics, list) or not all(isinstance(topic, str) for topic in topics):
        raise click.UsageError(f"parameter {_TOPICS} is {topics!r}; it takes a list of texts")
    return values


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
            "names that they have in that registry (docs/reference.md)"
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
    topics = values.get(_TOPICS) or ()
    bridged = {
        topic for node in config.kinds.values() for to in node.bridged.values() for topic in to
    }
    if missing := [topic for topic in topics if topic not in bridged]:
        yield (
            "parameter connections.init_comm_topics of the reference is not used: add "
            f"{', '.join(missing)} to the field 'bridged' of the source node in "
            f"{config.place_of(NODES_FILE)}"
        )


# ---- the parameters of the node that takes demands ----

PARAMETERS = {
    "action_name": Parameter(
        settings.DEFAULT_ACTION_NAME,
        "Name of the action DeploymentRequest, which the reference's clients use.",
        read=ros_name,
    ),
    "demand_action_name": Parameter(
        settings.DEFAULT_DEMAND_ACTION_NAME, "Name of the action Demand.", read=ros_name
    ),
    "answer": Parameter(
        ANSWER_LEVELS[0], "When a DeploymentRequest is answered.", choices=ANSWER_LEVELS
    ),
    "answer_timeout": Parameter(
        120.0,
        "How many seconds a goal may take to be reconciled or healthy.",
        span=(0.001, 86_400.0),
    ),
    "deployment_request_ids": Parameter(
        "use",
        "Whether the id of a DeploymentRequest tells apart what is demanded; ignored, all are "
        "booked under one id.",
        choices=("use", "ignore"),
    ),
    "state_repo": Parameter("", "Folder or URL of the state repo."),
    "fetch_interval": Parameter(
        DEFAULT_INTERVAL,
        "How often people's commits are fetched while no demand comes; 0 means no fetches at an "
        "interval.",
        read=duration,
    ),
    "requester_queue_limit": Parameter(
        settings.REQUESTER_QUEUE_LIMIT,
        "How many demands of one requester may be without an answer; more are rejected.",
        span=(1, settings.QUEUE_LIMIT),
    ),
    "log_level": LOG_LEVEL,
}


def read_node_parameters(given: Mapping[str, object]) -> dict[str, Any]:
    values = read_parameters("demandops", PARAMETERS, given)
    if not values["state_repo"]:
        raise click.UsageError(
            "no state repo given; use --state-repo URL_OR_DIR, DEMANDOPS_STATE_REPO or the ROS "
            "parameter state_repo"
        )
    names = ("action_name", "demand_action_name")
    if len({expand_topic_name(values[name], "demandops", "/") for name in names}) == 1:
        raise click.UsageError(
            f"the parameters {' and '.join(names)} are both {values['action_name']}; give each "
            "action a name of its own"
        )
    return values
