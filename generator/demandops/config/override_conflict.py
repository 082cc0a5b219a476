"""Ties: may two overrides of equal priority ever meet on one release and say different things?

Answered from the files alone and on the safe side, so that no later demand can run into one. A
dimension tells two selectors apart only where a release has one value in it: one service, one node.
A service that applications share has many applications and requesters, a Zenoh bridge many
connections.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from itertools import combinations

from demandops.config.appdef import ApplicationDefinition
from demandops.config.config import Config
from demandops.config.config_reader import ConfigReader
from demandops.config.override import Override, Selector, by_rank
from demandops.config.policy import matches

_MERGED = ("values", "images")
_SINGLE = ("version", "replicas", "node")
_FROZEN = (*_SINGLE, *_MERGED)


def check_override_conflicts(config: Config, reader: ConfigReader) -> None:
    """Note every pair of overrides whose order decides what runs, and that have none."""
    for one, other in combinations(by_rank(config.overrides.values()), 2):
        if one.priority != other.priority:
            continue
        touched = contested_effects(one, other)
        if touched and can_meet(one.select, other.select, config):
            reader.add_fault(
                other.path,
                "priority",
                f"is {other.priority}, as in {one.path}, and both may set {' and '.join(touched)} "
                "of the same release; give one of them another priority, or select apart",
            )


def contested_effects(one: Override, other: Override) -> list[str]:
    """Return the effects of two overrides for which it matters who comes last."""
    touched = [
        name
        for name in _SINGLE
        if None not in (left := getattr(one, name), right := getattr(other, name)) and left != right
    ]
    if one.values and other.values and not patches_commute(one.values, other.values):
        touched.append("values")
    pins = (one.images or {}, other.images or {})
    touched += [
        f"images.{name}"
        for name in sorted({*pins[0]} & {*pins[1]})
        if pins[0][name] != pins[1][name]
    ]
    for holding, shaping in ((one, other), (other, one)):
        effects = [name for name in shaping.effects() if name in _FROZEN]
        if holding.hold and effects:
            touched += ["hold", *effects]
    return touched


def patches_commute(one: object, other: object) -> bool:
    """Tell whether two merge patches give the same whichever comes first."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return all(patches_commute(one[key], other[key]) for key in one if key in other)
    return json.dumps(one, sort_keys=True) == json.dumps(other, sort_keys=True)  # 1 is not True


def can_meet(one: Iterable[Selector], other: Iterable[Selector], config: Config) -> bool:
    """Tell whether some release, now or later, may fit a selector of each."""
    others = list(other)
    return any(_meet(left, right, config) for left in one for right in others)


def _meet(one: Selector, other: Selector, config: Config) -> bool:
    if (one.connections and _of_services(other)) or (other.connections and _of_services(one)):
        return False
    for name in _telling_apart(one, other, config):
        left, right = getattr(one, name), getattr(other, name)
        if left and right and not any(patterns_overlap(a, b) for a in left for b in right):
            return False
    left, right = one.labels or {}, other.labels or {}
    return all(left[key] == right[key] for key in left if key in right)


def _of_services(selector: Selector) -> bool:
    return bool(selector.applications or selector.appdefs or selector.services)


def _telling_apart(one: Selector, other: Selector, config: Config) -> Iterator[str]:
    """Yield the dimensions in which no release that both may fit has several values."""
    yield from ("services", "nodes")
    if not any(_shared(one, other, appdef) for appdef in config.appdefs.values()):
        yield from ("applications", "appdefs")
    if not any(node.zenoh for node in config.nodes.values()):
        yield "connections"


def _shared(one: Selector, other: Selector, appdef: ApplicationDefinition) -> bool:
    """Tell whether both may fit a service of an appdef that several applications share."""
    return any(
        service.each is not None
        and all(not s.services or matches(name, s.services) for s in (one, other))
        for name, service in appdef.services.items()
    )


def patterns_overlap(one: str, other: str) -> bool:
    """Tell whether some text fits both patterns (``*`` any characters, ``?`` one)."""
    reached = {0}  # places in ``other`` that what is read of ``one`` can stand at
    reached |= _past_stars(other, reached)
    for part in one:
        if part == "*":  # swallows whatever follows in the other
            reached = set(range(min(reached), len(other) + 1)) if reached else set()
            continue
        after = set()
        for place in reached:
            if place < len(other) and other[place] == "*":
                after.add(place)
            elif place < len(other) and (part == other[place] or "?" in (part, other[place])):
                after.add(place + 1)
        reached = after | _past_stars(other, after)
    return len(other) in reached


def _past_stars(pattern: str, places: set[int]) -> set[int]:
    """Return the places reached when each star on the way stands for nothing."""
    found = set()
    for place in places:
        here = place
        while here < len(pattern) and pattern[here] == "*":
            here += 1
            found.add(here)
    return found
