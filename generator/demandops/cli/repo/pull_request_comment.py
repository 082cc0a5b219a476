"""What ``demandops check`` found, as a comment on a pull request.

What people wrote stands in code spans and fences only, whose marks are longer than any run of them
inside: it can name nobody, link nowhere and close nothing. A comment has a longest length, so the
parts come by weight, and what does not fit is said to be left out.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

from demandops.plan.views.bookkeeping_diff import EntryChange
from demandops.render.changes.changeset import ReleaseChange
from demandops.render.changes.merge_preview import FileChange
from demandops.staterepo.pull_request.merge_check import CheckResult

MARK = "<!-- demandops check -->"
"""Begins every report, so that a pipeline finds its own comment again."""

LONGEST = 60_000
"""Characters: GitHub takes 65,536, GitLab more."""

_LONGEST_SPAN = 500
_ROOM_FOR_NOTE = 200
_VERBS = {"start": "starts", "change": "changes", "stop": "stops"}
_ENTRY_VERBS = {"added": "new", "changed": "changed", "removed": "gone"}


def report(found: CheckResult, longest: int = LONGEST) -> str:
    """Return the report, of at most ``longest`` characters."""
    parts = [f"{MARK}\n", *_head(found)]
    parts += _faults(found)
    parts += _warnings(found)
    parts += _suggestions(found)
    parts += _consequence(found)
    return _bounded(parts, longest)


def code(text: str) -> str:
    """Return what somebody wrote as a code span of one line."""
    text = "".join(char if char.isprintable() else " " for char in text)
    if len(text) > _LONGEST_SPAN:
        text = f"{text[:_LONGEST_SPAN]}…"
    if not text.strip():
        return "(empty)"
    marks = _longer_than_any(text, least=1)
    edge = " " if text.startswith("`") or text.endswith("`") else ""
    return f"{marks}{edge}{text}{edge}{marks}"


def fence(text: str, language: str) -> str:
    """Return what somebody wrote as a block of code."""
    text = "".join(char if char.isprintable() or char in "\n\t" else "�" for char in text)
    marks = _longer_than_any(text, least=3)
    return f"{marks}{language}\n{text.rstrip()}\n{marks}\n"


def _longer_than_any(text: str, least: int) -> str:
    longest = max((len(run) for run in re.findall("`+", text)), default=0)
    return "`" * max(least, longest + 1)


def _head(found: CheckResult) -> Iterator[str]:
    if found.faults:
        many = "one thing" if len(found.faults) == 1 else f"{len(found.faults)} things"
        yield f"## DemandOps: {many} to mend\n"
    else:
        yield "## DemandOps: valid, and everything renders\n"
    if found.base:
        since = "" if found.base_valid else ", whose last valid files stand in for its own"
        yield f"\nCompared with {code(found.base[:10])}{since}.\n"


def _faults(found: CheckResult) -> Iterator[str]:
    for one in found.faults:
        places = [code(place) for place in (one.file, one.field) if place]
        yield f"\n- {': '.join([*places, code(one.message)])}"
    if found.faults:
        yield "\n"


def _warnings(found: CheckResult) -> Iterator[str]:
    for one in found.warnings:
        yield f"\n- warning: {code(one.file)}: {code(one.message)}"
    if found.warnings:
        yield "\n"


def _suggestions(found: CheckResult) -> Iterator[str]:
    for one in found.suggestions:
        body = f"Merge this as {code(one.name)}:\n\n{fence(one.text, 'yaml')}"
        if one.left:
            body += f"\nNo override changes {', '.join(map(code, one.left))}.\n"
        if one.also:
            body += f"\nIt fits {', '.join(map(code, one.also))} too.\n"
        yield _folded(f"Instead of editing {_plain(one.path)}", body)


def _consequence(found: CheckResult) -> Iterator[str]:
    known = found.preview
    if known is None:
        yield "\nWhat merging would do is shown once that is mended.\n"
        return
    if not known.files and not found.bookkeeping:
        yield "\nMerging changes nothing that runs, and nobody's demand.\n"
        return
    yield "\n### Desired state\n"
    if known.releases:
        yield f"\n{_counted(known.releases)}\n"
    else:
        yield "\nNo release starts, changes or stops.\n"
    yield from map(_release, known.releases)
    yield "\n"
    yield "\n### Bookkeeping\n"
    if found.bookkeeping is None:
        yield "\nThere is nothing valid to compare it with.\n"
    elif not found.bookkeeping:
        yield "\nUnchanged.\n"
    yield from map(_entry, found.bookkeeping or ())
    yield "\n"
    if known.files:
        yield f"\n### Files that the generator writes or removes: {len(known.files)}\n"
    for one in known.files:
        if one.after is None:
            yield f"\n- removed: {code(one.path)}"
    yield "\n"
    yield from (_file(one) for one in known.files if one.after is not None)


def _counted(releases: Iterable[ReleaseChange]) -> str:
    kinds = [release.change for release in releases]
    counts = [
        f"{kinds.count(kind)} {word}"
        for kind, word in (("start", "to start"), ("change", "to change"), ("stop", "to stop"))
        if kind in kinds
    ]
    return f"Releases: {', '.join(counts)}."


def _release(one: ReleaseChange) -> str:
    lines = [f"\n- {_VERBS[one.change]} {code(one.name)}: {code(one.what)}"]
    lines += [f"\n  - {code(detail)}" for detail in one.details]
    return "".join(lines)


def _entry(one: EntryChange) -> str:
    line = f"\n- {_ENTRY_VERBS[one.change]}: {one.kind} {code(one.name)}"
    if one.change != "changed":
        return f"{line} for {', '.join(map(code, one.requesters))}"
    facts = [f"\n  - no longer {code(fact)}" for fact in one.lost]
    facts += [f"\n  - now {code(fact)}" for fact in one.gained]
    return line + "".join(facts)


def _file(one: FileChange) -> str:
    return _folded(_plain(one.path), fence("\n".join(one.diff()), "diff"))


def _folded(summary: str, body: str) -> str:
    return f"\n<details><summary>{summary}</summary>\n\n{body}\n</details>\n"


def _plain(path: str) -> str:
    """Return a path for a summary, which takes HTML and no Markdown."""
    safe = re.sub(r"[^A-Za-z0-9_./-]", lambda char: f"&#{ord(char[0])};", path)
    return (
        f"<code>{safe[:_LONGEST_SPAN]}</code>" if len(safe) <= _LONGEST_SPAN else "<code>…</code>"
    )


def _bounded(parts: list[str], longest: int) -> str:
    """Return the parts one after the other, without those that there is no room for."""
    room = longest - _ROOM_FOR_NOTE
    taken, left = list[str](), 0
    for part in parts:
        if len(part) <= room:
            taken.append(part)
            room -= len(part)
        else:
            left += 1
    if left:
        many = "One part" if left == 1 else f"{left} parts"
        taken.append(
            f"\n{many} of this report left out, for a comment has a longest length; "
            "`demandops check` shows all.\n"
        )
    return "".join(taken)
