"""The tables that commands print: plain columns that fit the terminal without cutting a word.

Text wraps between words. If not all columns fit, some are left out, and a last line names them.
`-o wide` prints every column and each row on one line, for programs like awk and grep.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from typing import Any

from rich.cells import cell_len

from demandops.base.quoting import one_line
from demandops.model.config.base_model import parse_time
from demandops.views.kinds import Kind
from demandops.views.rows import TONES, Column, Row
from demandops.views.vocabulary import Json

_GAP = "  "
# The smallest width, in characters, to which a column is narrowed by wrapping its text.
# If the terminal has no room for this width, columns are left out.
_COMFORT = 12

Cell = str | Sequence[str]  # several texts are joined by commas


@dataclass(frozen=True, slots=True)
class Table:
    columns: Sequence[Column]
    rows: Sequence[Sequence[Cell]]
    title: str = ""
    empty: str = "(nothing)"
    # Maps a cell's text to its color, for terminals that show colors.
    styles: Mapping[str, str] = field(default_factory=dict)
    # Whether to keep every column and wrap nothing, however wide the table gets.
    whole: bool = False

    def lines(self, width: int, style: Callable[[str, str], str] | None = None) -> list[str]:
        # ``style`` returns a text in a style (``bold``, ``dim`` or a color); None is plain text
        paint = style or (lambda text, _: text)
        title = [paint(self.title, "bold")] if self.title else []
        if not self.rows:
            return [*title, self.empty]
        heads = [column.title.upper() for column in self.columns]
        rows = [
            [one_line(cell if isinstance(cell, str) else ", ".join(cell)) for cell in row]
            for row in self.rows
        ]
        texts = [[head, *cells] for head, cells in zip(heads, zip(*rows, strict=True), strict=True)]
        natural = [max(map(cell_len, column)) for column in texts]
        least = [
            # the longest word, and enough for several short ones
            max(
                min(wanted, _COMFORT),
                *(cell_len(word) for text in column for word in text.split()),
                cell_len(head),
            )
            for head, wanted, column in zip(heads, natural, texts, strict=True)
        ]
        # a program that reads a whole table finds a column at the same place in each
        used = [at for at in range(len(heads)) if self.whole or any(row[at] for row in rows)]
        shown, widths = used, natural
        if not self.whole:
            shown, room = [], width + len(_GAP)
            for at in sorted(used, key=lambda at: (self.columns[at].rank, at)):
                if self.columns[at].rank == 0 or least[at] + len(_GAP) <= room:
                    shown.append(at)
                    room -= least[at] + len(_GAP)
            shown.sort()
            widths = list(least)
            for at in shown:  # what room is left goes to the first columns first
                more = min(max(room, 0), natural[at] - least[at])
                widths[at] += more
                room -= more
        lines = [paint(line, "bold") for line in _laid_out(heads, shown, widths)]
        for row in rows:
            lines += _laid_out(
                row, shown, widths, lambda text: paint(text, self.styles.get(text, ""))
            )
        if left_out := [heads[at] for at in used if at not in shown]:
            note = f"more columns in a wider terminal: {', '.join(left_out)}"
            lines += [paint(line, "dim") for line in _wrapped(note, width)]
        return [*title, *lines]


def table_of(
    columns: Sequence[Column],
    items: Iterable[Json],
    now: datetime,
    **more: Any,  # noqa: ANN401 - the other fields of a table
) -> Table:
    return Table(columns, [[each.texts(item, now) for each in columns] for item in items], **more)


def _wrapped(text: str, width: int) -> list[str]:
    if cell_len(text) <= width:
        return [text]
    lines = [""]
    for word in text.split():
        joined = f"{lines[-1]} {word}" if lines[-1] else word
        if lines[-1] and cell_len(joined) > width:
            lines.append(word)
        else:
            lines[-1] = joined
    return lines


def _laid_out(
    cells: Sequence[str],
    shown: Sequence[int],
    widths: Sequence[int],
    paint: Callable[[str], str] = str,
) -> Iterator[str]:
    wrapped = [_wrapped(cells[at], widths[at]) for at in shown]
    for number in range(max(map(len, wrapped), default=0)):
        parts = [lines[number] if number < len(lines) else "" for lines in wrapped]
        yield _GAP.join(
            paint(part) + " " * (widths[at] - cell_len(part))
            for at, part in zip(shown, parts, strict=True)
        ).rstrip()


# ---- the tables of lists ----

# How many texts of a cell are shown.
_MOST = 3
_COLORS = {"bad": "red", "busy": "yellow", "good": "green", "none": ""}
STYLES = {word: _COLORS[tone] for word, tone in TONES.items()}


def list_table(kind: Kind, rows: Sequence[Row], now: datetime, *, wide: bool = False) -> Table:
    columns = [column for column in kind.columns if wide or not column.only_wide]
    cells = [[column.texts(row.item, now) for column in columns] for row in rows]
    if not wide:  # of long lists the beginning, so that most rows have one line
        cells = [
            [
                texts
                if len(texts) <= _MOST
                else [*texts[: _MOST - 1], f"+{len(texts) - _MOST + 1}"]
                for texts in row
            ]
            for row in cells
        ]
    for column in kind.columns if wide else ():
        if column.form == "time":  # and when that was by the clock
            columns.append(Column(column.key, f"{column.title} (UTC)"))
            for row, texts in zip(rows, cells, strict=True):
                since = parse_time(time) if (time := row.item[column.key]) else None
                clock = since and f"{since.astimezone(timezone.utc):%Y-%m-%d %H:%M:%S}"
                texts.append([clock] if clock else [])
    return Table(columns, cells, empty=f"no {kind.name}", styles=STYLES, whole=wide)
