"""Sets the parameters of another node, and sets them again after that node restarts.

A restarted node publishes its parameter events at a new endpoint, which the ROS graph shows.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from demandops.quoting import one_line, quoted
from demandops.runtime import REAL
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter

_LOOK_S = 0.2
_ANSWER_S = 2.0
_EVENTS = "/parameter_events"
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
        node.create_timer(_LOOK_S, self._set_if_needed)

    def want(self, parameters: Mapping[str, Any]) -> None:
        """Replace the parameters that the target must have; any thread may call this method.

        A value that ROS cannot carry raises TypeError or ValueError, which names the parameter.
        """
        wanted = [_parameter(name, value).to_parameter_msg() for name, value in parameters.items()]
        with self._lock:
            self._wanted, self._version = wanted, self._version + 1
        self._changed.trigger()

    def _set_if_needed(self) -> None:
        # A restarted target has new endpoints. The ROS graph may still list the endpoint of one
        # that was killed, so all of them are compared.
        endpoints = frozenset(
            tuple(info.endpoint_gid)
            for info in self._node.get_publishers_info_by_topic(_EVENTS)
            if f"{info.node_namespace.rstrip('/')}/{info.node_name}" == self._target
        )
        with self._lock:
            wanted, version = self._wanted, self._version
        if self._call is not None:
            if REAL.monotonic() - self._called_at < _ANSWER_S:
                return
            self._client.remove_pending_request(self._call)  # the target ended without an answer
            self._call = None
        is_set = self._set == (endpoints, version)
        if version == 0 or not endpoints or is_set or not self._client.service_is_ready():
            return
        self._called_at = REAL.monotonic()
        self._call = self._client.call_async(SetParameters.Request(parameters=wanted))
        self._call.add_done_callback(
            lambda call: self._take_answer(call, (endpoints, version), wanted)
        )

    def _take_answer(self, call: Any, state: tuple[Any, int], wanted: list[Any]) -> None:  # noqa: ANN401
        if call is not self._call or call.exception() is not None:
            return
        self._call, self._set = None, state
        names = [parameter.name for parameter in wanted]
        refused = [
            f"{name}: {result.reason or 'no reason given'}"
            for name, result in zip(names, call.result().results, strict=False)
            if not result.successful
        ]
        for line in refused:
            self._node.get_logger().error(one_line(f"{self._target} refused {line}"))
        self._node.get_logger().info(
            f"set {len(names) - len(refused)} parameters of {self._target}"
        )
        self._changed.trigger()  # other parameters may be wanted by now


def _parameter(name: str, value: Any) -> Parameter:  # noqa: ANN401
    for number in value if isinstance(value, list) else [value]:
        if isinstance(number, int) and not -_LARGEST - 1 <= number <= _LARGEST:
            raise ValueError(
                f"parameter {name}: {quoted(str(number))} is out of ROS's range; write a number "
                f"between {-_LARGEST - 1} and {_LARGEST}"
            )
    try:
        return Parameter(name, value=value)
    except (TypeError, ValueError) as error:
        raise type(error)(f"parameter {name}: {error}") from None
