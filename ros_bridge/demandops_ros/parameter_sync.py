"""``demandops parameter-sync``: keeps a ROS node's parameters equal to those in a ConfigMap."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import click
from demandops.base import strict_yaml
from demandops.base.errors import DemandOpsError, InvalidInput, fault
from demandops.base.quoting import one_line
from demandops.base.ros_parameters import flat_parameters
from demandops.base.runtime import REAL
from demandops.cluster.watches import ConfigMapWatch
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterEvent
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    SetParametersAtomically,
)
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message

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

    def is_for_the_node(key: str) -> bool:  # to ROS, `*` is one part of a name, `**` any number
        pattern = re.escape(f"/{key.strip('/')}").replace(r"/\*\*", "(/[^/]+)*")
        return re.fullmatch(pattern.replace(r"/\*", "/[^/]+"), f"/{name}") is not None

    keys = sorted(filter(is_for_the_node, data), key=lambda key: ("**" not in key, "*" not in key))
    if not keys:
        problem = f"has no parameters of the node; write {name}: {{{_SECTION}: …}}"
        raise InvalidInput([fault(name, problem).within(file)])
    parameters: dict[str, Any] = {}
    for key in keys:
        # a node whose parameters are all gone has nothing below the section's name
        section = data[key].get(_SECTION, "") if isinstance(data[key], dict) else ""
        place = f"{key}.{_SECTION}"
        try:
            if not isinstance(section, dict | None):
                raise InvalidInput.at(place, "must be a mapping")
            parameters.update(flat_parameters(section or {}, place))
        except InvalidInput as error:
            raise InvalidInput(strict_yaml.faults_in(error, file)) from None
    return parameters


# ---- the parameters of another node, set again after that node restarts ----
#
# A restarted node publishes its parameter events or its log at a new endpoint, which the ROS graph
# shows.

_KINDS = Parameter.Type
_INTEGERS = {_KINDS.INTEGER, _KINDS.INTEGER_ARRAY}
_DOUBLES = {_KINDS.DOUBLE, _KINDS.DOUBLE_ARRAY}
_LISTS = {_KINDS.BOOL_ARRAY, _KINDS.INTEGER_ARRAY, _KINDS.DOUBLE_ARRAY, _KINDS.STRING_ARRAY}
_ANSWER_S = 2.0  # a node that does not answer for so long has ended
# A node may refuse what it takes later, such as a lifecycle node that declares its parameters when
# it is configured.
_REFUSED_S = 5.0
# In the memory, the type of what a node declared without a value. It has nothing to go back to, and
# to unset it would take it from the node.
_NO_VALUE = 255


def as_the_node_has_it(name: str, value: Any, kind: int) -> Parameter:  # noqa: ANN401
    """Return a parameter with the type that the node has for it; ``kind`` 0 is an unknown one.

    A file does not tell all types: many programs write 10.0 as 10, and an empty list has none. It
    stands there as a list of one empty text, too, because ROS's own reader refuses an empty one.
    """
    if kind in _LISTS and (value == [] or (value == [""] and kind != _KINDS.STRING_ARRAY)):
        return Parameter(name, _KINDS(kind), [])
    items = value if isinstance(value, list) else [value]
    types = {*map(type, items)}
    number: type | None = None
    if types and types <= {int, float}:
        if kind in _INTEGERS and all(abs(item) < 2**63 and item % 1 == 0 for item in items):
            number = int
        elif kind in _DOUBLES or len(types) == 2:
            number = float
    if number:
        value = [*map(number, value)] if isinstance(value, list) else number(value)
    return Parameter(name, value=value)


class ParameterSetter:
    """Sets the parameters of the node ``target`` to those of the last call of :meth:`want`.

    The node takes all of them or none. A parameter that is wanted no more gets back what it had
    before it was set first, if that was a value. ``problem`` is why the node does not have them;
    empty if it has.
    """

    def __init__(
        self, node: Node, target: str, on_answer: Callable[[], None], state_file: Path
    ) -> None:
        self._node = node
        self._describe = node.create_client(DescribeParameters, f"{target}/describe_parameters")
        self._types = node.create_client(GetParameterTypes, f"{target}/get_parameter_types")
        self._get = node.create_client(GetParameters, f"{target}/get_parameters")
        self._set = node.create_client(
            SetParametersAtomically, f"{target}/set_parameters_atomically"
        )
        self._target = str(node.resolve_service_name(target))
        self._on_answer = on_answer
        self.problem = self._unanswered = f"{self._target} has not answered yet"
        self._lock = REAL.lock()
        self._wanted: Mapping[str, Any] = {}
        self._version = 0
        # What the node had before, as messages by name. A restarted node has it again. One that
        # runs on while only this process is restarted has not, so a file remembers it.
        self._before: dict[str, Any] = {}
        self._memory: Path | None = Path(f"{state_file}{self._target.replace('/', '.')}")
        if state_file.is_char_device():
            self._memory = None
        elif self._memory.exists():
            try:
                kept = deserialize_message(self._memory.read_bytes(), ParameterEvent)
                self._before = {each.name: each for each in kept.changed_parameters}
            except Exception as error:  # a power cut may leave it empty, and rclpy says so oddly
                told = f"{self._memory} is not used, as it cannot be read: {error}"
                node.get_logger().warning(one_line(told))
        # the target's endpoints when it last answered, and the version of these parameters
        self._answered: tuple[Any, int] | None = None
        self._call: tuple[Any, Any] | None = None  # the client, and the future of its answer
        self._called_at = self._answered_at = 0.0
        self._changed = node.create_guard_condition(self._set_if_needed)
        node.create_timer(0.2, self._set_if_needed)

    def want(self, parameters: Mapping[str, Any]) -> None:
        # any thread may call this
        with self._lock:
            self._wanted, self._version = parameters, self._version + 1
        self._changed.trigger()

    def _set_if_needed(self) -> None:
        # A restarted target has new endpoints. The ROS graph may still list the endpoint of one
        # that was killed, so all of them are compared.
        endpoints = frozenset[Any]()
        for topic in ("/parameter_events", "/rosout"):  # a node may publish only one of them
            endpoints = endpoints or frozenset(
                tuple(info.endpoint_gid)
                for info in self._node.get_publishers_info_by_topic(topic)
                if f"{info.node_namespace.rstrip('/')}/{info.node_name}" == self._target
            )
        with self._lock:
            wanted, version = self._wanted, self._version
        now, is_answered = REAL.monotonic(), self._answered == (endpoints, version)
        if not (is_answered or self.problem):  # a new version, or the node is gone or new
            self.problem = self._unanswered
            self._on_answer()
        if self._call is not None:
            if now - self._called_at < _ANSWER_S:
                return
            client, future = self._call
            client.remove_pending_request(future)
            self._call = None
        if is_answered and not (self.problem and now - self._answered_at >= _REFUSED_S):
            return
        clients = (self._describe, self._types, self._get, self._set)
        if version == 0 or not endpoints or not all(c.service_is_ready() for c in clients):
            return
        self._begin(wanted, (endpoints, version), is_new=not is_answered)

    def _begin(self, wanted: Mapping[str, Any], asked_at: tuple[Any, int], *, is_new: bool) -> None:
        # four calls, each after the answer of the one before
        before = self._before
        kinds = dict.fromkeys(wanted, 0)
        declared, hints = set[str](), list[str]()

        def take_descriptions(response: Any) -> None:  # noqa: ANN401
            # none at all if the node lacks one of the parameters, which it then refuses
            for name, described in zip(wanted, response.descriptors, strict=False):
                kinds[name] = described.type
                if described.type or described.dynamic_typing:
                    declared.add(name)
            if wanted and not response.descriptors:
                hints.append(f"it has not declared all of {', '.join(wanted)}")
            self._ask(self._types, GetParameterTypes.Request(names=[*wanted]), take_types)

        def take_types(response: Any) -> None:  # noqa: ANN401
            types = dict(zip(wanted, response.types, strict=False))
            kinds.update((name, kind) for name, kind in types.items() if kind)
            new = [name for name in types if name not in before]
            # only those with a value, because a node gives none at all if one has none
            asked = [name for name in new if types[name]]

            def take_values(response: Any) -> None:  # noqa: ANN401
                if len(response.values) == len(asked):
                    noted = {name: ParameterMessage(name=name) for name in new}
                    for name in declared & noted.keys():
                        noted[name].value.type = _NO_VALUE
                    for name, value in zip(asked, response.values, strict=True):
                        noted[name].value = value
                    self._remember(before | noted)
                parameters = [
                    as_the_node_has_it(name, value, kinds[name]) for name, value in wanted.items()
                ]
                hints.extend(
                    f"{each.name} is {_KINDS(kind).name} there, not {each.type_.name}"
                    for each in parameters
                    if (kind := kinds[each.name]) not in (0, each.type_.value)
                )
                given = [each.to_parameter_msg() for each in parameters]
                given += [
                    each
                    for name, each in before.items()
                    if name not in wanted and each.value.type != _NO_VALUE
                ]
                request = SetParametersAtomically.Request(parameters=given)
                self._ask(self._set, request, take_result)

            self._ask(self._get, GetParameters.Request(names=asked), take_values)

        def take_result(response: Any) -> None:  # noqa: ANN401
            result, problem = response.result, self.problem
            self._answered, self._answered_at = asked_at, REAL.monotonic()
            self.problem = ""
            if result.successful:
                self._remember({k: each for k, each in self._before.items() if k in wanted})
            else:
                self._remember(before)
                reason = "; ".join([result.reason or "no reason given", *hints])
                self.problem = one_line(f"{self._target} refused its parameters: {reason}")
            if self.problem and (self.problem != problem or is_new):
                self._node.get_logger().error(self.problem)
            elif not self.problem:
                self._node.get_logger().info(f"set {len(wanted)} parameters of {self._target}")
            self._on_answer()
            self._changed.trigger()  # other parameters may be wanted by now

        self._ask(self._describe, DescribeParameters.Request(names=[*wanted]), take_descriptions)

    def _remember(self, before: dict[str, Any]) -> None:
        if before != self._before and self._memory:
            kept = ParameterEvent(changed_parameters=[*before.values()])
            unfinished = Path(f"{self._memory}.new")
            unfinished.write_bytes(serialize_message(kept))
            unfinished.replace(self._memory)
        self._before = before

    def _ask(self, client: Any, request: Any, then: Callable[[Any], None]) -> None:  # noqa: ANN401
        future = client.call_async(request)
        self._call, self._called_at = (client, future), REAL.monotonic()

        def take(answer: Any) -> None:  # noqa: ANN401
            if self._call is not None and answer is self._call[1] and answer.exception() is None:
                self._call = None
                then(answer.result())

        future.add_done_callback(take)


# ---- the command ----


def _nodes(value: object) -> str:
    return ",".join(ros_name_or_none(name) for name in node_parameters.text(value).split(","))


# The first four are those of the reference's k8s_configmap_watcher, without its `period`, because a
# watch does not poll.
_PARAMETERS = {
    "configmap_name": node_parameters.Parameter("", "Name of the ConfigMap."),
    "namespace": node_parameters.Parameter("", "Namespace of the ConfigMap."),
    "ros_params_file_name": node_parameters.Parameter("params.yml", "The key in the ConfigMap."),
    "target_ros_node": node_parameters.Parameter(
        "", "The node whose parameters are set; several are separated by commas.", read=_nodes
    ),
    "state_file": node_parameters.Parameter(
        "/dev/null", "File that says `set`, or why the nodes do not have the parameters."
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
    """The ConfigMap holds a ROS parameter file. The command sets the parameters of the running node
    when the ConfigMap changes, and when the node starts again: all at once, or none if the node
    refuses one. Everything after --ros-args goes to ROS. The ROS parameters are those of the
    reference's k8s_configmap_watcher: configmap_name, namespace, ros_params_file_name (the key in
    the ConfigMap; default params.yml) and target_ros_node (several are separated by commas). A
    probe reads in the file state_file that they are `set`, or why not. Stop the command with Ctrl-C
    or SIGTERM.

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
        key, state_file = given["ros_params_file_name"], Path(given["state_file"])
        file = f"ConfigMap {given['namespace']}/{given['configmap_name']} {key}"
        unread = dict[str, str]()  # why a node's part of the file cannot be used
        telling = REAL.lock()  # two threads tell

        def tell() -> None:
            with telling:
                problems = [unread.get(name) or each.problem for name, each in setters.items()]
                state_file.write_text("; ".join(filter(None, problems)) or "set\n", "utf-8")

        setters = {
            name: ParameterSetter(node, name, tell, state_file)
            for name in given["target_ros_node"].split(",")
        }

        def take(data: Mapping[str, str]) -> None:
            for target, setter in setters.items():
                try:
                    if key not in data:
                        raise InvalidInput.at("", "is missing; add it to the ConfigMap", file=file)
                    setter.want(parameters_of(target, data[key], file))
                    unread.pop(target, None)
                except DemandOpsError as error:
                    unread[target] = one_line(f"{error}; {target} keeps its parameters")
                    node.get_logger().error(unread[target])
            tell()

        tell()
        watch = ConfigMapWatch(given["namespace"], given["configmap_name"], take, kubeconfig)
        thread = ros_process.ExecutorThread(node)
        signals.wait()
        # the watch first, because it calls the node
        watch.close()
        thread.close()
        node.destroy_node()
