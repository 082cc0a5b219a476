"""Two overrides of equal priority that could change one release differently.

Such a pair needs an order, and only different priorities give one. It is refused even if no
release matches both overrides yet, because a later demand could add a release that does.
"""

from __future__ import annotations

import json
import re
from bisect import bisect_left, insort
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping

from demandops.connections import connection_types
from demandops.model.config.config import (
    Config,
    ConfigReader,
)
from demandops.model.config.override import Override, Selector, by_rank
from demandops.model.config.policy import matches

_MERGED = ("values", "images")
_SINGLE = ("version", "replicas", "node")
_FROZEN = (*_SINGLE, *_MERGED)

# A merge may bring thousands of overrides, each of which contradicts all others
_MOST_SHOWN = 3
_INDEXED = ("nodes", "services", "applications", "connections", "appdefs")


def check_override_conflicts(config: Config, reader: ConfigReader) -> None:
    contests = defaultdict[tuple[int, tuple[str, ...]], list[tuple[Override, str]]](list)
    for override in by_rank(config.overrides.values()):
        # (setting, value as text): of equal priority, another value of a setting contradicts it
        settings: list[tuple[tuple[str, ...], str]] = [
            ((name,), str(value))
            for name in _SINGLE
            if (value := getattr(override, name)) is not None
        ]
        settings += _leaves(("values",), override.values or {})
        pins = (override.images or {}).items()
        settings += ((("images", name), pin.model_dump_json()) for name, pin in pins)
        if override.hold or any(name in _FROZEN for name in override.effects()):
            settings.append((("hold",), str(override.hold)))
        for what, token in settings:
            contests[override.priority, what].append((override, token))
    # for each override, its rivals with what both set
    rivals = defaultdict[str, dict[str, set[str]]](lambda: defaultdict(set))
    for (_, what), contenders in contests.items():
        if len({token for _, token in contenders}) > 1:
            for rival, override in _rivals(contenders, config):
                name = ".".join(what[: 1 + (what[0] == "images")])
                name = "what 'hold' freezes" if name == "hold" else f"'{name}'"
                rivals[override.name][rival.name].add(name)
    for override in by_rank(config.overrides[name] for name in rivals):
        names = rivals[override.name]
        for rival in by_rank(config.overrides[name] for name in names)[:_MOST_SHOWN]:
            message = (
                f"is {override.priority}, as in {rival.path}, and both overrides may set "
                f"{' and '.join(sorted(names[rival.name]))} of the same release; change one of the "
                "priorities, or select different releases"
            )
            reader.add_fault(override.path, "priority", message)


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
    """Yield (earlier, later) for overrides with different tokens that may select one release."""
    # Only selectors are compared whose patterns begin alike in one field, the one in which the
    # selectors differ most. So the cost grows with the number of overrides, not with that of pairs,
    # unless patterns hardly differ.
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
    earlier: dict[str, dict[str, list[tuple[Override, Selector]]]] = {}
    starts: list[str] = []  # the keys of `earlier`, sorted

    def alike(start: str) -> Iterator[str]:
        # those that begin with `start`, or with which it begins
        yield from (start[:end] for end in range(len(start)) if start[:end] in earlier)
        for place in range(bisect_left(starts, start), len(starts)):
            if not starts[place].startswith(start):
                return
            yield starts[place]

    for override, token in contenders:
        rivals = dict[str, Override]()
        for right in override.select:
            for start in starts_of(right, field):
                if len(rivals) < _MOST_SHOWN:
                    near = (
                        pair
                        for begin in alike(start)
                        for other_token, pairs in earlier[begin].items()
                        if other_token != token
                        for pair in pairs
                    )
                    for rival, left in near:
                        if rival.name not in rivals and may_match_same_release(
                            left, right, config, shares
                        ):
                            rivals[rival.name] = rival
                            if len(rivals) == _MOST_SHOWN:
                                break
        for right in override.select:
            for start in starts_of(right, field):
                if start not in earlier:
                    insort(starts, start)
                earlier.setdefault(start, {}).setdefault(token, []).append((override, right))
        yield from ((rival, override) for rival in rivals.values())


def may_match_same_release(
    first: Selector, second: Selector, config: Config, shares_clients: bool
) -> bool:
    # a later demand may add the release
    if (first.connections and _selects_services(second)) or (
        second.connections and _selects_services(first)
    ):
        return False
    for name in _separating_fields(first, second, config, shares_clients):
        left, right = getattr(first, name), getattr(second, name)
        if not (left and right):
            continue
        plain = [{text for text in side if not {*text} & {*"*?"}} for side in (left, right)]
        # two texts without wildcards overlap only if they are equal, and lists of names may be long
        if plain[0].isdisjoint(plain[1]) and not any(
            patterns_overlap(pattern, other)
            for pattern in left
            for other in ({*right} - plain[1] if pattern in plain[0] else right)
        ):
            return False
    left, right = first.labels or {}, second.labels or {}
    return all(left[key] == right[key] for key in left if key in right)


def _selects_services(selector: Selector) -> bool:
    return bool(selector.applications or selector.appdefs or selector.services)


def shares_any_clients(config: Config) -> bool:
    return any(kind.shares_clients(config) for kind in connection_types.CONNECTION_TYPES)


def _separating_fields(
    first: Selector, second: Selector, config: Config, shares_clients: bool
) -> Iterator[str]:
    # Yield the fields whose patterns must overlap for one release to match both selectors. A
    # release has one service and runs at one node. But a shared service has many applications, and
    # a Zenoh bridge many connections, so these fields count only if no such release can match.
    yield from ("services", "nodes")
    may_match_shared_service = any(
        service.scope != "application"
        and all(not s.services or matches(name, s.services) for s in (first, second))
        for services in config.services.values()
        for name, service in services.items()
    )
    if not may_match_shared_service:
        yield from ("applications", "appdefs")
    if first.connections and second.connections and not shares_clients:
        yield "connections"


def patterns_overlap(first: str, second: str) -> bool:
    # row[i]: whether the part of `first` read so far overlaps with i characters of `second`
    row = [not second[:length].strip("*") for length in range(len(second) + 1)]
    for a in first:
        after = [row[0] and a == "*"]
        for b, above, before in zip(second, row[1:], row, strict=False):
            if "*" in (a, b):
                after.append(above or after[-1])
            else:
                after.append(before and (a == b or "?" in (a, b)))
        row = after
    return row[-1]
