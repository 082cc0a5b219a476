"""``demandops check``: its result on the terminal, as JSON, and as a comment on a pull request."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import click

from demandops.base.quoting import lines, one_line
from demandops.cli.formats import output_formats, print_json
from demandops.cli.output import busy, console, errors
from demandops.cli.queries.commits import entry_lines, release_lines
from demandops.decide.bookkeeping import EntryChange
from demandops.decide.changeset import CHANGE_ORDER, FileChange
from demandops.repo.merge_check import merge_check
from demandops.repo.merge_check.merge_check import CheckResult
from demandops.repo.merge_check.rendered_charts import MISSING, NO_HELM, RenderedCharts
from demandops.serve.proposal import backticks
from demandops.templating.evaluator import processor_time
from demandops.views.vocabulary import Json

# ---- the result as a comment on a pull request ----
#
# Text that people wrote appears only as code, so that this text cannot mention users, make links or
# break the layout. Each code span or fence uses more backticks than any run of backticks in its
# text. The length of a comment is limited, so the most important parts come first.

# The first line of every report. A pipeline finds its earlier comment by this line.
MARK = "<!-- demandops check -->"

# The default limit of a report in characters. GitHub allows 65,536, GitLab more.
LONGEST = 60_000

_LONGEST_SPAN = 500
_ROOM_FOR_NOTE = 200


def report(checked: CheckResult, longest: int = LONGEST) -> str:
    parts = [f"{MARK}\n", *_findings(checked), *_consequence(checked)]
    room = longest - _ROOM_FOR_NOTE
    taken, left_out = list[str](), 0
    for part in parts:
        if len(part) <= room:
            taken.append(part)
            room -= len(part)
        else:
            left_out += 1
    if left_out:
        many = f"{left_out} parts of this report are"
        if left_out == 1:
            many = "One part of this report is"
        taken.append(
            f"\n{many} left out because a comment has a limited length; "
            "`demandops check --output json` has more.\n"
        )
    return "".join(taken)


def chart_lines(
    charts: RenderedCharts | None, shown: Callable[[str], str] = one_line
) -> Iterator[str]:
    # a reason may contain text that people wrote, so `shown` makes it safe to print
    if charts is None:
        return
    if MISSING in charts.not_rendered.values():
        yield NO_HELM
        return
    if charts.rendered:
        yield (
            f"charts rendered by helm: {', '.join(charts.rendered)} "
            f"({charts.releases} releases, {charts.examples} examples)"
        )
    for name, reason in charts.not_rendered.items():
        yield f"chart {name} not rendered: {shown(reason)}"


def code(text: str) -> str:
    # one line, cut off if it is very long
    text = one_line(text, _LONGEST_SPAN)
    if not text.strip():
        return "(empty)"
    marks = backticks(text, least=1)
    # Markdown needs a space between a backtick of the text and those that enclose it
    edge = " " if text.startswith("`") or text.endswith("`") else ""
    return f"{marks}{edge}{text}{edge}{marks}"


def fence(text: str, language: str) -> str:
    text = lines(text)
    marks = backticks(text, least=3)
    return f"{marks}{language}\n{text.rstrip()}\n{marks}\n"


def _findings(checked: CheckResult) -> Iterator[str]:
    count = len(checked.faults)
    if count:
        yield f"## DemandOps: {'1 error' if count == 1 else f'{count} errors'}\n"
    else:
        yield "## DemandOps: valid, and every release renders\n"
    yield from (f"\n{line}\n" for line in chart_lines(checked.charts, code))
    if checked.base:
        invalid = "; it is not valid, so what is in effect at it was compared"
        yield f"\nCompared with {code(checked.base[:10])}{'' if checked.base_valid else invalid}.\n"
    for kind, faults in (("", checked.faults), ("warning: ", checked.warnings)):
        for fault in faults:
            places = [code(place) for place in (fault.place, fault.field) if place]
            yield f"\n- {kind}{': '.join([*places, code(fault.message)])}"
        if faults:
            yield "\n"
    for suggestion in checked.suggestions:
        body = f"Merge this as {code(suggestion.file)}:\n\n{fence(suggestion.text, 'yaml')}"
        if suggestion.not_covered:
            body += f"\nNo override can change {', '.join(map(code, suggestion.not_covered))}.\n"
        if suggestion.other_releases:
            others = ", ".join(map(code, suggestion.other_releases))
            body += f"\nThis override also applies to {others}.\n"
        yield _folded(f"Instead of editing {_plain(suggestion.instead_of)}", body)


def _consequence(checked: CheckResult) -> Iterator[str]:
    if (consequence := checked.preview) is None:
        yield "\nFix the errors to see what merging would do.\n"
        return
    if not consequence.files and not checked.bookkeeping:
        yield "\nMerging changes no release and no demand.\n"
        return
    yield "\n### Desired state\n"
    kinds = [release.change for release in consequence.releases]
    if counts := [f"{kinds.count(kind)} to {kind}" for kind in CHANGE_ORDER if kind in kinds]:
        yield f"\nReleases: {', '.join(counts)}.\n"
    else:
        yield "\nNo release starts, changes or stops.\n"
    for release in consequence.releases:
        details = "".join(f"\n  - {code(detail)}" for detail in release.details)
        yield f"\n- {release.change}s {code(release.name)}: {code(release.what)}{details}"
    yield "\n"
    yield "\n### Bookkeeping\n"
    if checked.bookkeeping is None:
        yield "\nNot compared, because the base has no valid files.\n"
    elif not checked.bookkeeping:
        yield "\nUnchanged.\n"
    yield from map(_entry, checked.bookkeeping or ())
    yield "\n"
    if consequence.files:
        yield f"\n### Files that the generator writes or removes: {len(consequence.files)}\n"
    for file in consequence.files:
        if file.after is None:
            yield f"\n- removed: {code(file.path)}"
    yield "\n"
    for file in consequence.files:
        if file.after is not None:
            yield _folded(_plain(file.path), fence("\n".join(file.diff()), "diff"))


def _entry(entry: EntryChange) -> str:
    word = "new" if entry.change == "added" else entry.change
    line = f"\n- {word}: {entry.kind} {code(entry.name)}"
    if entry.change != "changed":
        return f"{line} for {', '.join(map(code, entry.requesters))}"
    facts = [f"\n  - no longer {code(fact)}" for fact in entry.lost]
    facts += [f"\n  - now {code(fact)}" for fact in entry.gained]
    return line + "".join(facts)


def _folded(summary: str, body: str) -> str:
    return f"\n<details><summary>{summary}</summary>\n\n{body}\n</details>\n"


def _plain(path: str) -> str:
    # for a <summary>, in which Markdown is not rendered
    safe = re.sub(r"[^A-Za-z0-9_./-]", lambda char: f"&#{ord(char[0])};", one_line(path))
    return f"<code>{safe if len(safe) <= _LONGEST_SPAN else '…'}</code>"


# ---- the command ----

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
        click.echo(report(checked), nl=False)
    else:
        for fault in checked.faults:
            errors.print(f"error: {fault}")
        for warning in checked.warnings:
            errors.print(f"warning: {warning}")
        out = console()
        if not checked.faults:
            out.print(f"{directory}: all files are valid and every release renders")
            for line in chart_lines(checked.charts):
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
        "faults": [asdict(fault) for fault in checked.faults],
        "warnings": [asdict(warning) for warning in checked.warnings],
        "suggestions": [asdict(override) for override in checked.suggestions],
        "charts": charts,
        "base": checked.base,
        "base_valid": checked.base_valid,
        "releases": [asdict(release) for release in merge.releases] if merge else None,
        "files": changes if merge else None,
        "diff_lines_left_out": left_out,
        "bookkeeping": None if entries is None else [asdict(entry) for entry in entries],
    }


def _bounded(files: tuple[FileChange, ...], most: int) -> tuple[dict[str, str], int]:
    # the diffs that fit into `most` lines, by path, and the number of other lines
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


def _lines(checked: CheckResult) -> Iterator[str]:  # noqa: PLR0912 - a part each
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
    if (consequence := checked.preview) is None:
        if checked.suggestions:
            yield "\nfix the errors to see what merging would do"
        return
    if consequence.files or checked.bookkeeping:
        compared = f", compared with {checked.base[:10]}" if checked.base else ""
        yield f"\nwhat merging would do{compared}:"
    if checked.base and not checked.base_valid:
        yield f"({checked.base[:10]} is not valid, so what is in effect at it is compared)"
    if consequence.releases:
        yield "\ndesired state:"
        yield from (f"  {line}" for line in release_lines(consequence.releases))
    if checked.bookkeeping:
        yield "\nbookkeeping:"
        yield from (f"  {line}" for line in entry_lines(checked.bookkeeping))
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
