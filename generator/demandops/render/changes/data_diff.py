"""What differs between two pieces of plain data: leaf by leaf, or as a JSON merge patch. Pure."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

ABSENT = object()
"""Stands for a value that is not there."""


def leaf_differences(old: Any, new: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:  # noqa: ANN401
    """Yield (path, old, new) of the smallest parts that differ, as ``spec.values.image.tag``."""
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
    """Return the JSON merge patch (RFC 7386) that makes ``old`` into ``new``; null removes."""
    patch: dict[str, Any] = {key: None for key in old if key not in new}
    for key, value in new.items():
        was = old.get(key, ABSENT)
        if isinstance(was, dict) and isinstance(value, dict):
            inner = merge_patch(was, value)
            if inner:
                patch[key] = inner
        elif next(leaf_differences(was, value), None) is not None:
            patch[key] = value
    return patch
