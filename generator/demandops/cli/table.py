"""The tables that commands print: plain columns that fit the terminal without cutting a word.

On a terminal, text wraps between words. If not all columns fit, some are left out, and a last line
names them. If the output is no terminal, each row is one line with every column, so that programs
like awk and grep can read it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from rich.cells import cell_len

from demandops.base.quoting import one_line

_GAP = "  "
# The smallest width, in characters, to which a column is narrowed by wrapping its text.
# If the terminal has no room for this width, columns are left out.
_COMFORT = 12

# The text of a cell, or its lines.
Cell = str | Sequence[str]
# Makes a cell of an item, and of what else the cells of a table need, such as the time.
CellOf = Callable[..., Cell]


@dataclass(frozen=True, slots=True)
class Column:
    # Columns get room in the order of ``rank``. One that does not fit is left out, even if a
    # narrower one of a higher rank fits. A column of rank 0 is never left out.
    title: str
    rank: int = 0
    wraps: bool = False
    cell_of: CellOf = str


@dataclass(frozen=True, slots=True)
class Table:
    columns: Sequence[Column]
    rows: Sequence[Sequence[Cell]]
    title: str = ""
    empty: str = "(nothing)"
    # Maps a cell's text to its color, for terminals that show colors.
    styles: dict[str, str] = field(default_factory=dict)
    # Whether to keep every column and wrap nothing, however wide the table gets.
    whole: bool = False

    def lines(self, width: int | None, style: Callable[[str, str], str] | None = None) -> list[str]:
        # Without a ``width``, one for each row, however long. ``style`` returns a text in a style
        # (``bold``, ``dim`` or a color); None is plain text.
        width = None if self.whole else width
        paint = style or (lambda text, _: text)
        title = [paint(self.title, "bold")] if self.title else []
        if not self.rows:
            return [*title, self.empty]
        # the lines of each cell; without a width, one line, so that awk and grep see whole rows
        rows = [
            [
                [one_line(line) for line in ([cell] if isinstance(cell, str) else cell)]
                for cell in row
            ]
            for row in self.rows
        ]
        if width is None:
            rows = [[[", ".join(filter(None, cell))] for cell in row] for row in rows]
        shown = list(range(len(self.columns)))
        if width is not None:
            used = [at for at in shown if any(any(row[at]) for row in rows)]
            shown = [at for at in shown if self.columns[at].rank == 0]
            room = width - sum(self._least(rows, at) + len(_GAP) for at in shown) + len(_GAP)
            for at in sorted(set(used) - set(shown), key=lambda at: (self.columns[at].rank, at)):
                needed = self._least(rows, at) + len(_GAP)
                if needed <= room:
                    shown.append(at)
                    room -= needed
            shown.sort()
        widths = natural = [self._natural(rows, at) for at in shown]
        if width is not None:
            widths = [self._least(rows, at) for at in shown]
            room = width - sum(widths) - len(_GAP) * (len(widths) - 1)
            for place, wanted in enumerate(natural):
                more = min(max(room, 0), wanted - widths[place])
                widths[place] += more
                room -= more
        head = [[self.columns[at].title.upper()] for at in shown]
        lines = [paint(line, "bold") for line in _laid_out(head, widths)]
        for row in rows:
            cells = [_wrapped(row[at], widths[place]) for place, at in enumerate(shown)]
            lines += _laid_out(cells, widths, lambda text: paint(text, self.styles.get(text, "")))
        left_out = [
            column.title.upper()
            for at, column in enumerate(self.columns)
            if at not in shown and any(any(row[at]) for row in rows)
        ]
        if left_out:
            note = f"more columns in a wider terminal: {', '.join(left_out)}"
            lines += [paint(line, "dim") for line in _wrapped([note], width or 0)]
        return [*title, *lines]

    def _natural(self, rows: list[list[list[str]]], at: int) -> int:
        lengths = [cell_len(line) for row in rows for line in row[at]]
        return max([cell_len(self.columns[at].title), *lengths])

    def _least(self, rows: list[list[list[str]]], at: int) -> int:
        natural = self._natural(rows, at)
        if not self.columns[at].wraps:
            return natural
        # a column that wraps gets `_COMFORT`, unless its text is shorter
        words = [cell_len(word) for row in rows for line in row[at] for word in line.split()]
        return max([cell_len(self.columns[at].title), min(natural, _COMFORT), *words])


def column(title: str, cell: str | CellOf, rank: int = 0, *, wraps: bool = False) -> Column:
    """Return a column; ``cell`` makes its cells, or is the key of a value to show."""
    cell_of = cell if callable(cell) else lambda item, *_: item[cell] or ""
    return Column(title, rank, wraps, cell_of)


def joined(key: str) -> CellOf:
    return lambda item, *_: ", ".join(item[key])


def table_of(
    columns: Sequence[Column],
    items: Iterable[Any],
    *given: object,
    **more: Any,  # noqa: ANN401 - the other fields of a table
) -> Table:
    rows = [[each.cell_of(item, *given) for each in columns] for item in items]
    return Table(columns, rows, **more)


def _wrapped(lines: Iterable[str], width: int) -> list[str]:
    wrapped: list[str] = []
    for line in lines:
        if cell_len(line) <= width:
            wrapped.append(line)
            continue
        last = ""
        for word in line.split():
            joined = f"{last} {word}" if last else word
            if last and cell_len(joined) > width:
                wrapped.append(last)
                last = word
            else:
                last = joined
        wrapped.append(last)
    return wrapped


def _laid_out(
    cells: Sequence[Sequence[str]], widths: Sequence[int], paint: Callable[[str], str] = str
) -> Iterator[str]:
    for number in range(max(len(cell) for cell in cells)):
        parts = [cell[number] if number < len(cell) else "" for cell in cells]
        padded = (
            paint(part) + " " * (width - cell_len(part))
            for part, width in zip(parts, widths, strict=True)
        )
        yield _GAP.join(padded).rstrip()
