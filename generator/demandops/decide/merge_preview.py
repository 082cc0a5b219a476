"""The releases and files that differ between two commits, or before and after a merge.

A demand's changeset covers only the releases that the demand touches. A change of the configuration
may affect any release, so this module compares all. The functions here are pure.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Literal

from demandops.base.errors import Fault, InvalidInput
from demandops.base.strict_yaml import load_all, short_repr
from demandops.decide.changeset import ReleaseChange, describe_change
from demandops.decide.planning.planner import plan
from demandops.decide.planning.release_keys import ReleaseKey, all_keys, keys_of
from demandops.model.ledger import claim_file
from demandops.model.ledger.ledger import World
from demandops.model.release import Release
from demandops.render import manifests
from demandops.render.gitops import path_of
from demandops.templating.values import Evaluate

_MOST_FACTS = 20

# marks a missing value, because None is a value of YAML
ABSENT = object()


@dataclass(frozen=True, slots=True)
class FileChange:
    """The text of a generated file before and after a change; None if there is no such file."""

    path: str
    before: str | None
    after: str | None

    @property
    def change(self) -> Literal["added", "changed", "removed"]:
        if self.before is None:
            return "added"
        return "removed" if self.after is None else "changed"

    def diff(self) -> Iterator[str]:
        return difflib.unified_diff(
            (self.before or "").splitlines(),
            (self.after or "").splitlines(),
            self.path if self.before is not None else "/dev/null",
            self.path if self.after is not None else "/dev/null",
            lineterm="",
        )


@dataclass(frozen=True, slots=True)
class MergePreview:
    releases: tuple[ReleaseChange, ...]
    files: tuple[FileChange, ...]
    # the paths of the changed files that belong to no release
    other_files: tuple[str, ...]


def planned_releases(world: World) -> dict[ReleaseKey, Release]:
    releases: dict[ReleaseKey, Release] = {}
    for key in all_keys(world):
        with suppress(InvalidInput):
            release = plan(world, key)
            if release is not None:
                releases[key] = release
    return releases


def render_faults(world: World, evaluate: Evaluate, edited: Collection[str] = ()) -> list[Fault]:
    """Return the faults because of which releases cannot be planned or rendered.

    A fault's file is the first of these that exists: a file in ``edited`` with a claim that needs
    the release; the file that the fault names; the file of the first claim that needs the release.
    """
    errors: list[tuple[ReleaseKey, InvalidInput]] = []
    for key in all_keys(world):
        try:
            release = plan(world, key)
            if release is not None:
                manifests.render(release, world.config, evaluate)
        except InvalidInput as error:
            errors.append((key, error))
    if not errors:
        return []
    files: dict[ReleaseKey, list[str]] = {}
    for subject in sorted(world.ledger.claims, key=str):
        paths = [claim_file.path_of(claim.key) for claim in world.ledger.claims_on(subject)]
        for key in keys_of(world, subject):
            files.setdefault(key, []).extend(paths)
    faults: list[Fault] = []
    for key, failure in errors:
        claims = files.get(key, [])
        edited_claim = next((path for path in claims if path in edited), "")
        first = next(iter(claims), "")
        faults += [fault.within(edited_claim or fault.file or first) for fault in failure.faults]
    return list(dict.fromkeys(faults))


def preview(
    old: Mapping[ReleaseKey, Release],
    new: Mapping[ReleaseKey, Release],
    current: Mapping[str, str],
    files: Mapping[str, str],
) -> MergePreview:
    """Return what a merge changes; ``current`` and ``files`` are the texts before and after it."""
    file_changes = tuple(
        FileChange(path, current.get(path), files.get(path))
        for path in sorted({*current, *files})
        if current.get(path) != files.get(path)
    )
    changed = {change.path for change in file_changes}
    of_releases = set[str]()
    releases = []
    # a release whose key changes is paired with the former release of the same name
    gone = {release.name: release for key, release in old.items() if key not in new}
    pairs: list[tuple[Release | None, Release | None]] = [
        (old.get(key) or gone.pop(release.name, None), release) for key, release in new.items()
    ]
    pairs += [(release, None) for release in gone.values()]
    for before, after in pairs:
        old_path, new_path = (path_of(side) if side else "" for side in (before, after))
        # the files decide whether a release differs, because the clusters follow the files
        if not changed & {old_path, new_path}:
            continue
        of_releases |= {old_path, new_path}
        text = current.get(old_path or new_path)
        change = describe_change(before, after, text is not None)
        if change.change == "change" and old_path and old_path != new_path:
            moved = (f"- {old_path}", f"+ {new_path}")
            change = replace(change, details=(*moved, *change.details))
        elif change.change == "change" and not change.details:
            with suppress(InvalidInput):
                was, now = list(load_all(text or "")), list(load_all(files.get(new_path, "")))
                differing = list(leaf_differences(was, now))
                facts = []
                for path, *sides in differing[:_MOST_FACTS]:
                    shown = ("none" if side is ABSENT else short_repr(side) for side in sides)
                    facts.append(f"{path.removeprefix('[0].')}: {' → '.join(shown)}")
                if len(differing) > _MOST_FACTS:
                    facts.append(f"and {len(differing) - _MOST_FACTS} more")
                change = replace(change, details=tuple(facts))
        releases.append(change)
    releases.sort(key=lambda change: change.order)
    others = tuple(sorted(changed - of_releases))
    return MergePreview(tuple(releases), file_changes, others)


def leaf_differences(old: Any, new: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:  # noqa: ANN401
    """Yield (path, old, new) for each smallest part that differs; :data:`ABSENT` if missing."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in dict.fromkeys([*old, *new]):
            inner = f"{path}.{key}" if path else str(key)
            yield from leaf_differences(old.get(key, ABSENT), new.get(key, ABSENT), inner)
    # lists of different lengths are one part: it is not known which of their items is new
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for index, (left, right) in enumerate(zip(old, new, strict=True)):
            yield from leaf_differences(left, right, f"{path}[{index}]")
    elif type(old) is not type(new) or old != new:  # Python treats 1, 1.0 and True as equal
        yield path, old, new
