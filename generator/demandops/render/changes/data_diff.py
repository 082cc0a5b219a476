"""Differences between two pieces of plain data: by leaf, or as a JSON merge patch. Pure."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from demandops import strict_yaml

ABSENT = object()
"""Marks a missing value."""


def leaf_differences(old: Any, new: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:  # noqa: ANN401
    """Yield (path, old, new) of the smallest parts that differ.

    A path looks like ``spec.values.image.tag``. A missing value is :data:`ABSENT`.
    """
    if isinstance(old, dict) and isinstance(new, dict):
        for key in dict.fromkeys([*old, *new]):
            inner = f"{path}.{key}" if path else str(key)
            yield from leaf_differences(old.get(key, ABSENT), new.get(key, ABSENT), inner)
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for index, (left, right) in enumerate(zip(old, new, strict=True)):
            yield from leaf_differences(left, right, f"{path}[{index}]")
    elif type(old) is not type(new) or old != new:
        yield path, old, new


def merge_patch(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    """Return the JSON merge patch (RFC 7386) that turns ``old`` into ``new``; null removes."""
    patch: dict[str, Any] = {key: None for key in old if key not in new}
    for key, value in new.items():
        old_value = old.get(key, ABSENT)
        if isinstance(old_value, dict) and isinstance(value, dict):
            inner = merge_patch(old_value, value)
            if inner:
                patch[key] = inner
        elif next(leaf_differences(old_value, value), None) is not None:
            patch[key] = value
    return patch


def short_value(value: object) -> str:
    """Return a value in few words, for a person."""
    return "none" if value is ABSENT else strict_yaml.short_repr(value)
