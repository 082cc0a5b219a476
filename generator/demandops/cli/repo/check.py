"""``demandops check``: a state repo as a person edits it, before it is merged."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from demandops.cli.output import console, errors, print_json
from demandops.cli.repo import pull_request_comment
from demandops.plan.views.bookkeeping_diff import EntryChange
from demandops.render.changes.changeset import ReleaseChange
from demandops.render.changes.merge_preview import FileChange
from demandops.staterepo.pull_request import merge_check
from demandops.staterepo.pull_request.merge_check import CheckResult

_MOST_LINES = 400
"""Of unified diffs on a terminal."""
_MOST_LINES_JSON = 20_000

_SIGNS = {
    "start": "+",
    "change": "~",
    "stop": "-",
    "added": "+",
    "changed": "~",
    "removed": "-",
}


@click.command()
@click.argument(
    "directory",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    metavar="DIR",
    default=Path(),
)
@click.option(
    "--base",
    metavar="REV",
    help="What the edit is to be merged into: it is compared with where it left that. By default "
    "origin/main, or main.",
)
@click.option(
    "--output",
    type=click.Choice(["text", "json", "markdown"]),
    default="text",
    show_default=True,
    help="How to print; markdown is ready to be posted as a comment on a pull request.",
)
def check(directory: Path, base: str | None, output: str) -> None:
    """Check a checked-out state repo before its edits are merged, and show what they would do.

    All files are valid, every application renders, no generated file is edited by hand (the
    override that would do the same is printed), and a chart that changed has a new version. What
    follows from the edit is shown: releases that start, change or stop, the files that the
    generator would write, and who would request what. docs/pull-requests.md has it in a pipeline.
    """
    found = merge_check.check(directory, base)
    if output == "json":
        print_json(_data(found))
    elif output == "markdown":
        click.echo(pull_request_comment.report(found), nl=False)
    else:
        _print(directory, found)
    if found.faults:
        click.get_current_context().exit(1)


def _data(found: CheckResult) -> dict[str, Any]:
    known = found.preview
    diffs, left = _bounded(known.files if known else (), _MOST_LINES_JSON)
    return {
        "faults": [
            {"file": one.file, "field": one.field, "message": one.message} for one in found.faults
        ],
        "warnings": [{"file": one.file, "message": one.message} for one in found.warnings],
        "overrides": [
            {
                "instead_of": one.path,
                "file": one.name,
                "text": one.text,
                "left": list(one.left),
                "also": list(one.also),
            }
            for one in found.suggestions
        ],
        "base": found.base,
        "base_valid": found.base_valid,
        "releases": [_release_data(one) for one in known.releases] if known else None,
        "files": [
            {
                "path": one.path,
                "change": "add"
                if one.before is None
                else "remove"
                if one.after is None
                else "change",
                "diff": diffs.get(one.path),
            }
            for one in known.files
        ]
        if known
        else None,
        "outdated": [one.path for one in known.files] if known else [],
        "diff_lines_left_out": left,
        "bookkeeping": [_entry_data(one) for one in found.bookkeeping]
        if found.bookkeeping is not None
        else None,
    }


def _release_data(one: ReleaseChange) -> dict[str, Any]:
    return {
        "name": one.name,
        "change": one.change,
        "what": one.what,
        "details": list(one.details),
    }


def _entry_data(one: EntryChange) -> dict[str, Any]:
    return {
        "kind": one.kind,
        "name": one.name,
        "change": one.change,
        "requesters": list(one.requesters),
        "lost": list(one.lost),
        "gained": list(one.gained),
    }


def _bounded(files: tuple[FileChange, ...], most: int) -> tuple[dict[str, str], int]:
    """Return the unified diffs by path while there is room, and how many lines did not fit."""
    shown: dict[str, str] = {}
    left = 0
    for one in files:
        lines = list(one.diff())
        if len(lines) <= most:
            shown[one.path] = "\n".join(lines) + "\n"
            most -= len(lines)
        else:
            left += len(lines)
    return shown, left


def _print(directory: Path, found: CheckResult) -> None:
    out = console()
    for one in found.faults:
        errors.print(f"error: {one}")
    for one in found.warnings:
        errors.print(f"warning: {one}")
    if not found.faults:
        out.print(f"{directory}: all files are valid and everything renders")
    for line in _lines(found):
        out.print(_visible(line), soft_wrap=True)


def _files(count: int) -> str:
    return "1 file" if count == 1 else f"{count} files"


def _visible(line: str) -> str:
    """Return a line whose characters, which people may have written, do nothing to a terminal."""
    return "".join(char if char.isprintable() or char in "\n\t" else "�" for char in line)


def _lines(found: CheckResult) -> Iterator[str]:
    for one in found.suggestions:
        yield f"\ninstead of editing {one.path}, {one.name}:\n"
        yield from one.text.splitlines()
        if one.also:
            yield f"\n(it fits {', '.join(one.also)} too)"
    known = found.preview
    if known is None:
        if not found.suggestions:
            return
        yield "\nwhat merging would do is shown once the faults are mended"
        return
    if known.files or found.bookkeeping:
        since = f" since {found.base[:10]}" if found.base else ""
        yield f"\nwhat merging would do{since}:"
    if found.base and not found.base_valid:
        yield "(its own files are not valid; compared with the last ones that were)"
    if known.releases:
        yield "\ndesired state:"
        for release in known.releases:
            yield f"  {_SIGNS[release.change]} {release.name} ({release.what})"
            yield from (f"      {detail}" for detail in release.details)
    if found.bookkeeping:
        yield "\nbookkeeping:"
        for entry in found.bookkeeping:
            yield f"  {_SIGNS[entry.change]} {entry.kind} {entry.name}{_for(entry)}"
            yield from (f"      - {fact}" for fact in entry.lost)
            yield from (f"      + {fact}" for fact in entry.gained)
    yield from _file_lines(known.files)


def _for(entry: EntryChange) -> str:
    return "" if entry.change == "changed" else f" for {', '.join(entry.requesters)}"


def _file_lines(files: tuple[FileChange, ...]) -> Iterator[str]:
    if not files:
        return
    yield f"\nthe generator will write or remove {_files(len(files))}:"
    yield from (f"  {'remove' if one.after is None else 'write '} {one.path}" for one in files)
    shown, left = _bounded(tuple(one for one in files if one.after is not None), _MOST_LINES)
    for text in shown.values():
        yield ""
        yield from text.splitlines()
    if left:
        yield f"\n{left} more lines of differences are left out; --output json has them"
