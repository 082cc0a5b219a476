"""Reads the parameters of a node from the text of a ROS parameter file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from demandops import strict_yaml
from demandops.errors import InvalidInput, fault

_EVERY_NODE = ("/**", "**", "/*", "*")
_SECTION = "ros__parameters"


def parameters_of(node: str, text: str, file: str) -> dict[str, Any]:
    """Return a node's parameters by dotted name.

    The node's own section in the file overrides the section for all nodes.

    Args:
        node: the node's name, with or without a slash in front.
        text: the content of the file.
        file: the file's name, for messages.

    Raises:
        InvalidInput: if the file is no parameter file, or gives the node no parameters.
    """
    data = strict_yaml.load(text, file)
    if not isinstance(data, dict):
        raise InvalidInput([fault("", "must map nodes to their parameters").within(file)])
    name = node.lstrip("/")
    found: dict[str, Any] = {}
    for key in (*_EVERY_NODE, f"/{name}", name):
        if key in data:
            found.update(_section(data[key], key, file))
    if not found:
        problem = f"has no parameters of the node; write {name}: {{{_SECTION}: …}}"
        raise InvalidInput([fault(name, problem).within(file)])
    return found


def _section(value: object, key: str, file: str) -> Iterator[tuple[str, Any]]:
    section = value.get(_SECTION) if isinstance(value, dict) else None
    if not isinstance(section, dict):
        raise InvalidInput([fault(f"{key}.{_SECTION}", "must be a mapping").within(file)])
    return _flat(section)


def _flat(section: Mapping[Any, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in section.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
