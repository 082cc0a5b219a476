"""The connection types: look one up by its name or number, or choose the first that fits."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Literal

from pydantic import PlainValidator
from pydantic_core import PydanticKnownError

from demandops.base.errors import Fault, fault, sentences
from demandops.base.naming import topic_problem
from demandops.connections.connection import UNSUPPORTED, Connection, ConnectionType
from demandops.connections.mqtt import MQTT
from demandops.connections.ros import ROS
from demandops.connections.zenoh import ZENOH
from demandops.model.config.config import IMAGES_FILE, NODES_FILE, Config

# All connection types, in the order of the automatic choice. The ledger records the choice, so a
# later change of the inventory does not change the type of a connection.
CONNECTION_TYPES: tuple[ConnectionType, ...] = (ZENOH, MQTT, ROS)


def type_numbered(number: int) -> ConnectionType | None:
    return next((kind for kind in CONNECTION_TYPES if kind.number == number), None)


def type_named(word: str) -> ConnectionType:
    return {kind.word: kind for kind in CONNECTION_TYPES}[word]


def listed(types: Iterable[ConnectionType]) -> str:  # `MQTT or ROS`
    return " or ".join(kind.name for kind in types)


def by_number() -> list[ConnectionType]:
    return sorted(CONNECTION_TYPES, key=lambda kind: kind.number)


def type_word(*before: str, after: tuple[str, ...] = ()) -> PlainValidator:
    """Return the validator of a field that accepts the words of all types, and a few others."""

    def words() -> tuple[str, ...]:  # of all types at the time of the check
        return (*before, *(kind.word for kind in by_number()), *after)

    def check(value: object) -> object:
        if value in words():
            return value
        *most, last = map(repr, words())
        raise PydanticKnownError("literal_error", {"expected": f"{', '.join(most)} or {last}"})

    return PlainValidator(check, json_schema_input_type=Literal.__getitem__(words()))


# Every type supports these options
_ALWAYS = ("type", "reverse")


def choose_type(connection: Connection, config: Config) -> ConnectionType | None:
    fitting = (kind for kind in CONNECTION_TYPES if not any(type_faults(kind, connection, config)))
    return next(fitting, None)


def no_type_fault(connection: Connection, config: Config) -> Fault:
    reasons = []
    for kind in CONNECTION_TYPES:
        reason = next(type_faults(kind, connection, config))
        field = "" if reason.field in ("type", "broker") else f"{reason.field} "
        text = f"{field}{reason.message}"
        reasons.append(text if text.startswith(kind.name) else f"{kind.name}: {text}")
    message = f"no connection type is given, and none fits. {sentences(reasons)}"
    return fault("type", message, code=UNSUPPORTED)


def type_faults(kind: ConnectionType, connection: Connection, config: Config) -> Iterator[Fault]:
    ends = {"source": connection.source, "target": connection.target}
    are_known = all(
        node in config.nodes for node in ends.values()
    )  # the admission reports unknown nodes
    if kind.image not in config.images:
        message = f"{kind.name} needs an image '{kind.image}'; add it to "
        message += config.place_of(IMAGES_FILE)
        yield fault("type", message, code=UNSUPPORTED)
    if connection.broker and not kind.takes_broker:
        yield broker_fault("broker", kind)
    if kind.speaks_dds and are_known:
        for end, node in ends.items():
            if config.nodes[node].ros.rmw == "rmw_zenoh_cpp":
                able = listed(other for other in CONNECTION_TYPES if not other.speaks_dds)
                message = (
                    f"'{node}' runs rmw_zenoh_cpp, but type {kind.name} needs DDS; use type "
                    f"{able}, or another rmw in {config.file_of(NODES_FILE, node)}"
                )
                yield fault(end, message, code=UNSUPPORTED)
    yield from kind.link_faults(connection, config) if are_known else ()
    yield from route_faults(kind, connection, config)


def broker_fault(field: str, kind: ConnectionType) -> Fault:
    able = listed(other for other in CONNECTION_TYPES if other.takes_broker)
    message = f"a broker is for {able} only, but the type is {kind.name}; leave the broker out"
    return fault(field, message)


def route_faults(kind: ConnectionType, connection: Connection, config: Config) -> Iterator[Fault]:
    for index, route in enumerate(connection.topics):
        if topic_problem(route.source) or topic_problem(route.target):
            continue  # the checks of the request report this topic
        where = f"topics[{index}]"
        for name in route.options():
            if name not in _ALWAYS and name not in kind.options:
                able = listed(other for other in CONNECTION_TYPES if name in other.options)
                yield fault(
                    f"{where}.{name}",
                    f"{name} of '{route.source}' is not supported by {kind.name}; leave it out, or "
                    f"use type {able}",
                )
        yield from kind.route_faults(where, route, connection.key_of(route).sender, config)
        if route.source != route.target and not kind.renames:
            able = listed(other for other in CONNECTION_TYPES if other.renames)
            yield fault(
                f"{where}.target",
                f"'{route.source}' cannot become '{route.target}', because {kind.name} keeps the "
                f"name of a topic; use the same name at both ends, or use type {able}",
            )
