"""The changes that a decision makes in the state repo: files by path, and how releases change.

A file whose text stays the same is not in the changeset, so an unchanged release needs no commit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

from demandops.config.config import Config
from demandops.config.repo_settings import ROOT_FILE
from demandops.errors import OverLimit, Refused, fault
from demandops.ledger import claim_file, kept_replicas, recent_shutdowns, waiting
from demandops.ledger.claim_changes import Changes
from demandops.ledger.world import World
from demandops.plan.checks import name_clash
from demandops.plan.planner import plan
from demandops.plan.release import Release, ServiceRelease
from demandops.plan.release_keys import ReleaseKey
from demandops.quoting import one_line
from demandops.render import release_file
from demandops.render.gitops import manifests
from demandops.render.gitops.paths import path_of
from demandops.render.output_check import check_files
from demandops.templating.values import Evaluate

Change = Literal["start", "change", "stop"]

# The kinds of changes, in the order in which lists of changes show them
CHANGE_ORDER: tuple[Change, ...] = ("start", "change", "stop")

# A function that returns the text of a state repo's file, or None if the file is missing
FileReader = Callable[[str], str | None]


@dataclass(frozen=True, slots=True)
class ReleaseChange:
    """A release that starts, changes or stops.

    ``details`` has a line for each changed fact of a release that changes; otherwise it is empty.
    """

    name: str
    what: str
    file: str
    change: Change
    details: tuple[str, ...] = ()

    @property
    def order(self) -> tuple[int, str]:
        """The key by which a list of changes is sorted."""
        return CHANGE_ORDER.index(self.change), self.name


@dataclass(frozen=True, slots=True)
class Changeset:
    """The files to write and the releases that change. A file whose text is None is removed."""

    files: Mapping[str, str | None]
    releases: tuple[ReleaseChange, ...]
    # The paths of the overrides that have an effect on the written files, ``hold`` included
    overrides: tuple[str, ...] = ()
    # A warning for each release that a ``hold`` override keeps from changing
    blocked: tuple[str, ...] = ()
    # Each release that the change may affect, as it is after the change; None if it is gone
    plans: Mapping[ReleaseKey, Release | None] = field(default_factory=dict)
    # Each release of ``plans``, as it was before the change. None if there was no such release, or
    # if it could not be planned.
    former: Mapping[ReleaseKey, Release | None] = field(default_factory=dict)


def build_changeset(  # noqa: PLR0913 - each is an input of its own
    before: World,
    after: World,
    changes: Changes,
    keys: Iterable[ReleaseKey],
    evaluate: Evaluate,
    read: FileReader,
    plans: Mapping[ReleaseKey, Release] = MappingProxyType({}),
    *,
    keeps_late: bool = False,
    checkpoint: Callable[[], None] = lambda: None,
) -> Changeset:
    """Return the changes in the state repo that follow from a change of the ledger.

    Args:
        before, after: the world before and after the change, with the same configuration.
        changes: the differences between both ledgers.
        keys: the keys of the releases that may differ
            (:func:`demandops.plan.release_keys.affected_keys`).
        evaluate: computes the values of services.
        read: returns the text of a file of the state repo before the change.
        plans: releases of ``before`` that the caller has planned already.
        keeps_late: whether a release whose values take too long to compute keeps its file, instead
            of OverLimit. A release that does not change keeps it in any case.
        checkpoint: called for each file and release; it may raise an exception to end the work.

    Raises:
        Refused, InvalidInput: if a release cannot be planned or rendered, or if a file would not be
            valid (:func:`demandops.render.output_check.check_files`) or would be too large.
    """
    files: dict[str, str | None] = {}
    most = after.config.repo_settings.limits.file_bytes
    for change in changes.claims:
        checkpoint()
        path = claim_file.path_of(change.key)
        files[path] = claim_file.text_of(change.after) if change.after else None
    # before anything is planned, because a claim's file is the smallest of the files that need it
    _refuse_large(files, most, read)
    for digest in changes.shutdowns:
        shutdown = after.ledger.shutdowns.by_digest.get(digest)
        files[recent_shutdowns.path_of(digest)] = (
            recent_shutdowns.text_of(shutdown) if shutdown else None
        )
    for instance in changes.kept:
        steps = after.ledger.kept.steps.get(instance)
        files[kept_replicas.path_of(instance)] = (
            kept_replicas.text_of(instance, steps) if steps else None
        )
    for demand in changes.waiting:
        waits = after.ledger.waiting.get(demand)
        files[waiting.path_of(demand)] = waiting.text_of(waits) if waits else None
    releases = []
    shaped: set[str] = set()
    blocked: list[str] = []
    now, former = dict[ReleaseKey, Release | None](), dict[ReleaseKey, Release | None]()
    for key in keys:  # all before any is rendered, because that takes longer
        checkpoint()
        now[key] = plan(after, key)
        former[key] = plans.get(key) or _plan_leniently(before, key)
    texts = _Texts(after.config, evaluate)
    for key, new in now.items():
        checkpoint()
        old = former[key]
        old_path = path_of(old) if old else None
        new_path = path_of(new) if new else None
        current = read(new_path) if new_path else None
        try:
            text = texts.of(new, current) if new else None
        except OverLimit:
            if keeps_late or old == new:  # what only renews a lease needs no template
                continue
            raise
        if old_path and old_path != new_path and read(old_path) is not None:
            files[old_path] = None
        blocked += _blocked(old, new) if current is not None else ()
        if new_path and text != current:
            files[new_path] = text
            shaped |= {override.path for override, _ in new.shaping.by} if new else set()
        if text is not None and text == current:
            continue
        if old or new:
            releases.append(describe_change(old, new, current is not None))
    _refuse_large(files, most, read)
    check_files(files, checkpoint)
    releases.sort(key=lambda change: change.order)
    return Changeset(files, tuple(releases), tuple(sorted(shaped)), tuple(blocked), now, former)


def _refuse_large(files: Mapping[str, str | None], most: int, read: FileReader) -> None:
    """Raise Refused if a file has more than ``most`` bytes and is larger than before."""
    faults = []
    for path, text in files.items():
        size = len(text.encode()) if text is not None and 4 * len(text) > most else 0
        if size > max(most, len((read(path) or "").encode()) if size > most else 0):
            message = (
                f"would have {size} bytes, but at most {most} are allowed; demand less, or ask a "
                f"platform engineer to raise limits.fileBytes in {ROOT_FILE}"
            )
            faults.append(fault("", message, code="too-large").within(path))
    if faults:
        raise Refused(faults)


def render_all(
    world: World,
    evaluate: Evaluate,
    keys: Iterable[ReleaseKey],
    current: Mapping[str, str],
    *,
    keeps_late: bool = False,
) -> dict[str, str]:
    """Return all generated files except those of the ledger, by path.

    Args:
        world: the configuration and the ledger.
        evaluate: computes the values of services.
        keys: the keys of all releases (:func:`demandops.plan.release_keys.all_keys`).
        current: the generated files in the state repo, which ``hold`` overrides may preserve.
        keeps_late: whether a release whose values take too long to compute keeps its file, instead
            of OverLimit.

    Raises:
        Refused, InvalidInput: if a release cannot be planned or rendered, or if two need one name.
    """
    config = world.config
    files = manifests.base_files(config)
    texts = _Texts(config, evaluate)
    keys = tuple(keys)
    name_clash.refuse_shared_names(world, keys)
    for key in keys:
        release = plan(world, key)
        if release is None:
            continue
        path = path_of(release)
        try:
            files[path] = texts.of(release, current.get(path))
        except OverLimit:
            if not keeps_late:
                raise
            if path in current:
                files[path] = current[path]
    return files | release_file.kept_charts(files, current, world)


class _Texts:
    """The texts of releases. A template that took too long for one is not tried for others."""

    def __init__(self, config: Config, evaluate: Evaluate) -> None:
        self._config, self._evaluate = config, evaluate
        self._late: dict[str, OverLimit] = {}

    def of(self, release: Release, current: str | None) -> str:
        """Return the text of a release's file; ``current`` is its text in the state repo.

        Raises OverLimit if the release, or an earlier one of its template, takes too long.
        """
        template = ""
        if isinstance(release, ServiceRelease):
            template = self._config.values_template(release.service)
        if template in self._late:
            raise self._late[template]
        try:
            return release_file.release_text(release, self._config, self._evaluate, current)
        except OverLimit as error:
            self._late[template] = error
            raise


def _plan_leniently(world: World, key: ReleaseKey) -> Release | None:
    try:
        return plan(world, key)
    except Refused:
        return None


def describe_change(old: Release | None, new: Release | None, existed: bool) -> ReleaseChange:
    """Return how a release changes; ``existed`` is true if the release had a file before.

    ``old`` or ``new`` is None if the release does not exist before or after the change, but not
    both.
    """
    release = new or old
    assert release is not None  # noqa: S101 - a change has at least one side
    kind: Change = "stop" if not new else "change" if existed else "start"
    details = _differences(old, new) if new and existed else ()
    return ReleaseChange(release.name, release.description, path_of(release), kind, details)


def _differences(old: Release | None, new: Release) -> tuple[str, ...]:
    before, after = _overrides(old), _overrides(new)
    if not new.shaping.held:  # in a held file, only the comments that name overrides change
        before = (old.facts() if old else []) + before
        after = new.facts() + after
    old_facts, new_facts = frozenset(before), frozenset(after)
    removed = [f"- {one_line(fact)}" for fact in before if fact not in new_facts]
    added = [f"+ {one_line(fact)}" for fact in after if fact not in old_facts]
    return (*removed, *added)


def _blocked(old: Release | None, new: Release | None) -> Iterator[str]:
    """Yield a warning if an override with the effect ``hold`` prevents a change of a release."""
    if new is None or not new.shaping.held or (old and old.facts()) == new.facts():
        return
    by = " and ".join(override.path for override, effects in new.shaping.by if "hold" in effects)
    yield f"{new.name} will not change until the 'hold' of {by} ends"


def _overrides(release: Release | None) -> list[str]:
    by = release.shaping.by if release is not None else ()
    return [f"{override.path}: {', '.join(effects)}" for override, effects in by]
