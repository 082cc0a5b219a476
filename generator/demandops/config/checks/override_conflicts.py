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
import re
from bisect import bisect_left, insort
from collections import Counter, defaultdict
from collections.abc import Container, Iterable, Iterator, Mapping

from demandops.config.appdef import Services
from demandops.config.config import Config
from demandops.config.config_reader import ConfigReader
from demandops.config.override import Override, Selector, by_rank
from demandops.config.policy import matches
from demandops.connections import connection_types

_MERGED = ("values", "images")
_SINGLE = ("version", "replicas", "node")
_FROZEN = (*_SINGLE, *_MERGED)


_MOST_SHOWN = 3
_INDEXED = ("nodes", "services", "applications", "connections", "appdefs")


def check_override_conflicts(config: Config, reader: ConfigReader) -> None:
    """Add faults for the overrides that need an order but have the same priority.

    An override is told only the first three others that it contradicts: a merge may bring
    thousands of overrides, each of which contradicts all others.
    """
    contests = defaultdict[tuple[int, tuple[str, ...]], list[tuple[Override, str]]](list)
    for override in by_rank(config.overrides.values()):
        for what, token in _settings(override):
            contests[override.priority, what].append((override, token))
    rivals = defaultdict[str, dict[str, Override]](dict)
    for contenders in contests.values():
        if len({token for _, token in contenders}) > 1:
            for one, other in _rivals(contenders, config):
                rivals[other.name][one.name] = one
    for other in by_rank(config.overrides[name] for name in rivals):
        for one in by_rank(rivals[other.name].values())[:_MOST_SHOWN]:
            names = " and ".join(f"'{name}'" for name in contested_effects(one, other))
            reader.add_fault(
                other.path,
                "priority",
                f"is {other.priority}, as in {one.path}, and both overrides may set {names} of the "
                "same release; change one of the priorities, or select different releases",
            )


def _settings(override: Override) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield (what, token) for all that an override sets.

    The order of two overrides matters if they have different tokens for the same thing; this is
    what :func:`contested_effects` finds for one pair.
    """
    for name in _SINGLE:
        if (value := getattr(override, name)) is not None:
            yield (name,), str(value)
    yield from _leaves(("values",), override.values or {})
    for name, pin in (override.images or {}).items():
        yield ("images", name), pin.model_dump_json()
    if override.hold or any(name in _FROZEN for name in override.effects()):
        yield ("hold",), str(override.hold)


def _leaves(path: tuple[str, ...], patch: object) -> Iterator[tuple[tuple[str, ...], str]]:
    if not isinstance(patch, Mapping):
        yield path, json.dumps(patch, sort_keys=True)
        return
    yield path, "mapping"
    for key, value in patch.items():
        yield from _leaves((*path, key), value)


def _rivals(
    contenders: list[tuple[Override, str]], config: Config
) -> Iterator[tuple[Override, Override]]:
    """Yield (one, other) for overrides with different tokens that may select the same release.

    Each ``other`` is yielded with at most three that come before it. Only selectors are compared
    whose patterns begin alike in one field, the one in which the selectors differ most. So the cost
    grows with the number of overrides, not with that of pairs, unless patterns hardly differ.
    """

    shares = shares_any_clients(config)

    def crowding(field: str) -> int:
        starts = Counter(
            s for o, _ in contenders for left in o.select for s in starts_of(left, field)
        )
        return sum(count * (count - 1) for count in starts.values())

    def starts_of(selector: Selector, field: str) -> set[str]:
        patterns = (
            getattr(selector, field)
            if field in _separating_fields(selector, selector, config, shares)
            else ()
        )
        return {re.split("[*?]", pattern)[0] for pattern in patterns or ("",)}

    field = min(_INDEXED, key=crowding)
    known: dict[str, dict[str, list[tuple[Override, Selector]]]] = {}
    ordered: list[str] = []
    for other, token in contenders:
        met = dict[str, Override]()
        for right in other.select:
            for start in starts_of(right, field):
                if len(met) < _MOST_SHOWN:
                    near = (
                        pair
                        for begin in _alike(start, known, ordered)
                        for held, pairs in known[begin].items()
                        if held != token
                        for pair in pairs
                    )
                    for one, left in near:
                        if one.name not in met and may_match_same_release(
                            left, right, config, shares
                        ):
                            met[one.name] = one
                            if len(met) == _MOST_SHOWN:
                                break
        for right in other.select:
            for start in starts_of(right, field):
                if start not in known:
                    insort(ordered, start)
                known.setdefault(start, {}).setdefault(token, []).append((other, right))
        yield from ((one, other) for one in met.values())


def _alike(start: str, known: Container[str], ordered: list[str]) -> Iterator[str]:
    """Yield the known texts that begin with ``start`` or with which ``start`` begins."""
    yield from (start[:end] for end in range(len(start)) if start[:end] in known)
    for place in range(bisect_left(ordered, start), len(ordered)):
        if not ordered[place].startswith(start):
            return
        yield ordered[place]


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


def may_match_same_release(
    one: Selector, other: Selector, config: Config, shares_clients: bool
) -> bool:
    """Return whether some release, now or later, may match both selectors."""
    if (one.connections and _selects_services(other)) or (
        other.connections and _selects_services(one)
    ):
        return False
    for name in _separating_fields(one, other, config, shares_clients):
        left, right = getattr(one, name), getattr(other, name)
        if left and right and not _any_overlap(left, right):
            return False
    left, right = one.labels or {}, other.labels or {}
    return all(left[key] == right[key] for key in left if key in right)


def _any_overlap(left: Iterable[str], right: Iterable[str]) -> bool:
    """Return whether some text matches a pattern of both sides."""
    plain = [{one for one in side if not {*one} & {*"*?"}} for side in (left, right)]
    if plain[0] & plain[1]:
        return True
    pairs = (
        (one, other)
        for one in left
        for other in ({*right} - plain[1] if one in plain[0] else right)
    )
    return any(patterns_overlap(*pair) for pair in pairs)


def _selects_services(selector: Selector) -> bool:
    return bool(selector.applications or selector.appdefs or selector.services)


def shares_any_clients(config: Config) -> bool:
    return any(known.shares_clients(config) for known in connection_types.CONNECTION_TYPES)


def _separating_fields(
    one: Selector, other: Selector, config: Config, shares_clients: bool
) -> Iterator[str]:
    """Yield the fields that can separate two selectors.

    If both selectors have one of these fields and do not overlap in it, no release matches both.
    """
    yield from ("services", "nodes")
    if not any(_shared(one, other, services) for services in config.services.values()):
        yield from ("applications", "appdefs")
    if one.connections and other.connections and not shares_clients:
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
