"""The template of a rule's demand: plain data in whose texts ``{entity}`` stands for a value.

A text that is only a name in braces becomes the value itself, for example a number for ``{x}``.
``{{`` and ``}}`` stand for single braces. A template has no expressions, attributes or formats.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from demandops.errors import Fault, fault, suggestion

# The values of the names in a template.
Values = Mapping[str, str | float]

_TOKEN = re.compile(r"\{\{|\}\}|\{([^{}]*)\}|[{}]")
# The pattern of an entity's name.
_ENTITY = r"[A-Za-z0-9_.-]+"


def is_entity(name: str) -> bool:
    return bool(re.fullmatch(_ENTITY, name))


def filled(template: Any, values: Values) -> Any:  # noqa: ANN401 - plain data
    """Return a copy of a template in which values replace the names in braces.

    Raises:
        KeyError: if a name has no value; :func:`faults` reports such names.
    """
    # The template is parsed already, so a value cannot change the structure of the demand.
    if isinstance(template, str):
        alone = _TOKEN.fullmatch(template)
        if alone and alone[1] is not None:
            return values[alone[1]]
        return _TOKEN.sub(
            lambda token: token[0][0] if token[1] is None else str(values[token[1]]), template
        )
    if isinstance(template, Mapping):
        return {str(filled(key, values)): filled(value, values) for key, value in template.items()}
    if isinstance(template, list | tuple):
        return [filled(item, values) for item in template]
    return template


def texts(template: Any, field: str) -> Iterator[tuple[str, str]]:  # noqa: ANN401
    """Yield (path, text) for each text and each key in a template at the path ``field``."""
    if isinstance(template, str):
        yield field, template
    elif isinstance(template, Mapping):
        for key, value in template.items():
            yield f"{field}.{key}", key
            yield from texts(value, f"{field}.{key}")
    elif isinstance(template, list | tuple):
        for index, item in enumerate(template):
            yield from texts(item, f"{field}[{index}]")


def names(text: str) -> set[str]:
    return {token[1] for token in _TOKEN.finditer(text) if token[1] is not None}


def faults(template: Any, field: str, known: set[str]) -> list[Fault]:  # noqa: ANN401
    """Return a fault for each name in braces that ``known`` lacks, and for each stray brace.

    A brace is stray if it is neither doubled nor part of a pair around a name.
    """
    problems = []
    for path, text in texts(template, field):
        for token in _TOKEN.finditer(text):
            if token[0] in ("{", "}"):
                message = f"has a single '{token[0]}'; write '{token[0] * 2}' for one brace"
                problems.append(fault(path, message))
            elif token[1] is not None and token[1] not in known:
                message = f"'{{{token[1]}}}' has no value here"
                problems.append(fault(path, message + suggestion(token[1], known)))
    return problems


def candidates(template: str, text: str) -> Mapping[str, str]:
    """Return entities whose names turn the template into ``text``, by the names in braces.

    If several combinations of entities give this text, the result is one of them. The result is
    empty if none does, or if the template has no names in braces.
    """
    seen: set[str] = set()
    pattern, end = "", 0
    for token in _TOKEN.finditer(template):
        pattern += re.escape(template[end : token.start()])
        end = token.end()
        if token[1] is None:
            pattern += re.escape(token[0][0])
        else:
            pattern += f"(?P={token[1]})" if token[1] in seen else f"(?P<{token[1]}>{_ENTITY})"
            seen.add(token[1])
    matched = re.fullmatch(pattern + re.escape(template[end:]), text)
    return matched.groupdict() if matched else {}
