"""The world at one commit, what a change makes of it, and the files that follow from it."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from functools import cached_property
from types import MappingProxyType
from typing import Any, Literal, get_args

from rpds import HashTrieMap

from demandops.base.errors import Fault, InvalidInput, OverLimit, Refused, fault
from demandops.base.quoting import one_line, some
from demandops.base.strict_yaml import load_all, short_repr
from demandops.decide.booking import apply
from demandops.decide.checks import collisions, forbidden
from demandops.decide.checks.collisions import Names
from demandops.decide.checks.forbidden import Usage
from demandops.decide.planning.overrides import apply_effects, effects_on
from demandops.decide.planning.planner import (
    ReleaseKey,
    affected_keys,
    all_keys,
    keys_of,
    plan,
    planned,
)
from demandops.model.config.appdef import ApplicationDefinition
from demandops.model.config.config import Config
from demandops.model.config.override import OVERRIDES_ROOT
from demandops.model.config.repo_settings import ROOT_FILE
from demandops.model.demand.demand import Application, Demand, InputTopic, Item
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger import records
from demandops.model.ledger.ledger import Changes, ClaimChange, Ledger, World
from demandops.model.release import Release, ServiceRelease
from demandops.render import gitops
from demandops.render.gitops import path_of
from demandops.templating.values import Evaluate


@dataclass(frozen=True)  # without slots, so that it can keep what it has counted
class State(World):
    evaluate: Evaluate

    # A copy made with ``replace`` has none of these; the methods below carry over what is valid.

    @cached_property
    def plans(self) -> HashTrieMap[ReleaseKey, Release]:
        # of earlier decisions on this configuration, so that none plans what another has planned
        return HashTrieMap()

    @cached_property
    def usage(self) -> Usage:
        return forbidden.whole_usage(self)

    @cached_property
    def names(self) -> Names:
        return collisions.all_names(self)

    def followed_by(
        self, ledger: Ledger, planned: PlannedChange, usage: Usage, names: Names
    ) -> State:
        plans = self.plans
        for key, release in planned.plans.items():
            plans = plans.insert(key, release) if release else plans.discard(key)
        state = replace(self, ledger=ledger)
        vars(state).update(plans=plans, usage=usage, names=names)
        return state

    def with_nodes(self, config: Config) -> State:
        """Return the state with nodes that differ only in what a choice of nodes depends on.

        Nothing that runs differs, so all that was counted of it stays valid.
        """
        valid = {"names"}
        if config.limits_capacity == self.config.limits_capacity:
            valid.add("usage")
        state = replace(self, config=config)
        vars(state).update({name: kept for name, kept in vars(self).items() if name in valid})
        return state

    def with_ledger(self, ledger: Ledger, changes: Iterable[ClaimChange]) -> State:
        state, changes = replace(self, ledger=ledger), tuple(changes)
        # If a definition is gone, ``names`` and ``usage`` look at all releases again.
        with suppress(Refused):
            if "names" in vars(self):
                keys = affected_keys(self, state, changes)
                vars(state)["names"] = collisions.followed(self.names, self, state, keys)
        with suppress(Refused):
            if "usage" in vars(self):
                grown = forbidden.growth_by(self, state, changes)
                vars(state)["usage"] = self.usage.plus(grown)
        return state


# ---- the changes that a decision makes: files by path, and how releases change ----
#
# A file whose text stays the same is not in the changeset, so an unchanged release needs no commit.

Change = Literal["start", "change", "stop"]

# the order in which lists of changes show them
CHANGE_ORDER: tuple[Change, ...] = ("start", "change", "stop")

# returns the text of a state repo's file, or None if the file is missing
FileReader = Callable[[str], str | None]


# what a change does to the pods of a release; empty if nothing
Effect = Literal["starts", "restarts", "reconfigures", "stops", ""]

# values of every chart that do not restart the pods that run
_ALWAYS_LIVE = frozenset({"replicas", "autoscaler"})


@dataclass(frozen=True, slots=True)
class ReleaseChange:
    """A release that starts, changes or stops; ``details`` has a line for each changed fact."""

    name: str
    what: str
    file: str
    change: Change
    details: tuple[str, ...] = ()
    effect: Effect = ""

    @property
    def title(self) -> str:
        # a sign before it says what starts and what stops
        effect = f", {self.effect}" if self.change == "change" and self.effect else ""
        return f"{self.name} ({self.what}){effect}"


_MOST_NAMES = 5


def effects_of(releases: Collection[ReleaseChange]) -> Iterator[str]:
    """Yield what a receipt says of each effect, such as "reconfigures of-edge-fusion"."""
    for effect in get_args(Effect):
        names = [each.name for each in releases if effect and each.effect == effect]
        if names:
            yield f"{effect} {some(names, _MOST_NAMES)}"


@dataclass(frozen=True, slots=True)
class PlannedChange:
    """What a change of the ledger writes there, and the releases that it may affect."""

    ledger_files: Mapping[str, str | None]
    # each release that the change may affect, as it is after the change; None if it is gone
    plans: Mapping[ReleaseKey, Release | None]
    # the same releases before the change; None if there was none, or if it could not be planned
    former: Mapping[ReleaseKey, Release | None]


@dataclass(frozen=True, slots=True)
class Changeset:
    """The files to write and the releases that change. A file whose text is None is removed."""

    files: Mapping[str, str | None]
    releases: tuple[ReleaseChange, ...]
    # the paths of the overrides that have an effect on the written files, ``hold`` included
    overrides: tuple[str, ...] = ()
    # a warning for each release that a ``hold`` override keeps from changing
    blocked: tuple[str, ...] = ()


def plan_change(
    before: World,
    after: World,
    changes: Changes,
    keys: Iterable[ReleaseKey],
    read: FileReader,
    plans: Mapping[ReleaseKey, Release] = MappingProxyType({}),
    checkpoint: Callable[[], None] = lambda: None,
) -> PlannedChange:
    """Return what follows from a change of the ledger, before any of it is rendered.

    ``keys`` are those of the releases that may differ, and ``plans`` are releases of ``before``
    that are planned already. ``checkpoint`` may raise an exception to end the work.
    """
    files: dict[str, str | None] = {}
    for change in changes.claims:
        checkpoint()
        path = claim_files.path_of(change.key)
        files[path] = claim_files.text_of(change.after) if change.after else None
    for demand in changes.waiting:
        waits = after.ledger.waiting.get(demand)
        files[records.waiting_path(demand)] = records.waiting_text(waits) if waits else None
    # before anything is planned, because a claim's file is the smallest of the files that need it
    _refuse_large(files, after.config.repo_settings.limits.file_bytes, read)
    now, former = dict[ReleaseKey, Release | None](), dict[ReleaseKey, Release | None]()
    for key in keys:
        checkpoint()
        now[key] = plan(after, key)
        former[key] = plans.get(key)
        with suppress(Refused):  # what could not be planned before must not stop its remedy
            former[key] = former[key] or plan(before, key)
    return PlannedChange(files, now, former)


def render_change(
    planned: PlannedChange,
    config: Config,
    evaluate: Evaluate,
    read: FileReader,
    *,
    keeps_late: bool = False,
    checkpoint: Callable[[], None] = lambda: None,
) -> Changeset:
    """Return the changes in the state repo that follow from a planned change.

    With ``keeps_late``, a release whose values take too long to compute keeps its file, instead of
    OverLimit.
    """
    files = {**planned.ledger_files}
    releases, shaped, blocked = list[ReleaseChange](), set[str](), list[str]()
    for key, new in planned.plans.items():
        checkpoint()
        old = planned.former[key]
        old_path = path_of(old) if old else None
        new_path = path_of(new) if new else None
        current = read(new_path) if new_path else None
        try:
            text = gitops.release_text(new, config, evaluate, current) if new else None
        except OverLimit:
            if keeps_late or old == new:  # what only renews a lease needs no template
                continue
            raise
        # the path has the node, so a release that moves to another node leaves a file behind
        if old_path and old_path != new_path and read(old_path) is not None:
            files[old_path] = None
        is_held = new is not None and new.shaping.held and current is not None
        if new and is_held and (old and old.facts()) != new.facts():
            by = " and ".join(each.path for each, effects in new.shaping.by if "hold" in effects)
            blocked.append(f"{new.name} will not change until the 'hold' of {by} ends")
        if new_path and text != current:
            files[new_path] = text
            shaped |= {override.path for override, _ in new.shaping.by} if new else set()
        if text is not None and text == current:
            continue
        if old or new:
            releases.append(describe_change(old, new, current, text))
    _refuse_large(files, config.repo_settings.limits.file_bytes, read)
    releases.sort(key=lambda each: (CHANGE_ORDER.index(each.change), each.name))
    return Changeset(files, tuple(releases), tuple(sorted(shaped)), tuple(blocked))


def _refuse_large(files: Mapping[str, str | None], most: int, read: FileReader) -> None:
    faults = []
    for path, text in files.items():
        # A file that is too large already may shrink. Else its claims could not be released.
        # A character has at most four bytes, so most files need not be encoded to be measured.
        size = len(text.encode()) if text is not None and 4 * len(text) > most else 0
        if size > max(most, len((read(path) or "").encode()) if size > most else 0):
            message = (
                f"would have {size} bytes, but at most {most} are allowed; demand less, or ask a "
                f"platform engineer to raise limits.fileBytes in {ROOT_FILE}"
            )
            faults.append(fault("", message, code="too-large").within(path))
    if faults:
        raise Refused(faults)


def describe_change(
    old: Release | None, new: Release | None, current: str | None, text: str | None
) -> ReleaseChange:
    """Return how a release changes, and with it its file, from the text ``current`` to ``text``."""
    release = new or old
    assert release is not None  # noqa: S101 - a change has at least one side
    existed = current is not None
    kind: Change = "stop" if not new else "change" if existed else "start"
    details: list[str] = []
    if new and existed:
        before, after = (
            [f"{override.path}: {', '.join(effects)}" for override, effects in side.shaping.by]
            if side
            else []
            for side in (old, new)
        )
        if not new.shaping.held:  # in a held file, only the comments that name overrides change
            before = (old.facts() if old else []) + before
            after = new.facts() + after
        old_facts, new_facts = frozenset(before), frozenset(after)
        details = [f"- {one_line(fact)}" for fact in before if fact not in new_facts]
        details += [f"+ {one_line(fact)}" for fact in after if fact not in old_facts]
    effect = effect_on_pods(old, new, current, text)
    return ReleaseChange(
        release.name, release.description, path_of(release), kind, tuple(details), effect
    )


def effect_on_pods(
    old: Release | None, new: Release | None, current: str | None, text: str | None
) -> Effect:
    if text is None or current is None:
        return "stops" if text is None else "starts"
    had, has = (getattr(side, "replicas", None) != 0 for side in (old, new))
    if had is not has:
        return "starts" if has else "stops"
    (was, before), (now, after) = map(gitops.values_apart, (current, text))
    if before != after:
        return "restarts"
    if was == now:  # only comments differ, which name overrides
        return ""
    live = {*new.service.live, *_ALWAYS_LIVE} if isinstance(new, ServiceRelease) else set()
    # of the library, by a template or an override, else by the chart
    reconfigure = now.get("reconfigure", "restart" if getattr(new, "restarts", False) else "")
    if "restart" in reconfigure:
        live.discard("parameters")
    differing = {name for name in {**was, **now} if was.get(name, ABSENT) != now.get(name, ABSENT)}
    return "reconfigures" if differing <= live else "restarts"


# ---- all generated files of a state ----


def rendered_files(
    state: State,
    current: Mapping[str, str] = MappingProxyType({}),
    *,
    keeps_late: bool = False,
    edited: Collection[str] = (),
) -> dict[str, str]:
    """Return all generated files except those of the ledger, by path.

    A ``hold`` override keeps files of ``current``. With ``keeps_late``, so does a release whose
    values take too long to compute.

    Raises:
        InvalidInput: with the faults of all releases. The file of each is the first of these that
            exists: a file in ``edited`` with a claim that needs the release; the file that the
            fault names; the file of the first claim that needs the release.
    """
    config, keys = state.config, all_keys(state)
    files, errors = gitops.base_files(config), dict[ReleaseKey, InvalidInput]()
    collisions.refuse_shared_names(state, keys)  # one would overwrite the file of the other
    for key in keys:
        path = ""
        try:
            if release := plan(state, key):
                path = path_of(release)
                was = current.get(path)
                files[path] = gitops.release_text(release, config, state.evaluate, was)
        except InvalidInput as error:
            if not (keeps_late and isinstance(error, OverLimit)):
                errors[key] = error
            elif path in current:
                files[path] = current[path]
    if not errors:
        return files | gitops.kept_charts(files, current, state)
    claims: dict[ReleaseKey, list[str]] = {}
    for subject in sorted(state.ledger.claims, key=str):
        paths = [claim_files.path_of(claim.key) for claim in state.ledger.claims_on(subject)]
        for key in keys_of(state, subject):
            claims.setdefault(key, []).extend(paths)
    faults: dict[Fault, None] = {}
    for key, failure in errors.items():
        edited_claim = next((path for path in claims.get(key, ()) if path in edited), "")
        first = next(iter(claims.get(key, ())), "")
        for each in failure.faults:
            faults[each.within(edited_claim or each.file or first)] = None
    raise InvalidInput(faults)


# ---- trial demands: a new configuration must render before real demands arrive ----

_NEVER = datetime.fromtimestamp(0, timezone.utc)


def trial_releases(config: Config) -> dict[str, list[ServiceRelease]]:
    if not config.usable_nodes():
        return {}
    plain = replace(config, overrides={})
    return {name: list(_trial_services(appdef, plain)) for name, appdef in config.appdefs.items()}


def _trial_services(
    appdef: ApplicationDefinition, config: Config, version: str = ""
) -> Iterator[ServiceRelease]:
    services = config.services.get(appdef.name, {}).values()
    nodes = config.usable_nodes()
    # A service that runs once for a cluster has no node in other clusters. So this is the first
    # node that can run all services, else the first of all.
    fitting = (node for node in nodes if all(node in s.runs_at for s in services if s.nodes))
    node = next(fitting, nodes[0])
    inputs = {
        role: (InputTopic(f"/rehearsal/{role.replace('-', '_')}", node),) for role in appdef.inputs
    }
    app = Application(f"rehearsal/{appdef.name}", appdef.name, node, inputs, version=version)
    request = Demand("join", "rehearsal", (Item(app, ("rehearsal",)),))
    ledger, changes = apply(Ledger(), request, _NEVER)
    before, after = World(config, Ledger()), World(config, ledger)
    for key in affected_keys(before, after, changes.claims):
        release = plan(after, key)
        if isinstance(release, ServiceRelease):
            yield release


def try_configuration(state: State) -> None:
    """Render every service of every appdef, with invented claims on a real node.

    This renders each version that ``registry/versions.yaml`` lists, and each override in effect. If
    no node is in an access domain, nothing is checked.

    Raises:
        Refused, InvalidInput: if a service cannot be planned or rendered. The error names the
            template, the schema or the override at fault.
        OverLimit: if nothing is known to be wrong, but some of it took too long to render.
    """
    config = state.config
    plain = replace(config, overrides={})

    def errors_of(releases: Iterable[Release]) -> Iterator[InvalidInput]:
        for release in releases:
            try:
                gitops.render(release, config, state.evaluate)
            except InvalidInput as error:
                yield error

    trials = trial_releases(config)
    errors = [error for releases in trials.values() for error in errors_of(releases)]
    for appdef, listed in config.versions.items() if trials else ():
        for version in listed.versions:
            if version != listed.default:
                errors += errors_of(_trial_services(config.appdefs[appdef], plain, version))
    # only if all can be rendered without overrides: else a broken template would blame them
    for override in () if errors else state.overrides:
        failed = []
        for appdef, releases in trials.items():
            overridden = [
                apply_effects(release, [(override, effects)], config)
                for release in releases
                if (effects := effects_on(release, override, config))
                and any(
                    not selector.connections and selector.takes(release.key.service, appdef)
                    for selector in override.select
                )
            ]
            if overridden:
                failed.append([*errors_of(overridden)])
        # an override that can be rendered for one of the appdefs may be meant for that one only
        if failed and all(failed):
            errors += failed[0]
    if errors:
        only_late = all(isinstance(error, OverLimit) for error in errors)
        faults = dict.fromkeys(fault for error in errors for fault in error.faults)
        raise (OverLimit if only_late else InvalidInput)(faults)


# ---- the releases and files that differ between two commits, or before and after a merge ----
#
# A demand's changeset covers only the releases that the demand touches. A change of the
# configuration may affect any release, so this module compares all. The functions here are pure.

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
    return {key: each for key, each in planned(world, all_keys(world)).items() if each}


def described(
    before: Release | None, after: Release | None, text: str | None, new_text: str | None
) -> ReleaseChange:
    """Return how a release changes, by its plans and its texts before and after."""
    change = describe_change(before, after, text, new_text)
    if change.change != "change":
        return change
    paths = [path_of(side) for side in (before, after) if side]
    if len({*paths}) > 1:
        moved = (f"- {paths[0]}", f"+ {paths[1]}")
        return replace(change, details=(*moved, *change.details))
    # what overrides change is told by the fields too, such as the tag of an image
    facts = list[str]()
    if all(detail[2:].startswith(f"{OVERRIDES_ROOT}/") for detail in change.details):
        with suppress(InvalidInput):
            was, now = list(load_all(text or "")), list(load_all(new_text or ""))
            differing = list(leaf_differences(was, now))
            for path, *sides in differing[:_MOST_FACTS]:
                shown = ("none" if side is ABSENT else short_repr(side) for side in sides)
                facts.append(f"{path.removeprefix('[0].')}: {' → '.join(shown)}")
            if len(differing) > _MOST_FACTS:
                facts.append(f"and {len(differing) - _MOST_FACTS} more")
    return replace(change, details=(*change.details, *facts))


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
        change = described(before, after, text, files.get(new_path))
        releases.append(change)
    releases.sort(key=lambda each: (CHANGE_ORDER.index(each.change), each.name))
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
