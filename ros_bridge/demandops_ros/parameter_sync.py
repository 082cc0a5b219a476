"""``demandops parameter-sync``: keeps a ROS node's parameters equal to those in a ConfigMap."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import click
from demandops.base import strict_yaml
from demandops.base.errors import DemandOpsError, InvalidInput, fault
from demandops.base.quoting import one_line, quoted
from demandops.base.runtime import REAL
from demandops.cluster.watches import ConfigMapWatch
from rcl_interfaces.srv import SetParameters
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.parameter import Parameter

from demandops_ros import node_parameters, ros_process
from demandops_ros.node_parameters import read_parameters, ros_name_or_none

# ---- the text of a ROS parameter file ----

_SECTION = "ros__parameters"


def parameters_of(node: str, text: str, file: str) -> dict[str, Any]:
    """Return a node's parameters by dotted name; its own section overrides that for all nodes."""
    data = strict_yaml.load(text, file)
    if not isinstance(data, dict):
        raise InvalidInput([fault("", "must map nodes to their parameters").within(file)])
    name = node.lstrip("/")
    parameters: dict[str, Any] = {}
    for key in ("/**", "**", "/*", "*", f"/{name}", name):
        if key in data:
            section = data[key].get(_SECTION) if isinstance(data[key], dict) else None
            if not isinstance(section, dict):
                raise InvalidInput([fault(f"{key}.{_SECTION}", "must be a mapping").within(file)])
            parameters.update(_flat(section))
    if not parameters:
        problem = f"has no parameters of the node; write {name}: {{{_SECTION}: …}}"
        raise InvalidInput([fault(name, problem).within(file)])
    return parameters


def _flat(section: Mapping[Any, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in section.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


# ---- the parameters of another node, set again after that node restarts ----
#
# A restarted node publishes its parameter events at a new endpoint, which the ROS graph shows.

_LARGEST = 2**63 - 1  # the largest integer that ROS can transport


class ParameterSetter:
    """Sets the parameters of the node ``target`` to those of the last call of :meth:`want`."""

    def __init__(self, node: Node, target: str) -> None:
        self._node = node
        self._client = node.create_client(SetParameters, f"{target}/set_parameters")
        self._target = str(node.resolve_service_name(target))
        self._lock = REAL.lock()
        self._wanted: list[Any] = []
        self._version = 0
        # the target's endpoints when parameters were last set, and the version of these parameters
        self._set: tuple[Any, int] | None = None
        self._call: Any = None
        self._called_at = 0.0
        self._changed = node.create_guard_condition(self._set_if_needed)
        node.create_timer(0.2, self._set_if_needed)

    def want(self, parameters: Mapping[str, Any]) -> None:
        # any thread may call this; TypeError or ValueError names a value that ROS cannot carry
        wanted = []
        for name, value in parameters.items():
            for number in value if isinstance(value, list) else [value]:
                if isinstance(number, int) and not -_LARGEST - 1 <= number <= _LARGEST:
                    raise ValueError(
                        f"parameter {name}: {quoted(str(number))} is out of ROS's range; write a "
                        f"number between {-_LARGEST - 1} and {_LARGEST}"
                    )
            try:
                parameter = Parameter(name, value=value)
            except (TypeError, ValueError) as error:
                raise type(error)(f"parameter {name}: {error}") from None
            wanted.append(parameter.to_parameter_msg())
        with self._lock:
            self._wanted, self._version = wanted, self._version + 1
        self._changed.trigger()

    def _set_if_needed(self) -> None:
        # A restarted target has new endpoints. The ROS graph may still list the endpoint of one
        # that was killed, so all of them are compared.
        endpoints = frozenset(
            tuple(info.endpoint_gid)
            for info in self._node.get_publishers_info_by_topic("/parameter_events")
            if f"{info.node_namespace.rstrip('/')}/{info.node_name}" == self._target
        )
        with self._lock:
            wanted, version = self._wanted, self._version
        if self._call is not None:
            if REAL.monotonic() - self._called_at < 2.0:
                return
            self._client.remove_pending_request(self._call)  # the target ended without an answer
            self._call = None
        is_set = self._set == (endpoints, version)
        if version == 0 or not endpoints or is_set or not self._client.service_is_ready():
            return
        self._called_at = REAL.monotonic()
        self._call = self._client.call_async(SetParameters.Request(parameters=wanted))

        def take_answer(call: Any) -> None:  # noqa: ANN401
            if call is not self._call or call.exception() is not None:
                return
            self._call, self._set = None, (endpoints, version)
            names, logger = [parameter.name for parameter in wanted], self._node.get_logger()
            refused = [
                f"{name}: {result.reason or 'no reason given'}"
                for name, result in zip(names, call.result().results, strict=False)
                if not result.successful
            ]
            for line in refused:
                logger.error(one_line(f"{self._target} refused {line}"))
            logger.info(f"set {len(names) - len(refused)} parameters of {self._target}")
            self._changed.trigger()  # other parameters may be wanted by now

        self._call.add_done_callback(take_answer)


# ---- the command ----

# The names are those of the reference's k8s_configmap_watcher, without its `period`, because a
# watch does not poll.
_PARAMETERS = {
    "configmap_name": node_parameters.Parameter("", "Name of the ConfigMap."),
    "namespace": node_parameters.Parameter("", "Namespace of the ConfigMap."),
    "ros_params_file_name": node_parameters.Parameter("params.yml", "The key in the ConfigMap."),
    "target_ros_node": node_parameters.Parameter(
        "", "The node whose parameters are set.", read=ros_name_or_none
    ),
}


@click.command(context_settings={"ignore_unknown_options": True, "allow_extra_args": True})
@click.option(
    "--kubeconfig",
    envvar="KUBECONFIG",
    type=click.Path(path_type=Path, dir_okay=False, exists=True),
    metavar="FILE",
    help="How to reach the cluster; default: with the account of the pod that the command runs in "
    "[env: KUBECONFIG].",
)
@click.pass_context
def parameter_sync(ctx: click.Context, kubeconfig: Path | None) -> None:
    """Keep a ROS node's parameters equal to those in a ConfigMap.

    The ConfigMap holds a ROS parameter file. The command sets the parameters of the running node
    when the ConfigMap changes, and when the node starts again. Everything after --ros-args goes
    to ROS. The ROS parameters are those of the reference's k8s_configmap_watcher: configmap_name,
    namespace, ros_params_file_name (the key in the ConfigMap; default params.yml) and
    target_ros_node. Stop the command with Ctrl-C or SIGTERM.

    \b
    Examples:
      demandops parameter-sync --ros-args --params-file fusion.yaml
    """
    with ros_process.StopSignals() as signals, ros_process.started(ctx.args):
        given = read_parameters("parameter_sync", _PARAMETERS, {})
        node = Node("parameter_sync")
        node_parameters.declare(node, _PARAMETERS, given)
        ros_process.log_to(get_logger("demandops"), "info")
        for name, value in given.items():
            if not value:
                raise click.UsageError(
                    f"parameter {name} is not set; use --ros-args -p {name}:=VALUE"
                )
        target, key = given["target_ros_node"], given["ros_params_file_name"]
        file = f"ConfigMap {given['namespace']}/{given['configmap_name']} {key}"
        setter = ParameterSetter(node, target)

        def take(data: Mapping[str, str]) -> None:
            try:
                if key not in data:
                    raise InvalidInput.at("", "is missing; add it to the ConfigMap", file=file)
                setter.want(parameters_of(target, data[key], file))
            except (DemandOpsError, TypeError, ValueError) as error:
                node.get_logger().error(one_line(f"{error}; {target} keeps its parameters"))

        watch = ConfigMapWatch(given["namespace"], given["configmap_name"], take, kubeconfig)
        thread = ros_process.ExecutorThread(node)
        signals.wait()
        # the watch first, because it calls the node
        watch.close()
        thread.close()
        node.destroy_node()
