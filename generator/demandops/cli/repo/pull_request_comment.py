"""The result of ``demandops check`` as a comment on a pull request.

Text that people wrote appears only as code, so that this text cannot mention users, make links or
break the layout. Each code span or fence uses more backticks than any run of backticks in its text.
The length of a comment is limited. So the most important parts come first, and the comment states
how many parts are omitted.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator

from demandops.plan.views.bookkeeping import EntryChange
from demandops.quoting import lines, one_line
from demandops.render.changes.changeset import CHANGE_ORDER
from demandops.staterepo.pull_request.merge_check import CheckResult
from demandops.staterepo.pull_request.rendered_charts import MISSING, NO_HELM, RenderedCharts

# The first line of every report. A pipeline finds its earlier comment by this line.
MARK = "<!-- demandops check -->"

# The default limit of a report in characters. GitHub allows 65,536, GitLab more.
LONGEST = 60_000

_LONGEST_SPAN = 500
_ROOM_FOR_NOTE = 200


def report(checked: CheckResult, longest: int = LONGEST) -> str:
    """Return the result of a check as Markdown, with at most ``longest`` characters."""
    parts = [f"{MARK}\n", *_head(checked), *_suggestions(checked), *_consequence(checked)]
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
    """Yield lines that say which charts helm rendered, and why it did not render the others.

    A reason may contain text that people wrote, so ``shown`` makes it safe to print.
    """
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
    """Return text as a code span of one line, cut off if it is very long."""
    text = one_line(text, _LONGEST_SPAN)
    if not text.strip():
        return "(empty)"
    marks = _longer_than_any(text, least=1)
    # Markdown needs a space between a backtick of the text and those that enclose it
    edge = " " if text.startswith("`") or text.endswith("`") else ""
    return f"{marks}{edge}{text}{edge}{marks}"


def fence(text: str, language: str) -> str:
    text = lines(text)
    marks = _longer_than_any(text, least=3)
    return f"{marks}{language}\n{text.rstrip()}\n{marks}\n"


def _longer_than_any(text: str, least: int) -> str:
    longest = max((len(run) for run in re.findall("`+", text)), default=0)
    return "`" * max(least, longest + 1)


def _head(checked: CheckResult) -> Iterator[str]:
    count = len(checked.faults)
    if count:
        yield f"## DemandOps: {'1 error' if count == 1 else f'{count} errors'}\n"
    else:
        yield "## DemandOps: valid, and every release renders\n"
    yield from (f"\n{line}\n" for line in chart_lines(checked.charts, code))
    if checked.base:
        invalid = "; instead of its invalid files, their last valid versions were compared"
        yield f"\nCompared with {code(checked.base[:10])}{'' if checked.base_valid else invalid}.\n"
    for kind, faults in (("", checked.faults), ("warning: ", checked.warnings)):
        for fault in faults:
            places = [code(place) for place in (fault.place, fault.field) if place]
            yield f"\n- {kind}{': '.join([*places, code(fault.message)])}"
        if faults:
            yield "\n"


def _suggestions(checked: CheckResult) -> Iterator[str]:
    for suggestion in checked.suggestions:
        body = f"Merge this as {code(suggestion.file)}:\n\n{fence(suggestion.text, 'yaml')}"
        if suggestion.not_covered:
            body += f"\nNo override can change {', '.join(map(code, suggestion.not_covered))}.\n"
        if suggestion.other_releases:
            others = ", ".join(map(code, suggestion.other_releases))
            body += f"\nThis override also applies to {others}.\n"
        yield _folded(f"Instead of editing {_plain(suggestion.instead_of)}", body)


def _consequence(checked: CheckResult) -> Iterator[str]:
    consequence = checked.preview
    if consequence is None:
        yield "\nFix the errors to see what merging would do.\n"
        return
    if not consequence.files and not checked.bookkeeping:
        yield "\nMerging changes no release and no demand.\n"
        return
    yield "\n### Desired state\n"
    kinds = [release.change for release in consequence.releases]
    counts = [f"{kinds.count(kind)} to {kind}" for kind in CHANGE_ORDER if kind in kinds]
    if counts:
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
    """Return a path as HTML for a ``<summary>``, in which Markdown is not rendered."""
    safe = re.sub(r"[^A-Za-z0-9_./-]", lambda char: f"&#{ord(char[0])};", one_line(path))
    return f"<code>{safe if len(safe) <= _LONGEST_SPAN else '…'}</code>"
