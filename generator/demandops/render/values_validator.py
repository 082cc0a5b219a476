"""Validators for a chart's ``values.schema.json``.

A schema may not refer to other files. A schema whose validation could take long is refused.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import lru_cache
from typing import Any
from urllib.parse import unquote

import jsonschema_rs

from demandops.config.base_model import field_path
from demandops.errors import InvalidInput, fault
from demandops.quoting import quoted

_MAX_WORK = 100_000
_MAX_VISITS = 1_000_000
_MAX_DEPTH = 100
"""The greatest depth of nested values, which is also the limit of strict YAML."""

_REFERENCES = ("$ref", "$dynamicRef", "$recursiveRef")
_SAME_VALUE = ("allOf", "anyOf", "oneOf", "not", "if", "then", "else")
_SAME_VALUE_BY_NAME = ("dependentSchemas", "dependencies")
_EACH_PART = ("contains", "propertyNames", "unevaluatedProperties", "unevaluatedItems")
_ONE_PART = ("items", "prefixItems", "additionalItems", "additionalProperties")
_TOO_MUCH = (
    "is nested too deeply or applies too many schemas to one value; make it flatter and refer less "
    "often to the same definition"
)


@lru_cache(maxsize=256)
def validator(text: str, file: str) -> Any:  # noqa: ANN401
    """Return the validator for a schema, given the text and the path of the schema's file.

    Raises:
        InvalidInput: if ``text`` is not a valid schema, refers to another document, or applies too
            many schemas to a value.
    """
    schema: Any = None
    try:
        schema = json.loads(text)
        found = jsonschema_rs.validator_for(schema, retriever=_refuse)
        if _Work(schema).of(schema, _MAX_DEPTH) > _MAX_WORK:
            raise RecursionError
    except RecursionError:
        raise InvalidInput.at("", _TOO_MUCH, file=file) from None
    except (ValueError, TypeError) as error:
        faults = [
            fault(
                field_path(place),
                f"{quoted(target)} is outside this file; only references that start with '#' are "
                "followed, so copy the definition here",
            ).within(file)
            for place, target in _outside(schema, ())
        ]
        reason = str(error).splitlines()[0]
        message = f"is not a valid JSON schema: {reason}; fix it"
        raise InvalidInput(faults or [fault("", message).within(file)]) from None
    return found


def _refuse(uri: str) -> None:
    raise ValueError(f"{uri} is outside this file")


def _outside(schema: object, place: tuple[int | str, ...]) -> Iterator[tuple[Any, str]]:
    """Yield the place and the target of each reference to another document."""
    if isinstance(schema, dict):
        for key, part in schema.items():
            if key in _REFERENCES and isinstance(part, str) and not part.startswith("#"):
                yield (*place, key), part
            yield from _outside(part, (*place, key))
    elif isinstance(schema, list):
        for index, part in enumerate(schema):
            yield from _outside(part, (*place, index))


class _Work:
    """Computes an upper limit of the work of a validation.

    The work is the number of schemas that the validation may apply along one path into the values.
    """

    def __init__(self, document: object) -> None:
        self._document = document
        self._anchors = {
            f"#{one['$anchor']}": one for one in _mappings(document) if "$anchor" in one
        }
        self._known: dict[tuple[int, int], int] = {}

    def of(self, schema: object, depth: int) -> int:
        """Return the highest number of schemas that ``schema`` may apply to a value.

        The value has at most ``depth`` nested levels.

        Raises:
            RecursionError: if a schema applies itself to the same value, the number is too high, or
                too many schemas must be counted.
        """
        if not isinstance(schema, dict) or depth < 0:
            return 1
        key = (id(schema), depth)
        if key not in self._known:
            # above the limit while the number is computed, to refuse a schema that applies itself
            self._known[key] = _MAX_WORK + 1
            self._known[key] = self._counted(schema, depth)
        work = self._known[key]
        if work > _MAX_WORK or len(self._known) > _MAX_VISITS:
            raise RecursionError
        return work

    def _counted(self, schema: dict[str, Any], depth: int) -> int:
        same = [part for name in _SAME_VALUE for part in _parts(schema.get(name))]
        same += [part for name in _SAME_VALUE_BY_NAME for part in _named(schema.get(name))]
        same += [self._target(schema[name]) for name in _REFERENCES if name in schema]
        each = [part for name in _EACH_PART for part in _parts(schema.get(name))]
        each += _named(schema.get("patternProperties"))
        one = [part for name in _ONE_PART for part in _parts(schema.get(name))]
        one += _named(schema.get("properties"))
        return (
            1
            + sum(self.of(part, depth) for part in same)
            + sum(self.of(part, depth - 1) for part in each)
            + max((self.of(part, depth - 1) for part in one), default=0)
        )

    def _target(self, reference: object) -> object:
        """Return the schema that a reference names.

        If the reference is a path (``#/…``) that leads to nothing, return None. If it is an unknown
        anchor, return the whole document.
        """
        found = self._anchors.get(str(reference), self._document)
        if not isinstance(reference, str) or not reference.startswith("#/"):
            return found
        for step in reference[2:].split("/"):
            name = unquote(step).replace("~1", "/").replace("~0", "~")
            if isinstance(found, list):
                found = found[int(name)] if name.isdecimal() and int(name) < len(found) else None
            else:
                found = found.get(name) if isinstance(found, dict) else None
        return found


def _mappings(schema: object) -> Iterator[dict[str, Any]]:
    if isinstance(schema, dict):
        yield schema
    for part in schema.values() if isinstance(schema, dict) else _parts(schema):
        if isinstance(part, dict | list):
            yield from _mappings(part)


def _parts(value: object) -> list[Any]:
    return value if isinstance(value, list) else [] if value is None else [value]


def _named(value: object) -> list[Any]:
    return list(value.values()) if isinstance(value, dict) else []
