"""A checked-out state repo, as a person edits it: is what they are about to merge sound?

Compared with the commit that the edit started from: all is valid and renders, generated files are
not edited by hand, and a chart that changed has a new version, for Flux and Argo CD go by the
version alone. Beside the faults stands what merging would do, to the desired state and to the
bookkeeping.
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
from demandops.staterepo.pull_request import manual_edits
from demandops.staterepo.pull_request.worktree import Base, author_of, base_of, files_of


@dataclass(frozen=True, slots=True)
class Checked:
    """What a check found.

    ``consequence`` is missing where the files are not valid; ``books`` is missing there too, and
    where there is nothing valid to compare with. ``base`` is what was compared with, if anything;
    where its own files are not valid (``base_in_force``), the last valid ones stand in. What is in
    ``warnings`` is no fault and may still not be meant.
    """

    faults: tuple[Fault, ...]
    suggestions: tuple[Suggestion, ...] = ()
    consequence: MergePreview | None = None
    books: tuple[EntryChange, ...] | None = None
    base: str | None = None
    base_in_force: bool = True
    warnings: tuple[Fault, ...] = ()


def check(folder: Path, base: str | None = None, now: datetime | None = None) -> Checked:
    """Check the files of a folder, that everything renders, and what follows from the edit.

    Args:
        folder: a checked-out state repo, or an unpacked one without Git.
        base: what the edit is to be merged into; by default ``origin/main``, or ``main``. It is
            compared with where the work tree left that.
        now: overrides that ended by then are not tried; the time of the day where left out.

    Raises:
        StateRepoError: where it is no state repo, or ``base`` is no commit, or the clone is too
            shallow to tell.
    """
    files, faults = files_of(folder)
    start = base_of(folder, base)
    before = start.files if start else files
    ledger = _ledger(files, faults)
    found = Checked((), base=start.commit if start else None)
    found = replace(found, base_in_force=start is None or start.in_force)
    edited = manual_edits.edited(files, before)
    try:
        moment = now or datetime.now(timezone.utc)
        state = _state(files, before, ledger, faults, moment)
        claims = [path for path in {*files, *before} if files.get(path) != before.get(path)]
        state = _taken_in(state, start, claims, files, moment)
        standing = {
            path: text
            for path, text in before.items()
            if _generated(path) and not trees.is_note(path)
        }
        wanted = _wanted(state, standing, claims)
    except InvalidInput as error:
        refused, suggested = _hand_edits(folder, files, start, edited)
        faults += error.faults
        return replace(found, faults=_ordered([*faults, *refused]), suggestions=suggested)
    # what the generator would write all the same is no edit: a proposal of its own, an upgrade
    edited = [
        path for path in edited if not _generated(path) or files.get(path) != wanted.get(path)
    ]
    refused, suggested = _hand_edits(folder, files, start, edited)
    new = merge_preview.planned_releases(state.ledger, state.config)
    old = new if start is None else _releases(start)
    return replace(
        found,
        faults=_ordered([*faults, *refused]),
        suggestions=suggested,
        consequence=merge_preview.preview(old, new, standing, wanted),
        books=_books(start, state),
        warnings=_warnings(state, moment),
    )


def _ordered(faults: list[Fault]) -> tuple[Fault, ...]:
    return tuple(sorted(dict.fromkeys(faults), key=lambda found: found.file))


def _generated(path: str) -> bool:
    return path.split("/", maxsplit=1)[0] in GENERATED_ROOTS


def _ledger(files: Mapping[str, str], faults: list[Fault]) -> Ledger:
    ledger = Ledger()
    for path, text in sorted(files.items()):
        if claim_file.kind_of(path) is None:
            continue
        try:
            claim = claim_file.read(text, path)
        except InvalidInput as error:
            faults += error.faults
        else:
            ledger = ledger.replace(claim.key, claim)
    return ledger


def _state(
    files: Mapping[str, str],
    before: Mapping[str, str],
    ledger: Ledger,
    faults: list[Fault],
    now: datetime,
) -> State:
    """Return what the files say; faults that do not keep it from being rendered are put down."""
    config = load({p: t for p, t in files.items() if p.split("/")[0] in CONFIG_ROOTS})
    version = config.repo_settings.render_version
    if version < RENDER_VERSION:
        message = (
            f"is {version}, but this program renders version {RENDER_VERSION}; check with the "
            "program that the generator runs, or have all rendered anew by `demandops upgrade`"
        )
        raise InvalidInput([fault("renderVersion", message).within(ROOT_FILE)])
    faults += _unversioned_charts(config, files, before)
    config = _with_ended(config, files, now)
    state = State.of(config, ledger)
    try_configuration(state)
    return state


def _taken_in(
    state: State,
    start: Base | None,
    changed: Collection[str],
    files: Mapping[str, str],
    now: datetime,
) -> State:
    """Return the books as the generator would have them once it took the change in."""
    if start is None or start.state is None:
        return state
    old, new = start.state.ledger, state.ledger
    subjects = [
        claim.subject
        for books in (old, new)
        for claim in books
        if claim_file.path_of(claim.key) in changed
    ]
    before, after = (old, start.state.config), (new, state.config)
    taken = update_ledger(before, after, dict.fromkeys(subjects), _marked(files), now)
    return replace(state, ledger=taken.ledger, config=taken.config)


def _marked(files: Mapping[str, str]) -> dict[str, str]:
    return {
        p: text for p, text in files.items() if p.startswith(f"{ended_override_file.MARKERS_ROOT}/")
    }


def _with_ended(config: Config, files: Mapping[str, str], now: datetime) -> Config:
    """Return the configuration without the overrides that a generator ended, or would at once."""
    config = config.with_ended_overrides(ended_override_file.read(_marked(files)))
    over = {one.name: format_time(one.end) for one in expired_overrides(config, now) if one.end}
    return config.with_ended_overrides({**config.ended_overrides, **over})


def _warnings(state: State, now: datetime) -> tuple[Fault, ...]:
    idle = warnings(override_report(state.ledger, state.config, now))
    return tuple(fault("", text).within(path) for path, text in idle)


def _wanted(state: State, standing: Mapping[str, str], edited: Collection[str]) -> dict[str, str]:
    """Return every generated file; of what cannot be rendered, the faults of every release."""
    try:
        return rendered_files(state, standing)
    except InvalidInput as error:
        found = merge_preview.render_faults(state.ledger, state.config, state.engine, edited)
        raise InvalidInput(found or error.faults) from None


def _releases(start: Base) -> dict[ReleaseKey, Release]:
    if start.state is None:
        return {}
    return merge_preview.planned_releases(start.state.ledger, start.state.config)


def _books(start: Base | None, state: State) -> tuple[EntryChange, ...] | None:
    if start is None:
        return ()
    if start.state is None:
        return None
    try:
        old = bookkeeping(start.state.ledger, start.state.config)
    except InvalidInput:
        return None
    return bookkeeping_changes(old, bookkeeping(state.ledger, state.config))


def _hand_edits(
    folder: Path, files: Mapping[str, str], start: Base | None, edited: list[str]
) -> tuple[list[Fault], tuple[Suggestion, ...]]:
    if start is None or not edited:
        return [], ()
    return manual_edits.refused(files, start, edited, author_of(folder))


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
                f"it here and at charts.{name} in registry/charts.yaml, or no cluster takes it",
            ).within(metadata)


def _version(text: str) -> object:
    try:
        data = strict_yaml.load(text)
    except InvalidInput:
        return None
    return data.get("version") if isinstance(data, dict) else None
