"""Texts with placeholders, such as ``vehicle{n}``: for entries of the inventory, and rules.

A placeholder is a name in braces. ``${n}`` and ``{{n}}`` mean something to others, and any other
brace is one. Nothing is evaluated, and values are put in after parsing, so a value cannot change
the structure of what it is put into.
"""

from __future__ import annotations

import re
from collections.abc import Container, Iterator, Mapping
from functools import lru_cache
from typing import Any

_PLACEHOLDER = re.compile(r"(?<![${])\{([A-Za-z_][A-Za-z0-9_]*)\}(?!\})")
# What a placeholder stands for in an id. None of these characters means anything in an expression
# or a path; what a topic or an address does not allow is a fault of what is made.
VALUE = "[A-Za-z0-9._-]+"


def names(text: str) -> list[str]:
    """Return the names of the placeholders in ``text``, also one that is there twice."""
    return _PLACEHOLDER.findall(text)


def shape_of(id: str) -> str:
    """Return an id in which placeholders have numbers for names, in their order."""
    order = dict.fromkeys(names(id))
    numbers = {name: f"{{_{number}}}" for number, name in enumerate(order)}
    return _PLACEHOLDER.sub(lambda match: numbers[match[1]], id)


def is_pattern(id: object) -> bool:
    return isinstance(id, str) and _PLACEHOLDER.search(id) is not None


def texts(data: Any, path: str = "") -> Iterator[tuple[str, str]]:  # noqa: ANN401 - plain data
    """Yield each text and each key in ``data``, which is at ``path``, with its own path."""
    if isinstance(data, str):
        yield path, data
    elif isinstance(data, Mapping):
        for key, value in data.items():
            yield from texts(key, f"{path}.{key}")
            yield from texts(value, f"{path}.{key}")
    elif isinstance(data, list | tuple):
        for index, item in enumerate(data):
            yield from texts(item, f"{path}[{index}]")


def unknown_names(
    data: Any,  # noqa: ANN401 - plain data
    path: str,
    known: Container[str],
) -> Iterator[tuple[str, str]]:
    """Yield each placeholder that is none of ``known``, after the path where it stands."""
    for place, text in texts(data, path):
        yield from ((place, name) for name in dict.fromkeys(names(text)) if name not in known)


def filled(data: Any, values: Mapping[str, Any]) -> Any:  # noqa: ANN401
    """Return ``data`` with values for placeholders; one without a value stays.

    A text that is only a placeholder becomes the value itself, for example a number.
    """
    if isinstance(data, str):
        alone = _PLACEHOLDER.fullmatch(data)
        if alone and alone[1] in values:
            return values[alone[1]]
        return _PLACEHOLDER.sub(lambda match: str(values.get(match[1], match[0])), data)
    if isinstance(data, Mapping):
        return {
            str(filled(key, values)) if isinstance(key, str) else key: filled(value, values)
            for key, value in data.items()
        }
    return [filled(item, values) for item in data] if isinstance(data, list | tuple) else data


def values_in(text: str, made: str, value: str = VALUE) -> dict[str, str] | None:
    """Return the values with which ``text`` becomes ``made``; ``None`` if none do."""
    expression, others = _expression(text, value)
    # else each way to divide a long text would be tried, for one character that no value has
    match = expression.fullmatch(made) if re.sub(value, "", made) == others else None
    return match.groupdict() if match else None


@lru_cache(maxsize=65_536)
def _expression(text: str, value: str) -> tuple[re.Pattern[str], str]:
    """Return the expression of all that ``text`` may become, and the characters of no value."""
    expression, seen = "", set[str]()
    for index, part in enumerate(_PLACEHOLDER.split(text)):  # texts and names in turn
        if index % 2 == 0:
            expression += re.escape(part)
        else:
            expression += f"(?P={part})" if part in seen else f"(?P<{part}>{value})"
            seen.add(part)
    return re.compile(expression), re.sub(value, "", _PLACEHOLDER.sub("", text))


def example_of(id: str, value: str) -> str:
    return _PLACEHOLDER.sub(value, id)


def glob_of(id: str) -> str:
    return example_of(id, "?*")


def any_value_of(text: str) -> str:
    """Return a regular expression of RE2 for each text that a text with placeholders may become."""
    return VALUE.join(map(re.escape, _PLACEHOLDER.split(text)[::2]))
