"""What a change of configuration or books would do to everything that is rendered. Pure.

Unlike a demand's changeset, which looks at what it touches, this looks at everything, for
configuration may change anything.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

from demandops import strict_yaml
from demandops.config.config import Config
from demandops.demand.claim import Subject, SubjectKind
from demandops.errors import Fault, InvalidInput
from demandops.ledger import claim_file
from demandops.ledger.ledger import Ledger
from demandops.plan.planner import plan
from demandops.plan.release import Release
from demandops.plan.release_keys import ReleaseKey, all_keys, keys_of
from demandops.render.changes.changeset import ReleaseChange, described
from demandops.render.changes.data_diff import leaves
from demandops.render.changes.override_suggestion import value_of
from demandops.render.engine import Engine
from demandops.render.gitops import controller
from demandops.render.gitops.paths import path_of

_MOST_FACTS = 20


@dataclass(frozen=True, slots=True)
class FileChange:
    """A generated file as it is and as it would be; nothing: it is not there."""

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
    """The releases that would start, change or stop, and every file that would be written."""

    releases: tuple[ReleaseChange, ...]
    files: tuple[FileChange, ...]


def releases_of(ledger: Ledger, config: Config) -> dict[ReleaseKey, Release]:
    """Return what runs; what cannot be planned any more is passed over."""
    found: dict[ReleaseKey, Release] = {}
    for key in all_keys(ledger, config):
        try:
            release = plan(ledger, config, key)
        except InvalidInput:
            continue
        if release is not None:
            found[key] = release
    return found


def faults(
    ledger: Ledger, config: Config, engine: Engine, edited: Collection[str] = ()
) -> list[Fault]:
    """Return what keeps releases from being planned or rendered, of all of them.

    Each is told to be in the claim among those that ask for the release that is in ``edited``, or
    else where it is, or in any of these claims.
    """
    found: list[Fault] = []
    asking: dict[ReleaseKey, list[str]] = {}
    for key in all_keys(ledger, config):
        try:
            release = plan(ledger, config, key)
            if release is not None:
                controller.render(release, config, engine)
        except InvalidInput as error:
            asking = asking or _claim_files(ledger, config)
            found += _located(error.faults, asking.get(key, []), edited)
    return list(dict.fromkeys(found))


def _claim_files(ledger: Ledger, config: Config) -> dict[ReleaseKey, list[str]]:
    """Return by release the files of the claims that ask for it."""
    found: dict[ReleaseKey, list[str]] = {}
    for subject in (Subject(kind, id) for kind in SubjectKind for id in ledger.subjects(kind)):
        files = [claim_file.path_of(claim.key) for claim in ledger.claims_on(subject)]
        for key in keys_of(ledger, config, subject):
            found.setdefault(key, []).extend(files)
    return found


def _located(
    faults: Iterable[Fault], claims: list[str], edited: Collection[str]
) -> Iterator[Fault]:
    ours = next((path for path in claims if path in edited), "")
    for found in faults:
        place = ours or found.file or (claims or [""])[0]
        yield replace(found, file=place)


def consequence(
    old: Mapping[ReleaseKey, Release],
    new: Mapping[ReleaseKey, Release],
    standing: Mapping[str, str],
    files: Mapping[str, str],
) -> MergePreview:
    """Return what it takes to get from what stands to what is wanted.

    Args:
        old, new: the releases before and after.
        standing, files: the generated files before and after.
    """
    changes = tuple(
        FileChange(path, standing.get(path), files.get(path))
        for path in sorted({*standing, *files})
        if standing.get(path) != files.get(path)
    )
    touched = {change.path for change in changes}
    told = []
    for key in dict.fromkeys([*old, *new]):
        was, will = old.get(key), new.get(key)
        before = path_of(was) if was else None
        after = path_of(will) if will else None
        if before not in touched and after not in touched:
            continue
        stands = standing.get(before or after or "")
        change = described(was, will, stands is not None)
        if change.change == "change" and not change.details:
            facts = _facts(stands or "", files.get(after or "", ""))
            change = replace(change, details=tuple(facts))
        told.append(change)
    order = ["start", "change", "stop"]
    told.sort(key=lambda change: (order.index(change.change), change.name))
    return MergePreview(tuple(told), changes)


def _facts(before: str, after: str) -> Iterator[str]:
    """Yield what differs in a manifest, for a change that the plan has no words for."""
    try:
        differing = list(
            leaves(list(strict_yaml.load_all(before)), list(strict_yaml.load_all(after)))
        )
    except InvalidInput:
        return
    for path, old, new in differing[:_MOST_FACTS]:
        yield f"{path.removeprefix('[0].')}: {value_of(old)} → {value_of(new)}"
    if len(differing) > _MOST_FACTS:
        yield f"and {len(differing) - _MOST_FACTS} more"
