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


class TemplateLines:
    def __init__(self, template: str, rendered: str) -> None:
        self._template, self._rendered = template.splitlines(), rendered.splitlines()
        self._text = rendered
        self._fields: dict[str, int] | None = None

    def located(self, fault: Fault) -> Fault:
        """Return a fault of the rendered text, with the template's line if this line is known."""
        if fault.line:
            return fault
        place = _PLACE.match(fault.field)
        if place:
            number: int | None = int(place[1])
        else:
            if self._fields is None:
                self._fields = field_lines.lines(self._text)
            number = field_lines.nearest(fault.field.removeprefix("values."), self._fields)
        if not number or number > len(self._rendered):
            return fault
        rendered = self._rendered[number - 1]
        if len(rendered) > _LONGEST:
            return fault
        lines = [*enumerate(self._template, 1)]
        same = [at for at, line in lines if line == rendered]
        candidates = same or [at for at, line in lines if _may_write(line, rendered)]
        # a wrong line would mislead, so of several none is named
        return replace(fault, line=candidates[0]) if len(candidates) == 1 else fault


def _may_write(line: str, rendered: str) -> bool:
    """Return whether ``rendered`` has all text around the expressions of a template's line."""
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
