"""Properties of nodes: typed values in the inventory, and the conditions of ``place`` on them.

The value of a property is a number, text, true or false. A condition is a text: ``ros=jazzy``,
``memoryGiB>=8`` or ``memoryGiB<=64``. A property has values of the same type on all nodes. This
type decides how the generator reads the value in a condition.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import AfterValidator, StringConstraints, WithJsonSchema

from demandops import strict_yaml
from demandops.quoting import quoted

_NAME = "[a-z][A-Za-z0-9_]*"
_TEXT = re.compile(r"[A-Za-z0-9]([A-Za-z0-9 ._+:/-]{0,61}[A-Za-z0-9])?")
_CONDITION = re.compile(rf"({_NAME})(>=|<=|=)(.+)")
_BOUNDS = {"min": ">=", "max": "<="}

# The name of a property; it includes the unit of the value, as in `memoryGiB`
PropertyName = Annotated[str, StringConstraints(pattern=f"^{_NAME}$", max_length=63)]

# The type of a property's values, in words
Kind = Literal["a number", "text", "true or false"]


class PropertyCondition(NamedTuple):
    name: str
    sign: str
    value: str


def kind_of(value: object) -> Kind | None:
    """Return the type of a property's value; ``None`` if no property may have this value."""
    match value:
        case bool():
            return "true or false"
        case int() | float():
            return "a number" if _number(value) is not None else None
        case str() if _TEXT.fullmatch(value):
            return "text"
    return None


def _value(value: object) -> object:
    if kind_of(value) is None:
        shown = strict_yaml.short_repr(value)
        raise ValueError(f"is {shown}; give a number, true, false, or a short plain text")
    return value


def _required_value(value: object) -> object:
    if not isinstance(value, dict):
        return _value(value)
    bounds = {*map(str, value)}
    if not bounds or bounds - _BOUNDS.keys():
        raise ValueError("give min, max or both, or a plain value")
    for bound in value.values():
        if kind_of(bound) != "a number":
            shown = strict_yaml.short_repr(bound)
            raise ValueError(f"has {shown} as a bound; give a number")
    if len(bounds) == 2 and value["min"] > value["max"]:
        raise ValueError("has a min above its max; lower min or raise max")
    return value


_PLAIN: list[dict[str, Any]] = [{"type": name} for name in ("number", "string", "boolean")]
_LIMITS: dict[str, Any] = {
    "title": "Bounds",
    "type": "object",
    "properties": {bound: {"type": "number"} for bound in _BOUNDS},
    "additionalProperties": False,
    "minProperties": 1,
}
PropertyValue = Annotated[Any, AfterValidator(_value), WithJsonSchema({"anyOf": _PLAIN})]
# The value that a definition requires of a property; for a number also bounds: `{min: 8}`
RequiredValue = Annotated[
    Any, AfterValidator(_required_value), WithJsonSchema({"anyOf": [*_PLAIN, _LIMITS]})
]


def condition_texts(properties: Mapping[str, object]) -> Iterator[str]:
    """Yield the conditions in a definition's ``properties`` as texts, like ``memoryGiB>=8``."""
    for name, value in properties.items():
        if isinstance(value, dict):
            yield from (f"{name}{_BOUNDS[bound]}{limit}" for bound, limit in value.items())
        else:
            yield f"{name}={str(value).lower() if isinstance(value, bool) else value}"


def comparable_kind(value: object) -> Kind | None:
    """Return the type that a property needs to be compared with a required value."""
    return "a number" if isinstance(value, dict) else kind_of(value)


@lru_cache(maxsize=1024)
def read_condition(text: str) -> PropertyCondition | None:
    match = _CONDITION.fullmatch(text)
    condition = PropertyCondition(*match.groups()) if match else None
    if condition and condition.sign != "=" and _number(condition.value) is None:
        return None
    return condition


def condition_problem(condition: PropertyCondition, kind: Kind) -> str:
    """Return why a condition does not fit a property of the type ``kind``; empty if it fits."""
    if _value_as(kind, condition) is not None:
        return ""
    return f"{quoted(condition.name)} is {kind}; ask for {_EXAMPLES[kind].format(condition.name)}"


_EXAMPLES: dict[Kind, str] = {
    "a number": "{0}=8, {0}>=8 or {0}<=8",
    "text": "{0}=word",
    "true or false": "{0}=true or {0}=false",
}


def meets_condition(properties: Mapping[str, object], text: str) -> bool:
    """Return whether a node with these properties meets the condition in ``text``."""
    condition = read_condition(text)
    value = properties.get(condition.name) if condition else None
    kind = kind_of(value)
    required = _value_as(kind, condition) if condition and kind else None
    if required is None or condition is None:
        return False
    match condition.sign:
        case ">=":
            return bool(value >= required)  # type: ignore[operator]  # both are numbers
        case "<=":
            return bool(value <= required)  # type: ignore[operator]
    return value == required


def _value_as(kind: Kind, condition: PropertyCondition) -> object:
    """Return a condition's value, read as ``kind``, or ``None`` if the value has another type."""
    if kind == "a number":
        return _number(condition.value)
    if condition.sign != "=":
        return None
    if kind == "text":
        return condition.value
    return {"true": True, "false": False}.get(condition.value)


def _number(value: str | float) -> float | None:
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None  # JSON, and so a chart, has no infinity
