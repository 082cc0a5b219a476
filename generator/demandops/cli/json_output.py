"""The JSON output that several commands share; docs/json.md describes it."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterable
from dataclasses import asdict
from functools import wraps
from typing import Any

import click

from demandops.base import strict_yaml
from demandops.base.errors import DemandOpsError, InvalidInput, fault
from demandops.base.quoting import json_escaped, lines
from demandops.cli.output import painted, print_lines, terminal_width
from demandops.cli.table import Table
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
    description = "The output format."
    if "markdown" in formats:
        description = "The output format; markdown is for a comment on a pull request."
    option = click.option(
        "-o",
        "--output",
        type=_Format(formats),
        default="text",
        show_default=True,
        help=description,
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


def show(output: str, data: object, text: Iterable[str | Table]) -> None:
    if output == "json":
        print_json(data)
        return
    if output == "yaml":
        click.echo(strict_yaml.dump(json.loads(json.dumps(data))), nl=False)
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
