"""Refuses two overrides of equal priority that could change one release differently.

Such a pair needs an order, and only different priorities give one. It is refused even if no release
matches both overrides yet, because a later demand could add a release that does.

Two selectors cannot match the same release if they exclude each other in a field for which a
release has only one value, like service or node. A shared service has many applications and
requesters, and a Zenoh bridge has many connections, so two selectors that exclude each other in
these fields may still match the same release.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from itertools import combinations

from demandops.config.appdef import Services
from demandops.config.config import Config
from demandops.config.config_reader import ConfigReader
from demandops.config.override import Override, Selector, by_rank
from demandops.config.policy import matches
from demandops.connections import connection_types

_MERGED = ("values", "images")
_SINGLE = ("version", "replicas", "node")
_FROZEN = (*_SINGLE, *_MERGED)


def check_override_conflicts(config: Config, reader: ConfigReader) -> None:
    """Add a fault for each pair of overrides that needs an order but has the same priority."""
    for one, other in combinations(by_rank(config.overrides.values()), 2):
        if one.priority != other.priority:
            continue
        contested = contested_effects(one, other)
        if contested and may_select_same_release(one.select, other.select, config):
            names = " and ".join(f"'{name}'" for name in contested)
            reader.add_fault(
                other.path,
                "priority",
                f"is {other.priority}, as in {one.path}, and both overrides may set {names} of the "
                "same release; change one of the priorities, or select different releases",
            )


def contested_effects(one: Override, other: Override) -> list[str]:
    """Return the effects for which the order of two overrides matters."""
    contested = [
        name
        for name in _SINGLE
        if None not in (left := getattr(one, name), right := getattr(other, name)) and left != right
    ]
    if one.values and other.values and not patches_commute(one.values, other.values):
        contested.append("values")
    pins = (one.images or {}, other.images or {})
    contested += [
        f"images.{name}"
        for name in sorted({*pins[0]} & {*pins[1]})
        if pins[0][name] != pins[1][name]
    ]
    for holding, shaping in ((one, other), (other, one)):
        effects = [name for name in shaping.effects() if name in _FROZEN]
        if holding.hold and effects:
            contested += ["hold", *effects]
    return contested


def patches_commute(one: object, other: object) -> bool:
    """Return whether two merge patches have the same result in either order."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return all(patches_commute(one[key], other[key]) for key in one if key in other)
    return json.dumps(one, sort_keys=True) == json.dumps(
        other, sort_keys=True
    )  # unlike ==, it distinguishes 1 from True


def may_select_same_release(
    one: Iterable[Selector], other: Iterable[Selector], config: Config
) -> bool:
    """Return whether some release, now or later, may match selectors of both overrides."""
    others = list(other)
    return any(_may_match_same_release(left, right, config) for left in one for right in others)


def _may_match_same_release(one: Selector, other: Selector, config: Config) -> bool:
    if (one.connections and _selects_services(other)) or (
        other.connections and _selects_services(one)
    ):
        return False
    for name in _separating_fields(one, other, config):
        left, right = getattr(one, name), getattr(other, name)
        if left and right and not any(patterns_overlap(a, b) for a in left for b in right):
            return False
    left, right = one.labels or {}, other.labels or {}
    return all(left[key] == right[key] for key in left if key in right)


def _selects_services(selector: Selector) -> bool:
    return bool(selector.applications or selector.appdefs or selector.services)


def _separating_fields(one: Selector, other: Selector, config: Config) -> Iterator[str]:
    """Yield the fields that can separate two selectors.

    If both selectors have one of these fields and do not overlap in it, no release matches both.
    """
    yield from ("services", "nodes")
    if not any(_shared(one, other, services) for services in config.services.values()):
        yield from ("applications", "appdefs")
    if not any(known.shares_clients(config) for known in connection_types.CONNECTION_TYPES):
        yield "connections"


def _shared(one: Selector, other: Selector, services: Services) -> bool:
    """Return whether both selectors may match one service that several applications share."""
    return any(
        service.scope != "application"
        and all(not s.services or matches(name, s.services) for s in (one, other))
        for name, service in services.items()
    )


def patterns_overlap(one: str, other: str) -> bool:
    """Return whether some text matches both patterns.

    ``*`` stands for any number of characters, and ``?`` for one character.
    """
    # row[i]: whether the part of ``one`` read so far overlaps with the first i characters of other
    row = [not other[:length].strip("*") for length in range(len(other) + 1)]
    for a in one:
        after = [row[0] and a == "*"]
        for b, above, before in zip(other, row[1:], row, strict=False):
            if "*" in (a, b):
                after.append(above or after[-1])
            else:
                after.append(before and (a == b or "?" in (a, b)))
        row = after
    return row[-1]
