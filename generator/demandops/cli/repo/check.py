"""``demandops check``: the effect of edits of a state repo, before they are merged."""

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

_MOST_DIFF_LINES = 400
_MOST_DIFF_LINES_JSON = 20_000

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
    help="The branch that the edits will be merged into. They are compared with the merge base. "
    "Default: origin/main, or main.",
)
@click.option(
    "--output",
    type=click.Choice(["text", "json", "markdown"]),
    default="text",
    show_default=True,
    help="The output format; markdown is for a comment on a pull request.",
)
def check(directory: Path, base: str | None, output: str) -> None:
    """Check edits of a state repo and show their consequences.

    DIR is a checked-out state repo. Its files must be valid, every application must render, no
    generated file may be edited (the override to write instead is printed), and a changed chart
    needs a new version. Then the consequences of a merge are shown: changed releases, files and
    bookkeeping. docs/pull-requests.md describes the check in a pipeline.
    """
    checked = merge_check.check(directory, base)
    if output == "json":
        print_json(_data(checked))
    elif output == "markdown":
        click.echo(pull_request_comment.report(checked), nl=False)
    else:
        _print(directory, checked)
    if checked.faults:
        click.get_current_context().exit(1)


def _data(checked: CheckResult) -> dict[str, Any]:
    consequence = checked.preview
    diffs, left = _bounded(consequence.files if consequence else (), _MOST_DIFF_LINES_JSON)
    return {
        "faults": [
            {"file": each.file, "field": each.field, "message": each.message}
            for each in checked.faults
        ],
        "warnings": [{"file": each.file, "message": each.message} for each in checked.warnings],
        "overrides": [
            {
                "instead_of": each.path,
                "file": each.name,
                "text": each.text,
                "left": list(each.not_covered),
                "also": list(each.other_releases),
            }
            for each in checked.suggestions
        ],
        "base": checked.base,
        "base_valid": checked.base_valid,
        "releases": [_release_data(each) for each in consequence.releases] if consequence else None,
        "files": [
            {
                "path": each.path,
                "change": "add"
                if each.before is None
                else "remove"
                if each.after is None
                else "change",
                "diff": diffs.get(each.path),
            }
            for each in consequence.files
        ]
        if consequence
        else None,
        "outdated": [each.path for each in consequence.files] if consequence else [],
        "diff_lines_left_out": left,
        "bookkeeping": [_entry_data(each) for each in checked.bookkeeping]
        if checked.bookkeeping is not None
        else None,
    }


def _release_data(release: ReleaseChange) -> dict[str, Any]:
    return {
        "name": release.name,
        "change": release.change,
        "what": release.description,
        "details": list(release.details),
    }


def _entry_data(entry: EntryChange) -> dict[str, Any]:
    return {
        "kind": entry.kind,
        "name": entry.name,
        "change": entry.change,
        "requesters": list(entry.requesters),
        "lost": list(entry.lost),
        "gained": list(entry.gained),
    }


def _bounded(files: tuple[FileChange, ...], most: int) -> tuple[dict[str, str], int]:
    """Return the diffs that fit in ``most`` lines, by path, and the number of omitted lines."""
    shown: dict[str, str] = {}
    left = 0
    for file in files:
        lines = list(file.diff())
        if len(lines) <= most:
            shown[file.path] = "\n".join(lines) + "\n"
            most -= len(lines)
        else:
            left += len(lines)
    return shown, left


def _print(directory: Path, checked: CheckResult) -> None:
    out = console()
    for each in checked.faults:
        errors.print(f"error: {each}")
    for each in checked.warnings:
        errors.print(f"warning: {each}")
    if not checked.faults:
        out.print(f"{directory}: all files are valid and everything renders")
    for line in _lines(checked):
        out.print(_visible(line), soft_wrap=True)


def _files(count: int) -> str:
    return "1 file" if count == 1 else f"{count} files"


def _visible(line: str) -> str:
    """Return a line without characters that would control the terminal."""
    return "".join(char if char.isprintable() or char in "\n\t" else "�" for char in line)


def _lines(checked: CheckResult) -> Iterator[str]:
    for each in checked.suggestions:
        yield f"\ninstead of editing {each.path}, {each.name}:\n"
        yield from each.text.splitlines()
        if each.other_releases:
            yield f"\n(it also applies to {', '.join(each.other_releases)})"
    consequence = checked.preview
    if consequence is None:
        if not checked.suggestions:
            return
        yield "\nfix the errors to see what merging would do"
        return
    if consequence.files or checked.bookkeeping:
        since = f" since {checked.base[:10]}" if checked.base else ""
        yield f"\nwhat merging would do{since}:"
    if checked.base and not checked.base_valid:
        yield "(its own files are not valid; compared with its last valid files)"
    if consequence.releases:
        yield "\ndesired state:"
        for release in consequence.releases:
            yield f"  {_SIGNS[release.change]} {release.name} ({release.description})"
            yield from (f"      {detail}" for detail in release.details)
    if checked.bookkeeping:
        yield "\nbookkeeping:"
        for entry in checked.bookkeeping:
            yield f"  {_SIGNS[entry.change]} {entry.kind} {entry.name}{_for(entry)}"
            yield from (f"      - {fact}" for fact in entry.lost)
            yield from (f"      + {fact}" for fact in entry.gained)
    yield from _file_lines(consequence.files)


def _for(entry: EntryChange) -> str:
    return "" if entry.change == "changed" else f" for {', '.join(entry.requesters)}"


def _file_lines(files: tuple[FileChange, ...]) -> Iterator[str]:
    if not files:
        return
    yield f"\nthe generator will write or remove {_files(len(files))}:"
    yield from (f"  {'remove' if each.after is None else 'write '} {each.path}" for each in files)
    shown, left = _bounded(
        tuple(each for each in files if each.after is not None), _MOST_DIFF_LINES
    )
    for text in shown.values():
        yield ""
        yield from text.splitlines()
    if left:
        yield f"\n{left} more lines of differences are left out; --output json has them"
