"""Whether an edit of a checked-out state repo can be merged, and what merging would do.

All files must be valid and render, generated files must not have manual edits, and a changed chart
must have a new version, because Flux and Argo CD compare only versions. The edit is compared with
the commit that it started from. The result also previews desired state and bookkeeping.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path

from demandops import strict_yaml
from demandops.config.config import CONFIG_ROOTS, Config
from demandops.config.load import load
from demandops.config.override import format_time
from demandops.config.repo_settings import ROOT_FILE
from demandops.decision import State, rendered_files, try_configuration
from demandops.errors import Fault, InvalidInput, fault
from demandops.ledger import claim_file, ended_override_file
from demandops.ledger.ledger import Ledger
from demandops.plan.overrides.lifecycle import expired_overrides, update_ledger
from demandops.plan.release import Release
from demandops.plan.release_keys import ReleaseKey
from demandops.plan.views.bookkeeping import bookkeeping
from demandops.plan.views.bookkeeping_diff import EntryChange, bookkeeping_changes
from demandops.plan.views.override_report import override_report, warnings
from demandops.render.changes import merge_preview
from demandops.render.changes.merge_preview import MergePreview
from demandops.render.changes.override_suggestion import Suggestion
from demandops.settings import GENERATED_ROOTS, RENDER_VERSION
from demandops.staterepo.git import tree as trees
from demandops.staterepo.load import ledger_files
from demandops.staterepo.pull_request import manual_edits
from demandops.staterepo.pull_request.worktree import Base, author_of, base_of, files_of


@dataclass(frozen=True, slots=True)
class CheckResult:
    """The result of a check.

    ``preview`` is None if the files are not valid; ``bookkeeping`` is also None if no valid commit
    can be compared with. ``base`` is the commit compared with, if any; if its files are not valid
    (``base_valid``), their last valid versions are used. ``warnings`` are likely mistakes.
    """

    faults: tuple[Fault, ...]
    suggestions: tuple[Suggestion, ...] = ()
    preview: MergePreview | None = None
    bookkeeping: tuple[EntryChange, ...] | None = None
    base: str | None = None
    base_valid: bool = True
    warnings: tuple[Fault, ...] = ()


def check(folder: Path, base: str | None = None, now: datetime | None = None) -> CheckResult:
    """Check the files of a folder, render them, and preview what merging would do.

    Args:
        folder: a checked-out state repo, or its files without Git.
        base: the merge target; by default ``origin/main``, else ``main``. The edit is compared
            with the common ancestor.
        now: overrides that ended by then are left out; by default the current time.

    Raises:
        StateRepoError: it is not a state repo, ``base`` is not a commit, or the clone is too
            shallow.
    """
    files, faults = files_of(folder)
    start = base_of(folder, base)
    before = start.files if start else files
    claims = ledger_files.read(sorted(files.items()))
    faults += claims.faults
    result = CheckResult((), base=start.commit if start else None)
    result = replace(result, base_valid=start is None or start.valid)
    edited = manual_edits.changed_paths(files, before)
    try:
        now = now or datetime.now(timezone.utc)
        state = _state(files, before, claims.ledger(), faults, now)
        changed = [path for path in {*files, *before} if files.get(path) != before.get(path)]
        state = _applied(state, start, changed, files, now)
        current = {
            path: text
            for path, text in before.items()
            if _generated(path) and not trees.is_readme(path)
        }
        wanted = _rendered(state, current, changed)
    except InvalidInput as error:
        refused, suggested = _manual_edits(folder, files, start, edited)
        faults += error.faults
        return replace(result, faults=_ordered([*faults, *refused]), suggestions=suggested)
    # a proposal or an upgrade contains exactly what the generator would write: not a manual edit
    edited = [
        path for path in edited if not _generated(path) or files.get(path) != wanted.get(path)
    ]
    refused, suggested = _manual_edits(folder, files, start, edited)
    new = merge_preview.planned_releases(state.ledger, state.config)
    old = new if start is None else _releases(start)
    return replace(
        result,
        faults=_ordered([*faults, *refused]),
        suggestions=suggested,
        preview=merge_preview.preview(old, new, current, wanted),
        bookkeeping=_bookkeeping_changes(start, state),
        warnings=_warnings(state, now),
    )


def _ordered(faults: list[Fault]) -> tuple[Fault, ...]:
    return tuple(sorted(dict.fromkeys(faults), key=lambda fault: fault.file))


def _generated(path: str) -> bool:
    return path.split("/", maxsplit=1)[0] in GENERATED_ROOTS


def _state(
    files: Mapping[str, str],
    before: Mapping[str, str],
    ledger: Ledger,
    faults: list[Fault],
    now: datetime,
) -> State:
    """Return the state of the files; add faults that do not prevent rendering to ``faults``."""
    config = load({p: t for p, t in files.items() if p.split("/")[0] in CONFIG_ROOTS})
    version = config.repo_settings.render_version
    if version < RENDER_VERSION:
        message = (
            f"is {version}, but this program renders version {RENDER_VERSION}; check with the "
            "generator's version of the program, or run `demandops upgrade` to render everything "
            "again"
        )
        raise InvalidInput([fault("renderVersion", message).within(ROOT_FILE)])
    faults += _unversioned_charts(config, files, before)
    config = _with_ended(config, files, now)
    state = State.of(config, ledger)
    try_configuration(state)
    return state


def _applied(
    state: State,
    start: Base | None,
    changed: Collection[str],
    files: Mapping[str, str],
    now: datetime,
) -> State:
    """Return the state after the generator has applied the change."""
    if start is None or start.state is None:
        return state
    old, new = start.state.ledger, state.ledger
    subjects = [
        claim.subject
        for ledger in (old, new)
        for claim in ledger
        if claim_file.path_of(claim.key) in changed
    ]
    applied = update_ledger(start.state, state, dict.fromkeys(subjects), _marked(files), now)
    return replace(state, ledger=applied.ledger, config=applied.config)


def _marked(files: Mapping[str, str]) -> dict[str, str]:
    return {
        p: text for p, text in files.items() if p.startswith(f"{ended_override_file.MARKERS_ROOT}/")
    }


def _with_ended(config: Config, files: Mapping[str, str], now: datetime) -> Config:
    """Return the configuration without overrides that have ended or expired."""
    config = config.with_ended_overrides(ended_override_file.read(_marked(files)))
    expired = {one.name: format_time(one.end) for one in expired_overrides(config, now) if one.end}
    return config.with_ended_overrides({**config.ended_overrides, **expired})


def _warnings(state: State, now: datetime) -> tuple[Fault, ...]:
    idle = warnings(override_report(state.ledger, state.config, now))
    return tuple(fault("", text).within(path) for path, text in idle)


def _rendered(state: State, current: Mapping[str, str], edited: Collection[str]) -> dict[str, str]:
    """Return every generated file, or raise the faults of every release."""
    try:
        return rendered_files(state, current)
    except InvalidInput as error:
        faults = merge_preview.render_faults(state.ledger, state.config, state.engine, edited)
        raise InvalidInput(faults or error.faults) from None


def _releases(start: Base) -> dict[ReleaseKey, Release]:
    if start.state is None:
        return {}
    return merge_preview.planned_releases(start.state.ledger, start.state.config)


def _bookkeeping_changes(start: Base | None, state: State) -> tuple[EntryChange, ...] | None:
    if start is None:
        return ()
    if start.state is None:
        return None
    try:
        old = bookkeeping(start.state.ledger, start.state.config)
    except InvalidInput:
        return None
    return bookkeeping_changes(old, bookkeeping(state.ledger, state.config))


def _manual_edits(
    folder: Path, files: Mapping[str, str], start: Base | None, edited: list[str]
) -> tuple[list[Fault], tuple[Suggestion, ...]]:
    if start is None or not edited:
        return [], ()
    return manual_edits.faults_and_suggestions(files, start, edited, author_of(folder))


def _unversioned_charts(
    config: Config, files: Mapping[str, str], before: Mapping[str, str]
) -> Iterator[Fault]:
    sources = {
        source.folder: (name, source)
        for name, chart in sorted(config.charts.items())
        for source in chart.sources()
        if source.folder
    }
    for folder, (name, source) in sorted(sources.items()):
        metadata, prefix = f"{folder}/Chart.yaml", f"{folder}/"
        if metadata not in before:
            continue
        changed = [
            path
            for path in sorted({*files, *before})
            if path.startswith(prefix) and files.get(path) != before.get(path)
        ]
        if changed and _version(before[metadata]) == source.version:
            yield fault(
                "version",
                f"is still {source.version}, but {changed[0].removeprefix(prefix)} changed; raise "
                f"it here and at charts.{name} in registry/charts.yaml, or no cluster applies it",
            ).within(metadata)


def _version(text: str) -> object:
    try:
        data = strict_yaml.load(text)
    except InvalidInput:
        return None
    return data.get("version") if isinstance(data, dict) else None
