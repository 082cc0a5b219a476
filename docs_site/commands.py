"""Makes the page of commands from click's own objects."""

from __future__ import annotations

import inspect

import click
from demandops.cli.main import COMMANDS, ExitCode, cli, load


def page() -> str:
    """Return the page as Markdown."""
    group = click.Context(cli, info_name="demandops", **cli.context_settings)
    parts = [
        "# Commands",
        "Generated from the program. `demandops COMMAND --help` prints the same.",
        _paragraphs(cli.help or ""),
        _options(cli, group),
    ]
    for name in COMMANDS:
        command = load(name)
        context = click.Context(command, parent=group, info_name=name)
        usage = " ".join([context.command_path, *command.collect_usage_pieces(context)])
        parts += [f"## {name}", f"```text\n{usage}\n```", _paragraphs(command.help or "")]
        parts.append(_options(command, context))
    codes = [f"| `{code.value}` | {code.name.lower().replace('_', ' ')} |" for code in ExitCode]
    table = ["| code | meaning |", "| --- | --- |", *codes]
    return "\n\n".join([*parts, "## Exit codes", "\n".join(table)]) + "\n"


def _paragraphs(text: str) -> str:
    """Return a help text with each paragraph on one line, and `\\b` blocks as they are."""
    paragraphs = inspect.cleandoc(text).split("\n\n")
    return "\n\n".join(
        f"```text\n{one.removeprefix(chr(8)).strip(chr(10))}\n```"
        if one.startswith("\b")
        else " ".join(one.split())
        for one in paragraphs
    )


def _options(command: click.Command, context: click.Context) -> str:
    records = [param.get_help_record(context) for param in command.get_params(context)]
    rows = [f"| `{name}` | {_cell(text)} |" for name, text in filter(None, records)]
    return "\n".join(["| option | meaning |", "| --- | --- |", *rows]) if rows else ""


def _cell(text: str) -> str:
    return text.replace("|", "&#124;")
