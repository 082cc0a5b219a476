"""What a decision changes in the state repo: files by path, and releases in words.

Rendering gives text, this compares it with what is there: a file that would be written with the
bytes it has already does not appear, so an unchanged release costs no commit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

from demandops.config.config import Config
from demandops.demand.route import Route
from demandops.errors import Refused
from demandops.ledger import claim_file
from demandops.ledger.ledger import ClaimChange, Ledger
from demandops.plan.planner import plan
from demandops.plan.release import Bridge, MqttEnd, Release, RosEnd, ServiceRelease
from demandops.plan.release_keys import ReleaseKey
from demandops.render import override_marks
from demandops.render.engine import Engine
from demandops.render.gitops import controller
from demandops.render.gitops.paths import path_of
from demandops.render.output_check import check_files

Change = Literal["start", "change", "stop"]

Read = Callable[[str], str | None]
"""Returns the text of a file of the state repo, or nothing where there is none."""


@dataclass(frozen=True, slots=True)
class ReleaseChange:
    """One release that starts, changes or stops, and in what."""

    name: str
    change: Change
    what: str
    details: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Changeset:
    """Files to write (``None``: to remove) and the releases behind them."""

    files: Mapping[str, str | None]
    releases: tuple[ReleaseChange, ...]
    overrides: tuple[str, ...] = ()
    """The files of the overrides that shaped what is written."""
    waiting: tuple[str, ...] = ()
    """What does not reach a release, for an override holds it."""


def of_change(
    before: Ledger,
    after: Ledger,
    claims: Iterable[ClaimChange],
    keys: Iterable[ReleaseKey],
    world: tuple[Config, Engine, Read],
) -> Changeset:
    """Return what it takes to get from one ledger to the other.

    Args:
        before, after: the ledgers.
        claims: the claims that differ.
        keys: the releases that may differ (:func:`demandops.plan.planner.affected`).
        world: the configuration, its engine and how to read the state repo as it is.

    Raises:
        Refused, InvalidInput: where a release cannot be planned or rendered.
    """
    config, engine, read = world
    files: dict[str, str | None] = {
        claim_file.path_of(change.key): claim_file.text_of(change.after) if change.after else None
        for change in claims
    }
    releases = []
    shaped: set[str] = set()
    waiting: list[str] = []
    for key in keys:
        old, new = _plan_leniently(before, config, key), plan(after, config, key)
        old_path = path_of(old) if old else None
        new_path = path_of(new) if new else None
        if old_path and old_path != new_path and read(old_path) is not None:
            files[old_path] = None
        standing = read(new_path) if new_path else None
        waiting += _waiting(old, new) if standing is not None else ()
        text = override_marks.text_of(new, config, engine, standing) if new else None
        if new_path and text != standing:
            files[new_path] = text
            shaped |= {override.path for override, _ in new.shaping.by} if new else set()
        if text is not None and text == standing:
            continue
        if old or new:
            releases.append(described(old, new, standing is not None))
    check_files(files)
    told = tuple(sorted(releases, key=_order))
    return Changeset(files, told, tuple(sorted(shaped)), tuple(waiting))


def render_all(
    ledger: Ledger,
    config: Config,
    engine: Engine,
    keys: Iterable[ReleaseKey],
    standing: Mapping[str, str],
) -> dict[str, str]:
    """Return every generated file that ledger and configuration ask for.

    Args:
        standing: the generated files as they are, of which overrides may hold some.
    """
    files = controller.standing_files(config, engine)
    for key in keys:
        release = plan(ledger, config, key)
        if release is not None:
            path = path_of(release)
            files[path] = override_marks.text_of(release, config, engine, standing.get(path))
    return files | override_marks.charts_kept(files, standing, config)


def _plan_leniently(ledger: Ledger, config: Config, key: ReleaseKey) -> Release | None:
    """Plan what stood; where that is no longer possible there is nothing to compare with."""
    try:
        return plan(ledger, config, key)
    except Refused:
        return None


def _order(change: ReleaseChange) -> tuple[int, str]:
    return ["start", "change", "stop"].index(change.change), change.name


def described(old: Release | None, new: Release | None, stood: bool) -> ReleaseChange:
    """Return in words what becomes of a release; ``stood``: there is a file of it."""
    release = new or old
    assert release is not None  # noqa: S101 - the caller has one of them
    if isinstance(release, ServiceRelease):
        what = f"{release.key.service} on {release.node.id}"
        what += f" for {release.key.source or release.key.application}"
    elif isinstance(release, Bridge):
        what = f"Zenoh bridge on {release.node.id}"
    else:
        what = f"{release.type.name} {release.side} of connection {release.connection}"
        what += f" on {release.node.id}"
    kind: Change = "stop" if not new else "start"
    if new and stood:
        kind = "change"
    details = _differences(old, new) if kind == "change" else ()
    return ReleaseChange(release.name, kind, what, details)


def _differences(old: Release | None, new: Release | None) -> tuple[str, ...]:
    held = new is not None and new.shaping.held  # nothing else reaches its file
    before, after = _overrides(old), _overrides(new)
    before, after = (before, after) if held else (_facts(old) + before, _facts(new) + after)
    known, wanted = frozenset(before), frozenset(after)
    gone = [f"- {fact}" for fact in before if fact not in wanted]
    come = [f"+ {fact}" for fact in after if fact not in known]
    return (*gone, *come)


def _waiting(old: Release | None, new: Release | None) -> Iterator[str]:
    """Yield a warning where a release that is held would otherwise change."""
    if new is None or not new.shaping.held or _facts(old) == _facts(new):
        return
    by = " and ".join(one.path for one, effects in new.shaping.by if "hold" in effects)
    yield f"{new.name} is held by {by}, so what is asked of it waits until it is let go"


def _overrides(release: Release | None) -> list[str]:
    by = release.shaping.by if release is not None else ()
    return [f"{override.path}: {', '.join(effects)}" for override, effects in by]


def _facts(release: Release | None) -> list[str]:
    if release is None:
        return []
    if isinstance(release, ServiceRelease):
        facts = [f"{role} {t.topic}" for role, topics in release.inputs.items() for t in topics]
        facts += [f"{name} = {value}" for name, value in release.parameters.items()]
        return [*facts, f"replicas {release.replicas}"]
    if isinstance(release, Bridge):
        return _facts_of_bridge(release)
    return [*map(_told, release.topics.values()), _meeting_place(release)]


def _told(route: Route) -> str:
    way = "from" if route.reverse else "to"
    options = {name: value for name, value in route.options().items() if name != "reverse"}
    more = ", ".join(f"{name} {value}" for name, value in options.items())
    return f"topic {route.source} {way} {route.target}" + (f" ({more})" if more else "")


def _meeting_place(end: MqttEnd | RosEnd) -> str:
    if isinstance(end, MqttEnd):
        return f"broker {end.broker.node}"
    return f"address {end.address.host}:{end.address.port}"


def _facts_of_bridge(bridge: Bridge) -> list[str]:
    return [
        *(f"connection {id}" for id in bridge.connections),
        *(f"takes {topic}" for topic in bridge.publishers),
        *(f"gives {topic}" for topic in bridge.subscribers),
        *(f"rate {rate:g} of {topic}" for topic, rate in bridge.rates.items()),
        *(f"connects to {endpoint}" for endpoint in bridge.connect),
    ]
