"""The connection types: look one up by its name or number."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

from pydantic import PlainValidator
from pydantic_core import PydanticKnownError

from demandops.connections.connection_type import ConnectionType
from demandops.connections.mqtt import MQTT
from demandops.connections.ros import ROS
from demandops.connections.zenoh import ZENOH

CONNECTION_TYPES: tuple[ConnectionType, ...] = (ZENOH, MQTT, ROS)
"""All connection types, in the order of the automatic choice."""


def type_numbered(number: int) -> ConnectionType | None:
    """Return the type with a number in ``DeploymentRequest``, or ``None``."""
    return next((known for known in CONNECTION_TYPES if known.number == number), None)


def type_named(word: str) -> ConnectionType:
    """Return the type that files call ``word``; raises :class:`KeyError`."""
    return {known.word: known for known in CONNECTION_TYPES}[word]


def labels(types: Iterable[ConnectionType]) -> str:
    """Return types as a message lists them: ``1 (MQTT) or 0 (ROS)``."""
    return " or ".join(known.label for known in types)


def by_number() -> list[ConnectionType]:
    """Return all types, sorted by number."""
    return sorted(CONNECTION_TYPES, key=lambda known: known.number)


def type_word(*before: str, after: tuple[str, ...] = ()) -> PlainValidator:
    """Return the validator of a field that accepts the types' words and the given words."""

    def words() -> tuple[str, ...]:
        return (*before, *(known.word for known in by_number()), *after)

    def known_word(value: object) -> object:
        if value in words():
            return value
        *most, last = map(repr, words())
        raise PydanticKnownError("literal_error", {"expected": f"{', '.join(most)} or {last}"})

    return PlainValidator(known_word, json_schema_input_type=Literal.__getitem__(words()))
