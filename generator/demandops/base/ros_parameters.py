"""ROS parameters as YAML and JSON hold them: their dotted names, and what no node can have.

The values of a chart go through it before they are committed, and a parameter file before it is set
in a node. ROS's own reader tells little: of `{a.b: 1, a: {b: 2}}` it takes the last one, of `[[1]]`
the inner list, and `[null]` becomes the word.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from demandops.base.errors import Fault, InvalidInput, fault, field_path
from demandops.base.quoting import quoted
from demandops.base.strict_yaml import short_repr, to_json

_LARGEST = 2**63 - 1  # the largest integer that ROS can transport
_KINDS = ({bool}, {int}, {float}, {int, float}, {str})  # of the items of a list


def flat_parameters(section: Mapping[str, Any], place: str) -> dict[str, Any]:
    """Return a node's parameters that have a value, by dotted name.

    Null is no value. ``place`` is the field of ``section``; the faults of InvalidInput are below.
    """
    flat, faults = dict[str, Any](), list[Fault]()
    for path, value in _leaves(section, ()):
        name = ".".join(path)
        if not all(path) or "\0" in name:
            problem = "a parameter's name must not be empty, nor have the character NUL; rename it"
        elif name in flat:
            problem = f"the parameter {quoted(name)} is here twice, because dots nest; remove one"
        else:
            problem = _problem(value)
        if problem:
            faults.append(fault(field_path((place, *path)), problem))
        flat[name] = value
    if faults:
        raise InvalidInput(faults)
    return flat


def _leaves(section: Mapping[str, Any], above: tuple[str, ...]) -> Iterator[Any]:
    for key, value in section.items():
        if isinstance(value, dict):
            yield from _leaves(value, (*above, key))
        elif value is not None:
            yield (*above, key), value


def _problem(value: object) -> str:
    items: Iterable[Any] = value if isinstance(value, list) else [value]
    if {*map(type, items)} not in (set(), *_KINDS):
        return (
            f"{short_repr(value)} is no value of a ROS parameter; write a text, a number, true, "
            "false, or a list of only texts, only numbers, or only true and false"
        )
    for item in items:
        if isinstance(item, int) and not -_LARGEST - 1 <= item <= _LARGEST:
            return (
                f"{item} is out of ROS's range; write a number between {-_LARGEST - 1} and "
                f"{_LARGEST}"
            )
        if isinstance(item, str) and "\0" in item:
            return (
                f"{short_repr(item)} has the character NUL, which no ROS text can have; remove it"
            )
    return ""


LARGEST_EXACT = 2**53  # up to here, Helm and JSON keep each integer as it is


def exact_numbers(value: Any) -> Any:  # noqa: ANN401
    """Return parameters whose numbers keep their type and digits on the way to a node.

    Kubernetes and Helm have one kind of number: they write 10.0 as 10, and round large integers. So
    such a number becomes text, with the tag that YAML has for its type; the chart takes it apart.
    """
    if isinstance(value, dict):
        return {name: exact_numbers(each) for name, each in value.items()}
    if isinstance(value, list):
        is_mixed = {*map(type, value)} == {int, float}  # of which ROS makes doubles
        return [exact_numbers(float(each) if is_mixed else each) for each in value]
    if isinstance(value, float) and value.is_integer():
        return f"!!float {to_json(value)}"
    if type(value) is int and abs(value) > LARGEST_EXACT:
        return f"!!int {value}"
    return value
