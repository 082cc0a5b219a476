"""Reads the parameters of a node from the text of a ROS parameter file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from demandops import strict_yaml
from demandops.errors import InvalidInput, fault

_EVERY_NODE = ("/**", "**", "/*", "*")
_SECTION = "ros__parameters"


def parameters_of(node: str, text: str, file: str) -> dict[str, Any]:
    """Return a node's parameters by dotted name; its own section overrides that for all nodes."""
    data = strict_yaml.load(text, file)
    if not isinstance(data, dict):
        raise InvalidInput([fault("", "must map nodes to their parameters").within(file)])
    name = node.lstrip("/")
    parameters: dict[str, Any] = {}
    for key in (*_EVERY_NODE, f"/{name}", name):
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
