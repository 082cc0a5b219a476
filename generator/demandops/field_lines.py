"""The lines of a file's fields, so that a fault can name its line."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import islice

import yaml

from demandops.errors import Fault, InvalidInput
from demandops.strict_yaml import LOADER, load_all


def lines(text: str, document: int = 0) -> dict[str, int]:
    """Return the line of each field of a document; a field is a path like ``nodes[3].cluster``.

    ``document`` is the index of the document in the text. The result is empty if the text has no
    such document, or if :func:`load_all` refuses the text; its errors name lines themselves.
    """
    found: dict[str, int] = {}
    with suppress(InvalidInput, yaml.YAMLError):
        for _ in load_all(text):
            pass
        nodes = yaml.compose_all(text, Loader=LOADER)
        _add_lines(next(islice(nodes, document, None), None), "", found)
    return found


def _add_lines(node: yaml.Node | None, path: str, found: dict[str, int]) -> None:
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            field = f"{path}.{key.value}" if path else str(key.value)
            found[field] = key.start_mark.line + 1
            _add_lines(value, field, found)
    elif isinstance(node, yaml.SequenceNode):
        for index, item in enumerate(node.value):
            found[f"{path}[{index}]"] = item.start_mark.line + 1
            _add_lines(item, f"{path}[{index}]", found)


class FieldLines:
    """Finds the lines of fields in files; reads each file only once."""

    def __init__(self, text_of: Callable[[str], str | None]) -> None:
        """Read files with ``text_of``, which returns a file's text, or None if there is none."""
        self._text_of = text_of
        self._known: dict[str, Mapping[str, int]] = {}

    def of(self, file: str, field: str) -> int | None:
        """Return the line of a field in a file.

        If the field has no line of its own, return the line of the nearest part that contains it.
        Return None if there is no such part.
        """
        if field and file not in self._known:
            self._known[file] = lines(self._text_of(file) or "")
        return nearest(field, self._known.get(file, {}))


def nearest(field: str, known: Mapping[str, int]) -> int | None:
    """Return the line of a field from ``known``, which maps fields to lines.

    If the field is not known, return the line of the nearest known part that contains it. Return
    None if there is no such part.
    """
    while field and field not in known:
        field = field[: max(field.rfind("."), field.rfind("["), 0)]
    return known[field] if field else None


def with_lines(faults: Iterable[Fault], text_of: Callable[[str], str | None]) -> list[Fault]:
    """Return the faults, each with the line that :meth:`FieldLines.of` finds for its field.

    A fault that has a line keeps it. ``text_of`` returns the text of a file, or None if there is no
    such file.
    """
    known = FieldLines(text_of)
    return [replace(one, line=one.line or known.of(one.file, one.field)) for one in faults]


@contextmanager
def located_in(text: str) -> Iterator[None]:
    """If the block raises faults, add to each fault the line of the fault's field.

    The fields of the faults must be fields of ``text``.
    """
    try:
        yield
    except InvalidInput as error:
        raise InvalidInput(with_lines(error.faults, lambda _: text)) from None
