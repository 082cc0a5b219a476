"""Validation of the form of a goal: the valid part of plain data, and the faults.

Fields of the wrong form are left out, and the other fields are kept. So the caller can report
faults of form and of content together.
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from demandops import strict_yaml
from demandops.config.base_model import faults_of
from demandops.errors import MOST_FAULTS, Fault, Refused, fault, field_path

# how deeply a goal may be nested: as deeply as a YAML file of the state repo
_DEEPEST = 100

Goal = TypeVar("Goal", bound=BaseModel)


def parse_valid_part(
    data: dict[str, Any], model: type[Goal], lists_of_text: Container[str]
) -> tuple[Goal, list[Fault]]:
    """Return the part of ``data`` that has the form of ``model``, and a fault for each wrong part.

    The model has a default for every field; ``lists_of_text`` are those that are lists of text.

    Raises:
        Refused: with the first faults, if there are too many to look for others.
    """
    faults: list[Fault] = []
    pruned = _with_keys_of_text(data, (), faults)
    try:
        return model.model_validate(pruned), faults
    except ValidationError as error:
        if error.error_count() > MOST_FAULTS:  # so many only show a mistake in each item again
            raise Refused([*faults, *faults_of(error, model, most=MOST_FAULTS)]) from None
        faults += faults_of(error, model)
        for item in error.errors():
            pruned = _blank(pruned, item["loc"], lists_of_text)
        return model.model_validate(pruned), faults


def _with_keys_of_text(
    data: Any,  # noqa: ANN401 - plain data
    location: tuple[int | str, ...],
    faults: list[Fault],
) -> Any:  # noqa: ANN401
    """Return ``data`` without keys that are not Unicode text and without what is too deep."""
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
        if isinstance(key, str) and is_unicode(key):
            kept[key] = _with_keys_of_text(value, (*location, key), faults)
        else:
            remedy = "write whole characters" if isinstance(key, str) else "put it in quotes"
            message = f"the key {strict_yaml.short_repr(key)} must be text; {remedy}"
            faults.append(fault(field_path(location), message))
    return kept


def is_unicode(text: str) -> bool:
    # JSON can escape half of a surrogate pair, and no file in UTF-8 can contain the result
    return not any("\ud800" <= char <= "\udfff" for char in text)


def _blank(
    data: dict[str, Any], location: Sequence[int | str], lists_of_text: Container[str]
) -> dict[str, Any]:
    """Remove the value at ``location`` from ``data`` in place, and return ``data``."""
    *parents, last = location
    node: Any = data
    within = ""
    for head in parents:
        if isinstance(node, dict) and head in node:
            within = str(head)
        elif not isinstance(node, list) or not isinstance(head, int):
            return data
        node = node[head]
    if isinstance(node, list) and isinstance(last, int):
        # an empty item, because later faults name the positions of later items
        node[last] = "" if within in lists_of_text else {}
    elif isinstance(node, dict):
        node.pop(last, None)  # so that the field's default applies
    return data
