"""``demandops parameter-sync``: keep a ROS node's parameters equal to those in a ConfigMap."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import click
from demandops.cluster.config_map_watch import ConfigMapWatch
from demandops.errors import DemandOpsError, InvalidInput
from demandops.quoting import one_line
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from demandops_ros import ros_process
from demandops_ros.parameter_sync.parameter_file import parameters_of
from demandops_ros.parameter_sync.parameter_setter import ParameterSetter

# The parameters and their defaults. The names are those of the reference's k8s_configmap_watcher,
# without its `period`, because a watch does not poll.
_PARAMETERS = {
    "configmap_name": "",
    "namespace": "",
    "ros_params_file_name": "params.yml",
    "target_ros_node": "",
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
    with (
        ros_process.stop_signals() as wait_for_signal,
        ros_process.started(ctx.args, SignalHandlerOptions.NO),
    ):
        node = Node("parameter_sync")
        ros_process.log_to(get_logger("demandops"), "info")
        given: dict[str, str] = {
            name: node.declare_parameter(name, default).value
            for name, default in _PARAMETERS.items()
        }
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
        wait_for_signal()
        # the watch first, because it calls the node
        watch.close()
        thread.close()
        node.destroy_node()
