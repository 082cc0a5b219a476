"""``demandops check``: the effect of edits of a state repo, before they are merged."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import click

from demandops.cli.json_output import Json, output_formats, print_json
from demandops.cli.output import busy, console, errors
from demandops.cli.repo import pull_request_comment
from demandops.cli.views.diff import entry_lines, release_lines
from demandops.evaluator.process import processor_time
from demandops.render.changes.merge_preview import FileChange, MergePreview
from demandops.staterepo.pull_request import merge_check
from demandops.staterepo.pull_request.merge_check import CheckResult

_MOST_DIFF_LINES = 400
_LONG_NEW_FILE = 30
_MOST_DIFF_LINES_JSON = 20_000


@click.command()
@click.argument(
    "directory",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    metavar="[DIR]",
    default=Path(),
)
@click.option(
    "--base",
    metavar="REV",
    help="The branch into which the edits will be merged. The edits are compared with the common "
    "ancestor of HEAD and this branch. Default: origin/main, or main if there is no origin/main.",
)
@click.option(
    "--require-helm",
    is_flag=True,
    help="Fail if helm is not installed, because charts cannot be rendered without it.",
)
@output_formats("text", "json", "markdown")
def check(directory: Path, base: str | None, require_helm: bool, output: str) -> None:
    """Check edits of a state repo and show their consequences.

    DIR is a checked-out state repo; default: this folder. The files of DIR must be valid, every
    application must render, no generated file may be edited, and a changed chart needs a new
    version. If a generated file is edited, the command prints the override to write instead. Helm
    lints the charts, and renders them for the current releases and for an example of each
    application. Then the command shows what a merge changes: releases, files and bookkeeping.
    docs/pull-requests.md describes the check in a pipeline.

    \b
    Examples:
      demandops check
      demandops check . --base origin/main --output markdown
    """
    with busy("checking"), processor_time(each=2, together=60):
        checked = merge_check.check(directory, base, require_helm=require_helm)
    if output == "json":
        print_json(_data(checked))
    elif output == "markdown":
        click.echo(pull_request_comment.report(checked), nl=False)
    else:
        for fault in checked.faults:
            errors.print(f"error: {fault}")
        for warning in checked.warnings:
            errors.print(f"warning: {warning}")
        out = console()
        if not checked.faults:
            out.print(f"{directory}: all files are valid and every release renders")
            for line in pull_request_comment.chart_lines(checked.charts):
                out.print(line, soft_wrap=True)
        for line in _lines(checked):
            out.print(line, soft_wrap=True)
    if checked.faults:
        raise click.exceptions.Exit(1)


def _data(checked: CheckResult) -> Json:
    merge, entries, charts = checked.preview, checked.bookkeeping, None
    if checked.charts is not None:
        charts = {
            "rendered": list(checked.charts.rendered),
            "releases": checked.charts.releases,
            "examples": checked.charts.examples,
            "not_rendered": dict(checked.charts.not_rendered),
        }
    files = merge.files if merge else ()
    diffs, left_out = _bounded(files, _MOST_DIFF_LINES_JSON)
    changes = [
        {"file": file.path, "change": file.change, "diff": diffs.get(file.path)} for file in files
    ]
    return {
        "faults": [asdict(each) for each in checked.faults],
        "warnings": [asdict(each) for each in checked.warnings],
        "suggestions": [asdict(each) for each in checked.suggestions],
        "charts": charts,
        "base": checked.base,
        "base_valid": checked.base_valid,
        "releases": [asdict(each) for each in merge.releases] if merge else None,
        "files": changes if merge else None,
        "diff_lines_left_out": left_out,
        "bookkeeping": None if entries is None else [asdict(each) for each in entries],
    }


def _bounded(files: tuple[FileChange, ...], most: int) -> tuple[dict[str, str], int]:
    """Return the diffs that fit into ``most`` lines, by path, and the number of other lines."""
    shown: dict[str, str] = {}
    left_out = 0
    for file in files:
        lines = list(file.diff())
        if len(lines) <= most:
            shown[file.path] = "\n".join(lines) + "\n"
            most -= len(lines)
        else:  # it is left out as a whole; a shorter one after it may fit
            left_out += len(lines)
    return shown, left_out


def _lines(checked: CheckResult) -> Iterator[str]:
    for override in checked.suggestions:
        yield f"\ninstead of editing {override.instead_of}, write {override.file}:\n"
        yield from override.text.splitlines()
        if override.other_releases:
            yield f"\n(this override also applies to {', '.join(override.other_releases)})"
    if checked.newer:
        commits = "a commit" if checked.newer == 1 else f"{checked.newer} commits"
        yield (
            f"\nthe merge target has {commits} that this checkout lacks: git rebase --autostash "
            f"{checked.target}"
        )
    consequence = checked.preview
    if consequence is None:
        if checked.suggestions:
            yield "\nfix the errors to see what merging would do"
        return
    if consequence.files or checked.bookkeeping:
        compared = f", compared with {checked.base[:10]}" if checked.base else ""
        yield f"\nwhat merging would do{compared}:"
    if checked.base and not checked.base_valid:
        yield f"({checked.base[:10]} has invalid files, so their last valid versions are compared)"
    if consequence.releases:
        yield "\ndesired state:"
        yield from (f"  {line}" for line in release_lines(consequence.releases))
    if checked.bookkeeping:
        yield "\nbookkeeping:"
        yield from (f"  {line}" for line in entry_lines(checked.bookkeeping))
    yield from _file_lines(consequence)


def _file_lines(consequence: MergePreview) -> Iterator[str]:
    others, files = {*consequence.other_files}, consequence.files
    if not files:
        return
    # a long new file that belongs to no release is listed without a diff
    new = {
        file.path: length
        for file in files
        if file.before is None
        and file.path in others
        and (length := len((file.after or "").splitlines())) > _LONG_NEW_FILE
    }
    count = "1 file" if len(files) == 1 else f"{len(files)} files"
    yield f"\nthe generator will write or remove {count}:"
    for file in files:
        note = f" (new, {new[file.path]} lines)" if file.path in new else ""
        yield f"  {'remove' if file.after is None else 'write '} {file.path}{note}"
    written = tuple(file for file in files if file.after is not None and file.path not in new)
    shown, left_out = _bounded(written, _MOST_DIFF_LINES)
    for text in shown.values():
        yield ""
        yield from text.splitlines()
    if left_out:
        most = f"{_MOST_DIFF_LINES_JSON:,}"
        yield f"\n{left_out} more lines of differences are left out; --output json has up to {most}"
