"""The connection types: look one up by its name or number, or choose the first that fits."""

from __future__ import annotations

from typing import Literal

from pydantic import PlainValidator
from pydantic_core import PydanticKnownError

from demandops.connections.connection import ConnectionType
from demandops.connections.mqtt import MQTT
from demandops.connections.ros import ROS
from demandops.connections.zenoh import ZENOH

# All connection types, in the order of the automatic choice. The ledger records the choice, so a
# later change of the inventory does not change the type of a connection.
CONNECTION_TYPES: tuple[ConnectionType, ...] = (ZENOH, MQTT, ROS)


def type_named(word: str) -> ConnectionType:
    return {kind.word: kind for kind in CONNECTION_TYPES}[word]


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
