"""Reads the parameters of the reference's node, and warns about those that have no effect.

A fleet may start our node with the parameter file of the reference's node. The file calls that node
``application_manager``. Our node takes the action's name from the file. Brokers, topics, namespaces
and the image registry come from the state repo. If the file names one that the state repo lacks,
the node warns. The node also warns about parameters that it replaces by other means.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from demandops.config.config import BROKERS_FILE, DOMAINS_FILE, IMAGES_FILE, NODES_FILE, Config
from demandops.quoting import quoted
from rclpy.node import Node

_NODE = "application_manager"
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


def read(ros_args: Sequence[str]) -> dict[str, Any]:
    """Return the reference node's parameters, from ROS arguments and their parameter files."""
    # a rule that renames our node would rename the temporary one, and hide the file's section
    renames = {
        at
        for at, word in enumerate(ros_args)
        if _RENAMES.fullmatch(word) and ros_args[at - 1] in ("-r", "--remap")
    }
    args = [word for at, word in enumerate(ros_args) if not {at, at + 1} & renames]
    probe = Node(
        _NODE,
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
    """Yield a warning for each parameter in ``values`` that our node replaces by other means."""
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
    yield from _brokers(values, config)
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


def _brokers(values: Mapping[str, Any], config: Config) -> Iterator[str]:
    for name, host in values.items():
        match = _BROKER.fullmatch(name)
        if match is None:
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
