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
    such document, or if :func:`load_all` refuses the text.
    """
    by_field: dict[str, int] = {}

    def add(node: yaml.Node | None, path: str) -> None:
        if isinstance(node, yaml.MappingNode):
            for key, value in node.value:
                field = f"{path}.{key.value}" if path else str(key.value)
                by_field[field] = key.start_mark.line + 1
                add(value, field)
        elif isinstance(node, yaml.SequenceNode):
            for index, item in enumerate(node.value):
                by_field[f"{path}[{index}]"] = item.start_mark.line + 1
                add(item, f"{path}[{index}]")

    with suppress(InvalidInput, yaml.YAMLError):
        for _ in load_all(text):  # refuses what nests too deeply for `add`
            pass
        nodes = yaml.compose_all(text, Loader=LOADER)
        add(next(islice(nodes, document, None), None), "")
    return by_field


class FieldLines:
    """Finds the lines of fields in files; reads each file only once."""

    def __init__(self, text_of: Callable[[str], str | None]) -> None:
        self._text_of = text_of
        self._lines: dict[str, Mapping[str, int]] = {}

    def of(self, file: str, field: str) -> int | None:
        """Return the line of a field, as :func:`nearest` finds it in the file."""
        if field and file not in self._lines:
            self._lines[file] = lines(self._text_of(file) or "")
        return nearest(field, self._lines.get(file, {}))


def nearest(field: str, lines: Mapping[str, int]) -> int | None:
    """Return the line of a field or else of the nearest part that contains it, if there is one."""
    # the field of a fault may be missing in the file, or be only a part of a text
    while field and field not in lines:
        field = field[: max(field.rfind("."), field.rfind("["), 0)]
    return lines[field] if field else None


def with_lines(faults: Iterable[Fault], text_of: Callable[[str], str | None]) -> list[Fault]:
    """Return the faults, each with its line; a fault that has a line keeps it."""
    lines = FieldLines(text_of)
    return [
        replace(fault, line=fault.line or lines.of(fault.file, fault.field)) for fault in faults
    ]


@contextmanager
def located_in(text: str) -> Iterator[None]:
    """Add the line in ``text`` to each fault that the block raises."""
    try:
        yield
    except InvalidInput as error:
        raise InvalidInput(with_lines(error.faults, lambda _: text)) from None
