"""A checked-out state repo, as a person edits it: is what they are about to merge sound?

Compared with the commit that it started from: generated files are not edited by hand, and a chart
that changed has a new version, for Flux and Argo CD go by the version alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

import pygit2
from pygit2 import Commit, Repository

from generator import yamlio
from generator.catalog.catalog import CONFIG_ROOTS, Catalog
from generator.catalog.loading import load
from generator.catalog.override import written
from generator.decision import State, rehearse, rendered
from generator.errors import Fault, InvalidInput, StateRepoError, fault
from generator.ledger import format as ledger_format
from generator.ledger import markers
from generator.ledger.ledger import Ledger
from generator.plan.following import due
from generator.plan.survey import survey, warnings
from generator.settings import GENERATED_ROOTS, MAIN_BRANCH
from generator.staterepo import snapshot as snapshots
from generator.staterepo import tree as trees

_UPSTREAM = f"refs/remotes/origin/{MAIN_BRANCH}"


@dataclass(frozen=True, slots=True)
class Checked:
    """What a check found: faults to mend, generated files that the generator will rewrite, and
    what is no fault and may still not be meant.
    """

    faults: tuple[Fault, ...]
    outdated: tuple[str, ...]
    warnings: tuple[Fault, ...] = ()


def check(folder: Path, base: str | None = None, now: datetime | None = None) -> Checked:
    """Check the files of a folder, and that everything renders.

    Args:
        folder: a checked-out state repo, or an unpacked one without Git.
        base: the commit that the edit started from; where left out, where it left origin/main,
            or else HEAD.
        now: overrides that ended by then are not tried; the time of the day where left out.

    Raises:
        StateRepoError: where it is no state repo, or ``base`` is no commit.
    """
    if not (folder / "demandops.yaml").is_file():
        raise StateRepoError(
            f"{folder} is no state repo, for it has no demandops.yaml; `demandops init` makes one"
        )
    files = dict(_texts(folder))
    before = _base_files(folder, base)
    edits = [] if before is None else list(_hand_edits(files, before))
    faults = list[Fault]()
    try:
        catalog = load({p: t for p, t in files.items() if p.split("/")[0] in CONFIG_ROOTS})
        if before is not None:
            faults += _unversioned_charts(catalog, files, before)
        now = now or datetime.now(timezone.utc)
        catalog = _with_ended(catalog, files, now)
        state = State.of(catalog, _ledger(files, faults))
        rehearse(state)
        generated = {p: text for p, text in files.items() if p.split("/")[0] in GENERATED_ROOTS}
        wanted = rendered(state, generated)
    except InvalidInput as error:
        return Checked((*edits, *faults, *error.faults), ())
    # what follows from the books was not written by hand: a proposal brings both
    faults = [found for found in edits if wanted.get(found.file) != files.get(found.file)] + faults
    outdated = tuple(
        path
        for path in sorted({*wanted, *(p for p in files if p.split("/")[0] in GENERATED_ROOTS)})
        if wanted.get(path) != files.get(path) and not trees.is_note(path)
    )
    idle = warnings(survey(state.ledger, catalog, now))
    return Checked(tuple(faults), outdated, tuple(fault("", text).within(p) for p, text in idle))


def _with_ended(catalog: Catalog, files: Mapping[str, str], now: datetime) -> Catalog:
    """Return the catalog without the overrides that a generator ended, or would at once."""
    marked = {p: text for p, text in files.items() if p.startswith(f"{markers.MARKERS_ROOT}/")}
    catalog = catalog.with_ended(markers.read(marked))
    over = {one.name: written(one.end) for one in due(catalog, now) if one.end}
    return catalog.with_ended({**catalog.ended, **over})


def _ledger(files: Mapping[str, str], faults: list[Fault]) -> Ledger:
    ledger = Ledger()
    for path, text in sorted(files.items()):
        if ledger_format.kind_of(path) is None:
            continue
        try:
            claim = ledger_format.read(text, path)
        except InvalidInput as error:
            faults += error.faults
        else:
            ledger = ledger.replace(claim.key, claim)
    return ledger


def _texts(folder: Path) -> Iterator[tuple[str, str]]:
    for root in (*CONFIG_ROOTS, "ledger", *GENERATED_ROOTS):
        top = folder / root
        paths = [top] if top.is_file() else sorted(top.rglob("*"))
        for path in paths:
            if path.is_file():
                yield path.relative_to(folder).as_posix(), path.read_text(errors="replace")


def _base_files(folder: Path, base: str | None) -> dict[str, str] | None:
    """Return the files of the commit that an edit started from; nothing where Git knows none."""
    try:
        repo = Repository(str(folder))
    except pygit2.GitError:
        if base is not None:
            raise StateRepoError(f"{folder} is no Git checkout; leave out --base") from None
        return None
    if repo.is_empty:
        return None
    commit = snapshots.commit_of(repo, base) if base else _started_from(repo)
    return trees.texts(commit.tree, (*CONFIG_ROOTS, *GENERATED_ROOTS))


def _started_from(repo: Repository) -> Commit:
    head = repo.head.peel(Commit)
    if _UPSTREAM in repo.references:
        upstream = repo.references[_UPSTREAM].peel(Commit)
        common = repo.merge_base(head.id, upstream.id)
        if common is not None:
            return snapshots.commit_of(repo, common)
    return head


def _hand_edits(files: Mapping[str, str], before: Mapping[str, str]) -> Iterator[Fault]:
    for path in sorted({*files, *before}):
        if path.split("/")[0] not in GENERATED_ROOTS or trees.is_note(path):
            continue
        if files.get(path) != before.get(path):
            yield fault(
                "",
                "is generated, and an edit by hand is lost; take it back, and change the "
                "configuration that it follows from",
            ).within(path)


def _unversioned_charts(
    catalog: Catalog, files: Mapping[str, str], before: Mapping[str, str]
) -> Iterator[Fault]:
    sources = {
        source.folder: (name, source)
        for name, chart in sorted(catalog.charts.items())
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
        data = yamlio.load(text)
    except InvalidInput:
        return None
    return data.get("version") if isinstance(data, dict) else None
