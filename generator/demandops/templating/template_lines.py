"""Finds the line of a values template that produced a faulty line of the rendered text."""

from __future__ import annotations

import re
from dataclasses import replace

from demandops import field_lines
from demandops.errors import Fault

_EXPRESSION = re.compile(r"\{\{.*?\}\}|\{%.*?%\}|\{#.*?#\}")
_PLACE = re.compile(r"line (\d+)")
# The most characters that a searched line may have. The search for a longer line could take too
# long.
_LONGEST = 2_000
_VALUES = "values."


class TemplateLines:
    """The lines of a template, and the lines of the text that it rendered to."""

    def __init__(self, template: str, rendered: str) -> None:
        self._template, self._rendered = template.splitlines(), rendered.splitlines()
        self._text = rendered
        self._fields: dict[str, int] | None = None

    def located(self, fault: Fault) -> Fault:
        """Return a fault of the rendered text, with the template's line if this line is known."""
        place = _PLACE.match(fault.field)
        number = int(place[1]) if place else self._number_of(fault.field.removeprefix(_VALUES))
        return replace(fault, line=fault.line or (self._line_of(number) if number else None))

    def _number_of(self, path: str) -> int | None:
        if self._fields is None:
            self._fields = field_lines.lines(self._text)
        return field_lines.nearest(path, self._fields)

    def _line_of(self, number: int) -> int | None:
        """Return the number of the template's line that produced a line of the rendered text.

        If the template has an identical line, lines with expressions are not tried. Return None if
        no line of the template, or more than one, may have produced the rendered line.
        """
        if number > len(self._rendered) or len(self._rendered[number - 1]) > _LONGEST:
            return None
        rendered = self._rendered[number - 1]
        lines = [*enumerate(self._template, 1)]
        same = [at for at, line in lines if line == rendered]
        found = same or [at for at, line in lines if _may_write(line, rendered)]
        return found[0] if len(found) == 1 else None


def _may_write(line: str, rendered: str) -> bool:
    """Return whether a line of a template may have produced a rendered line.

    The template's line must have expressions, and the rendered line must contain all text around
    these expressions in the same order.
    """
    first, *others = _EXPRESSION.split(line)
    if not others or not "".join((first, *others)).strip() or not rendered.startswith(first):
        return False
    at, end = len(first), len(rendered) - len(others[-1])
    for part in others[:-1]:
        at = rendered.find(part, at)
        if at < 0:
            return False
        at += len(part)
    return at <= end and rendered.endswith(others[-1])
