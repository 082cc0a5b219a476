"""The formats of what commands print: JSON and YAML (docs/json.md), templates, and tables.

A table has plain columns that fit the terminal without cutting a word: text wraps between words. If
not all columns fit, some are left out, and a last line names them. `-o wide` prints every column
and each row on one line, for programs like awk and grep.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime, timezone
from functools import wraps
from typing import Any

import click
from rich.cells import cell_len

from demandops.base import strict_yaml
from demandops.base.errors import DemandOpsError, InvalidInput, fault
from demandops.base.quoting import json_escaped, lines, one_line
from demandops.cli.output import painted, print_lines, terminal_width
from demandops.model.config.base_model import parse_time
from demandops.views.kinds import Kind
from demandops.views.rows import TONES, Column, Row
from demandops.views.vocabulary import Json

Command = Callable[..., Any]

# The width of tables elsewhere than on a terminal.
_NARROW = 80
_PATH = "jsonpath="
_STEP = re.compile(r"\.?\*|\.?([\w-]+)|\[(\*|-?\d+)\]|\[(['\"])(.*?)\3\]")


class _Format(click.Choice[str]):
    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> str:
        if value.startswith(_PATH) and any(choice.startswith(_PATH) for choice in self.choices):
            return value
        return super().convert(value, param, ctx)


def output_formats(*formats: str) -> Callable[[Command], Command]:
    # with ``--output json``, a command that raises DemandOpsError also prints the faults as JSON
    option = click.option(
        "-o",
        "--output",
        type=_Format(formats),
        default="text",
        show_default=True,
        help="The output format.",
    )

    def add(command: Command) -> Command:
        @wraps(command)
        def run(*args: Any, output: str, **given: Any) -> Any:  # noqa: ANN401
            try:
                return command(*args, output=output, **given)
            except DemandOpsError as error:
                if output == "json":
                    print_json({"faults": faults_of(error)})
                raise

        return option(run)

    return add


output_option = output_formats("text", "json")


def show(output: str, data: Any, text: Iterable[str | Table]) -> None:  # noqa: ANN401
    if output == "json":
        print_json(data)
        return
    if output == "yaml" or output.startswith(_PATH):
        data = json.loads(json.dumps(data))  # with lists for tuples
    if output == "yaml":
        click.echo(strict_yaml.dump(data), nl=False)
        return
    if output.startswith(_PATH):
        click.echo(lines(filled(output.removeprefix(_PATH), data)))
        return
    printed: list[str] = []
    for part in text:
        if isinstance(part, Table):
            printed += part.lines(terminal_width() or _NARROW, painted)
        else:
            printed += lines(part).split("\n")
    print_lines(printed)


def print_json(data: object) -> None:
    click.echo(json_text(data, indent=2))


def json_text(data: object, indent: int | None = None) -> str:
    # escaped where the terminal or a pipe takes no Unicode
    takes_all = (sys.stdout.encoding or "").lower().startswith("utf")
    return json_escaped(json.dumps(data, indent=indent, ensure_ascii=not takes_all))


def faults_of(error: DemandOpsError) -> list[Json]:
    faults = error.faults if isinstance(error, InvalidInput) else [fault("", str(error))]
    return [asdict(fault) for fault in dict.fromkeys(faults)]


# ---- templates of JSON as kubectl has them ----


def filled(template: str, data: object) -> str:
    """Fill ``{.items[*].name}``, ``{.items[0]['name']}``, ``{range …}…{end}`` and ``{"\\n"}``."""
    parts = re.split(r"\{((?:\"[^\"]*\"|[^{}\"])*)\}", template)
    # every second part stands in braces; a template without braces is one expression
    tokens = [("{" if at % 2 else "", part) for at, part in enumerate(parts)]
    return _filled([("{", template)] if len(parts) == 1 else tokens, data)


def _filled(tokens: list[tuple[str, str]], data: object) -> str:
    text, at = "", 0
    while at < len(tokens):
        brace, part = tokens[at]
        at += 1
        if not brace:
            text += part
        elif part.startswith('"'):
            text += json.loads(part)
        elif part.startswith("range "):
            ends = [n for n in range(at, len(tokens)) if tokens[n] == ("{", "end")]
            if not ends:
                raise click.UsageError("--output: {range …} has no {end}")
            for value in _values(part.removeprefix("range "), data):
                text += _filled(tokens[at : ends[0]], value)
            at = ends[0] + 1
        else:
            values = _values(part, data)
            text += " ".join(v if isinstance(v, str) else json_text(v) for v in values)
    return text


def _values(expression: str, data: object) -> list[Any]:
    values: list[Any]
    values, at, path = [data], 0, expression.strip().lstrip("$@").removesuffix(".")
    while at < len(path):
        step = _STEP.match(path, at)
        if step is None:
            raise click.UsageError(f"--output: the path {expression} is not valid at {path[at:]}")
        at, name, index = step.end(), step[1] or step[4], step[2]
        if name is not None:
            having = [value[name] for value in values if isinstance(value, dict) and name in value]
            if values and not having:
                keys = {key for value in values if isinstance(value, dict) for key in value}
                raise click.UsageError(
                    f"--output: there is no '{name}' in {expression}; there is "
                    f"{', '.join(sorted(keys)) or 'nothing'}"
                )
            values = having
        elif index in (None, "*"):
            inner = (v.values() if isinstance(v, dict) else v for v in values)
            values = [each for group in inner if not isinstance(group, str) for each in group or ()]
        else:
            lists = (value for value in values if isinstance(value, list))
            number = int(index)
            values = [each[number] for each in lists if -len(each) <= number < len(each)]
    return values


# ---- tables ----

_GAP = "  "
# The smallest width, in characters, to which a column is narrowed by wrapping its text.
# If the terminal has no room for this width, columns are left out.
_COMFORT = 12


@dataclass(frozen=True, slots=True)
class Table:
    columns: Sequence[Column]
    rows: Sequence[Sequence[Sequence[str]]]  # the texts of each cell, which commas join
    title: str = ""
    empty: str = "(nothing)"
    # Maps a cell's text to its color, for terminals that show colors.
    styles: Mapping[str, str] = field(default_factory=dict)
    # Whether to keep every column and wrap nothing, however wide the table gets.
    whole: bool = False
    how_to_see: str = "in a wider terminal"

    def lines(self, width: int, style: Callable[[str, str], str] | None = None) -> list[str]:
        # ``style`` returns a text in a style (``bold``, ``dim`` or a color); None is plain text
        paint = style or (lambda text, _: text)
        title = [paint(self.title, "bold")] if self.title else []
        if not self.rows:
            return [*title, self.empty]
        heads = [column.title.upper() for column in self.columns]
        rows = [[one_line(", ".join(cell)) for cell in row] for row in self.rows]
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
            lines += _laid_out(row, shown, widths, lambda t: paint(t, self.styles.get(t, "")))
        if left_out := [heads[at] for at in used if at not in shown]:
            note = f"more columns {self.how_to_see}: {', '.join(left_out)}"
            lines += [paint(line, "dim") for line in _wrapped(note, width)]
        return [*title, *lines]


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


def list_table(
    kind: Kind, rows: Sequence[Row], now: datetime, *, wide: bool | None = None
) -> Table:
    # ``wide`` is None for a command without ``-o wide``
    columns = [column for column in kind.columns if wide or not column.only_wide]
    cells = [[column.texts(row.item, now) for column in columns] for row in rows]
    for cell in (cell for row in cells if not wide for cell in row):
        if len(cell) > _MOST:  # the beginning of long lists, so that most rows have one line
            cell[_MOST - 1 :] = [f"+{len(cell) - _MOST + 1}"]
    for column in kind.columns if wide else ():
        if column.form == "time":  # and when that was by the clock
            columns.append(Column(column.key, f"{column.title} (UTC)"))
            for row, texts in zip(rows, cells, strict=True):
                since = parse_time(time) if (time := row.item[column.key]) else None
                clock = since and f"{since.astimezone(timezone.utc):%Y-%m-%d %H:%M:%S}"
                texts.append([clock] if clock else [])
    how_to_see = "in a wider terminal" if wide is None else "with -o wide"
    empty, whole = f"no {kind.name}", bool(wide)
    return Table(columns, cells, empty=empty, styles=STYLES, whole=whole, how_to_see=how_to_see)
