"""The form of a goal: what of plain data fits a model, and every fault of what does not.

A field of the wrong form is left out and the rest is taken all the same, so that faults of form
and of content are told together.
"""

from __future__ import annotations

from collections.abc import Container
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from demandops import strict_yaml
from demandops.config.base_model import faults_of, field_path
from demandops.errors import Fault, fault

_DEEPEST = 100
"""Levels of a goal, as many as of one in YAML."""

Goal = TypeVar("Goal", bound=BaseModel)


def parse_valid_part(
    data: dict[str, Any], model: type[Goal], lists_of_text: Container[str]
) -> tuple[Goal, list[Fault]]:
    """Return what of ``data`` has the form of ``model``, and the faults of the rest.

    Args:
        data: the goal as it came.
        model: one whose every field has a default.
        lists_of_text: its fields that are lists of text.
    """
    faults: list[Fault] = []
    pruned = _with_keys_of_text(data, (), faults)
    try:
        return model.model_validate(pruned), faults
    except ValidationError as error:
        faults += faults_of(error, model)
        for item in error.errors():
            pruned = _blanked(pruned, item["loc"], lists_of_text)
        return model.model_validate(pruned), faults


def _with_keys_of_text(
    data: object, location: tuple[int | str, ...], faults: list[Fault]
) -> object:
    """Return ``data`` without the entries whose key is no text, which are told."""
    if len(location) > _DEEPEST and isinstance(data, dict | list):
        message = f"is nested deeper than {_DEEPEST} levels; make it flatter"
        faults.append(fault(field_path(location[:2]), message))
        return None
    if isinstance(data, list):
        return [_with_keys_of_text(item, (*location, i), faults) for i, item in enumerate(data)]
    if not isinstance(data, dict):
        return data
    kept = {}
    for key, value in data.items():
        if isinstance(key, str):
            kept[key] = _with_keys_of_text(value, (*location, key), faults)
        else:
            message = f"the key {strict_yaml.short_repr(key)} must be text; put it in quotes"
            faults.append(fault(field_path(location), message))
    return kept


def _blanked(
    data: object,
    location: tuple[int | str, ...],
    lists_of_text: Container[str],
    within: str = "",
) -> object:
    """Return ``data`` without what stands at ``location``.

    A field goes, so that its default holds; a list's item becomes an empty one, so that those
    behind it keep their places.
    """
    if not location:  # the whole of it, as for a key that is no Unicode text
        return {}
    head, *rest = location
    if isinstance(data, list) and isinstance(head, int):
        empty: object = "" if within in lists_of_text else {}
        item = _blanked(data[head], tuple(rest), lists_of_text, within) if rest else empty
        return [*data[:head], item, *data[head + 1 :]]
    if isinstance(data, dict):
        if rest and head in data:
            return {**data, head: _blanked(data[head], tuple(rest), lists_of_text, str(head))}
        return {key: value for key, value in data.items() if key != head}
    return data
