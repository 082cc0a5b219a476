"""The effect of a changed configuration or ledger on all releases and files. Pure.

A demand's changeset covers only the releases that the demand touches. A change of the configuration
may affect any release, so this compares all of them.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

from demandops import strict_yaml
from demandops.errors import Fault, InvalidInput
from demandops.ledger import claim_file
from demandops.ledger.world import World
from demandops.plan.planner import plan
from demandops.plan.release import Release
from demandops.plan.release_keys import ReleaseKey, all_keys, keys_of
from demandops.render.changes.changeset import CHANGE_ORDER, ReleaseChange, describe_change
from demandops.render.changes.data_diff import leaf_differences, short_value
from demandops.render.engine import Engine
from demandops.render.gitops import manifests
from demandops.render.gitops.paths import path_of
from demandops.subject import Subject, SubjectKind

_MOST_FACTS = 20


@dataclass(frozen=True, slots=True)
class FileChange:
    """A generated file before and after; ``None`` if it does not exist."""

    path: str
    before: str | None
    after: str | None

    def diff(self) -> Iterator[str]:
        """Yield the lines of a unified diff."""
        return difflib.unified_diff(
            (self.before or "").splitlines(),
            (self.after or "").splitlines(),
            self.path if self.before is not None else "/dev/null",
            self.path if self.after is not None else "/dev/null",
            lineterm="",
        )


@dataclass(frozen=True, slots=True)
class MergePreview:
    """The releases that would start, change or stop, and the files that would change."""

    releases: tuple[ReleaseChange, ...]
    files: tuple[FileChange, ...]


def planned_releases(world: World) -> dict[ReleaseKey, Release]:
    """Return all releases that can be planned."""
    releases: dict[ReleaseKey, Release] = {}
    for key in all_keys(world):
        try:
            release = plan(world, key)
        except InvalidInput:
            continue
        if release is not None:
            releases[key] = release
    return releases


def render_faults(world: World, engine: Engine, edited: Collection[str] = ()) -> list[Fault]:
    """Return the faults that keep releases from being planned or rendered.

    A fault's file is the first that exists: a claim of the release that is in ``edited``, the
    fault's own file, any claim of the release.

    Args:
        world: the configuration and the claims.
        engine: the configuration's engine.
        edited: the files that a person changed.
    """
    faults: list[Fault] = []
    claim_files: dict[ReleaseKey, list[str]] = {}
    for key in all_keys(world):
        try:
            release = plan(world, key)
            if release is not None:
                manifests.render(release, world.config, engine)
        except InvalidInput as error:
            claim_files = claim_files or _claim_files(world)
            faults += _located(error.faults, claim_files.get(key, []), edited)
    return list(dict.fromkeys(faults))


def _claim_files(world: World) -> dict[ReleaseKey, list[str]]:
    """Return the files of the claims that need a release, by release."""
    by_release: dict[ReleaseKey, list[str]] = {}
    for subject in (
        Subject(kind, id) for kind in SubjectKind for id in world.ledger.subjects(kind)
    ):
        files = [claim_file.path_of(claim.key) for claim in world.ledger.claims_on(subject)]
        for key in keys_of(world, subject):
            by_release.setdefault(key, []).extend(files)
    return by_release


def _located(
    faults: Iterable[Fault], claims: list[str], edited: Collection[str]
) -> Iterator[Fault]:
    edited_claim = next((path for path in claims if path in edited), "")
    for fault in faults:
        yield replace(fault, file=edited_claim or fault.file or (claims or [""])[0])


def preview(
    old: Mapping[ReleaseKey, Release],
    new: Mapping[ReleaseKey, Release],
    current: Mapping[str, str],
    files: Mapping[str, str],
) -> MergePreview:
    """Return the releases and files that change.

    Args:
        old, new: the releases before and after.
        current, files: the generated files before and after.
    """
    file_changes = tuple(
        FileChange(path, current.get(path), files.get(path))
        for path in sorted({*current, *files})
        if current.get(path) != files.get(path)
    )
    changed_paths = {change.path for change in file_changes}
    releases = []
    for key in dict.fromkeys([*old, *new]):
        before, after = old.get(key), new.get(key)
        old_path = path_of(before) if before else None
        new_path = path_of(after) if after else None
        if old_path not in changed_paths and new_path not in changed_paths:
            continue
        text = current.get(old_path or new_path or "")
        change = describe_change(before, after, text is not None)
        if change.change == "change" and not change.details:
            facts = _facts(text or "", files.get(new_path or "", ""))
            change = replace(change, details=tuple(facts))
        releases.append(change)
    releases.sort(key=lambda change: (CHANGE_ORDER.index(change.change), change.name))
    return MergePreview(tuple(releases), file_changes)


def _facts(before: str, after: str) -> Iterator[str]:
    """Yield the differences between two manifests, if no fact of the plan describes them."""
    try:
        differing = list(
            leaf_differences(list(strict_yaml.load_all(before)), list(strict_yaml.load_all(after)))
        )
    except InvalidInput:
        return
    for path, old, new in differing[:_MOST_FACTS]:
        yield f"{path.removeprefix('[0].')}: {short_value(old)} → {short_value(new)}"
    if len(differing) > _MOST_FACTS:
        yield f"and {len(differing) - _MOST_FACTS} more"
