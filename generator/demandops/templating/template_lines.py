"""Finds the line of a values template that produced a faulty line of the rendered text."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from demandops import field_lines
from demandops.errors import Fault

_EXPRESSION = re.compile(r"\{\{.*?\}\}|\{%.*?%\}|\{#.*?#\}")
_PLACE = re.compile(r"line (\d+)")
# The most characters that a searched line may have. The search for a longer line could take too
# long.
_LONGEST = 2_000


def with_template_lines(faults: Iterable[Fault], template: str, rendered: str) -> Iterator[Fault]:
    """Yield faults of a rendered text, each with the template's line if this line is known."""
    template_lines, rendered_lines = template.splitlines(), rendered.splitlines()
    fields: Mapping[str, int] | None = None
    for fault in faults:
        if place := _PLACE.match(fault.field):
            number: int | None = int(place[1])
        else:
            fields = field_lines.lines(rendered) if fields is None else fields
            number = field_lines.nearest(fault.field.removeprefix("values."), fields)
        candidates: list[int] = []
        if number and number <= len(rendered_lines):
            written = rendered_lines[number - 1]
            lines = [*enumerate(template_lines, 1)] if len(written) <= _LONGEST else []
            candidates = [at for at, line in lines if line == written]
            candidates = candidates or [at for at, line in lines if _may_write(line, written)]
        # a wrong line would mislead, so of several none is named
        line = candidates[0] if len(candidates) == 1 else None
        yield replace(fault, line=fault.line or line)


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
