"""``demandops check``: its result on the terminal, as JSON, and as a comment on a pull request."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import click

from demandops.base.quoting import count, lines, one_line
from demandops.cli.formats import output_formats, print_json
from demandops.cli.output import busy, errors, say
from demandops.cli.queries.commits import entry_lines, release_lines
from demandops.decide.state import FileChange
from demandops.detect import rule_file
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
    text, left_out, room = f"{MARK}\n", 0, longest - _ROOM_FOR_NOTE
    for part in _findings(checked):
        fits = len(text) + len(part) <= room
        text += part if fits else ""
        left_out += not fits
    for section in _sections(checked, _MOST_DIFF_LINES_JSON):
        lines = [one_line(line, _LONGEST_SPAN) for line in section.lines]
        part = section.markdown(lines)
        while lines and len(text) + len(part) > room:
            lines = [] if section.is_file else lines[: len(lines) // 2]
            part = section.markdown([*lines, "…"]) if lines else ""
        text += part
        left_out += len(lines) < len(section.lines)
    if left_out:
        text += (
            "\nParts cut or left out, because a comment has a limited length: "
            f"{left_out}; `demandops check --output json` has more.\n"
        )
    return text


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
    if checked.faults:
        yield f"## DemandOps: {count(len(checked.faults), 'error')}\n"
    else:
        yield "## DemandOps: valid, and every release renders\n"
    yield from (f"\n{line}\n" for line in chart_lines(checked.charts, code))
    if base := checked.start.commit:
        invalid = "; it is not valid, so what is in effect at it was compared"
        yield f"\nCompared with {code(base[:10])}{'' if checked.start.valid else invalid}.\n"
    for kind, faults in (("", checked.faults), ("warning: ", checked.warnings)):
        for fault in faults:
            places = [code(place) for place in (fault.place, fault.field) if place]
            yield f"\n- {kind}{': '.join([*places, code(fault.message)])}"
        if faults:
            yield "\n"
    if checked.preview is None:
        yield "\nFix the errors to see what merging would do.\n"
    elif not checked.preview.files and not checked.bookkeeping:
        yield "\nMerging changes no release and no demand.\n"


def _plain(path: str) -> str:
    # for a <summary>, in which Markdown is not rendered
    safe = re.sub(r"[^A-Za-z0-9_./, -]", lambda char: f"&#{ord(char[0])};", one_line(path))
    return f"<code>{safe if len(safe) <= _LONGEST_SPAN else '…'}</code>"


# ---- the command ----

_MOST_DIFF_LINES = 400
_LONG_NEW_FILE = 30
_MOST_DIFF_LINES_JSON = 20_000


@click.command()
@click.argument(
    "directory", type=click.Path(path_type=Path, exists=True), metavar="[DIR|RULES]", default=Path()
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
    """DIR is a checked-out state repo; default: this folder. The files of DIR must be valid, every
    application must render, no generated file may be edited, and a changed chart needs a new
    version. If a generated file is edited, the command prints the override to write instead. Helm
    lints the charts, and renders them for the current releases and for an example of each
    application. Then the command shows what a merge changes: releases, files and bookkeeping.
    docs/pull-requests.md describes the check in a pipeline; markdown is for a comment on a pull
    request. RULES is a file of rules of the detector, of which only the file is checked.

    \b
    Examples:
      demandops check
      demandops check . --base origin/main --output markdown
    """
    if directory.is_file():
        rules = rule_file.read(directory.read_text(), str(directory))
        click.echo(f"{directory}: valid; rules: {', '.join(each.name for each in rules.rules)}")
        return
    with busy("checking"), processor_time(each=2, together=60):
        checked = merge_check.check(directory, base, require_helm=require_helm)
    if output == "json":
        print_json(_data(checked))
    elif output == "markdown":
        click.echo(report(checked), nl=False)
    else:
        for word, faults in (("error", checked.faults), ("warning", checked.warnings)):
            for fault in faults:
                errors.print(f"{word}: {fault}")
        if not checked.faults:
            say(f"{directory}: all files are valid and every release renders")
            for line in chart_lines(checked.charts):
                say(line)
        for line in _lines(checked):
            say(line)
    if checked.faults:
        raise click.exceptions.Exit(1)


def _data(checked: CheckResult) -> Json:
    merge, entries, charts = checked.preview, checked.bookkeeping, None
    if checked.charts is not None:
        names = ("rendered", "releases", "examples", "not_rendered")
        charts = {name: getattr(checked.charts, name) for name in names}
    files = merge.files if merge else ()
    diffs, left_out = _bounded(files, _MOST_DIFF_LINES_JSON)
    changes = [{"file": f.path, "change": f.change, "diff": diffs.get(f.path)} for f in files]
    return {
        "faults": [asdict(fault) for fault in checked.faults],
        "warnings": [asdict(warning) for warning in checked.warnings],
        "suggestions": [asdict(override) for override in checked.suggestions],
        "charts": charts,
        "base": checked.start.commit or None,
        "base_valid": checked.start.valid,
        "releases": [asdict(release) for release in merge.releases] if merge else None,
        "files": changes if merge else None,
        "pending": list(checked.pending),
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


@dataclass(frozen=True, slots=True)
class _Section:
    """A part of the result, as the terminal and a comment show it."""

    title: str
    lines: Sequence[str]
    language: str = ""  # of a file's text or of a difference, which a comment folds
    note: str = ""

    @property
    def is_file(self) -> bool:
        return bool(self.language)

    def markdown(self, lines: Sequence[str]) -> str:
        note = f"\n{code(self.note)}\n" if self.note else ""
        body = fence("\n".join(lines), self.language or "diff")
        if self.is_file:
            summary = _plain(self.title)
            return f"\n<details><summary>{summary}</summary>\n\n{body}{note}\n</details>\n"
        return f"\n### {self.title.capitalize()}\n\n{body}{note}"

    def text(self) -> Iterator[str]:
        yield f"\n{self.title}:" if self.language != "diff" else ""
        if self.language == "yaml":
            yield ""
        yield from (line if self.is_file else f"  {line}" for line in self.lines)
        if self.note:
            yield f"\n({self.note})"


def _sections(checked: CheckResult, most_lines: int) -> Iterator[_Section]:
    for override in checked.suggestions:
        others = ", ".join(override.other_releases)
        note = f"this override also applies to {others}" if others else ""
        title = f"instead of editing {override.instead_of}, write {override.file}"
        yield _Section(title, override.text.splitlines(), "yaml", note)
    if (consequence := checked.preview) is None:
        return
    if consequence.releases:
        yield _Section("desired state", [*release_lines(consequence.releases)])
    if checked.bookkeeping:
        yield _Section("bookkeeping", [*entry_lines(checked.bookkeeping)])
    files = consequence.files
    if not files:
        return
    # a long new file that belongs to no release is listed without a diff
    new = {
        file.path: length
        for file in files
        if file.before is None
        and file.path in consequence.other_files
        and (length := len((file.after or "").splitlines())) > _LONG_NEW_FILE
    }
    listed = [
        f"{'remove' if file.after is None else 'write '} {file.path}"
        + (f" (new, {new[file.path]} lines)" if file.path in new else "")
        for file in files
    ]
    note = "without this edit too, as a generator has yet to carry out earlier commits"
    note = f"{len(checked.pending)} of them {note}" if checked.pending else ""
    title = f"the generator will write or remove {count(len(files), 'file')}"
    yield _Section(title, listed, note=note)
    written = tuple(file for file in files if file.after is not None and file.path not in new)
    diffs, left_out = _bounded(written, most_lines)
    yield from (_Section(path, text.splitlines(), "diff") for path, text in diffs.items())
    if left_out:
        most = f"{_MOST_DIFF_LINES_JSON:,}"
        told = f"{left_out} more lines of differences; --output json has up to {most}"
        yield _Section("left out", [told])


def _lines(checked: CheckResult) -> Iterator[str]:
    start, base = checked.start, checked.start.commit[:10]
    consequence, sections = checked.preview, [*_sections(checked, _MOST_DIFF_LINES)]
    for section in sections[: len(checked.suggestions)]:
        yield from section.text()
    if start.newer:
        commits = "a commit" if start.newer == 1 else f"{start.newer} commits"
        yield (
            f"\nthe merge target has {commits} that this checkout lacks: git rebase --autostash "
            f"{start.target}"
        )
    if consequence is None and checked.suggestions:
        yield "\nfix the errors to see what merging would do"
    if consequence and (consequence.files or checked.bookkeeping):
        compared = f", compared with {base}" if base else ""
        yield f"\nwhat merging would do{compared}:"
    if consequence and base and not start.valid:
        yield f"({base} is not valid, so what is in effect at it is compared)"
    for section in sections[len(checked.suggestions) :]:
        yield from section.text()
