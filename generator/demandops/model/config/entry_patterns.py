"""Nodes and brokers that nobody listed: entries of the inventory whose id is a pattern.

An entry ``vehicle{n}`` stands for each node whose id it matches. Its texts may name ``{n}`` and
``{id}``, the whole id. The node is made when somebody asks for it. So a decision is still a
function of repo and demand, and a vehicle costs nothing before it is demanded.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from types import MappingProxyType
from typing import Any, Generic, NamedTuple, TypeVar

from pydantic import BaseModel, ValidationError

from demandops.base.errors import InvalidInput, fault, field_path
from demandops.base.naming import MAX_ID
from demandops.base.placeholders import (
    example_of,
    filled,
    glob_of,
    is_pattern,
    names,
    unknown_names,
    values_in,
)
from demandops.base.quoting import quoted
from demandops.model.config.base_model import faults_of, matches
from demandops.model.config.inventory import Node, id_in_domain
from demandops.model.config.policy import AccessDomain

Entry = TypeVar("Entry", bound=BaseModel)
Value = TypeVar("Value")

_NUMBER = re.compile(r"-?[0-9]+(\.[0-9]+)?")
# More would take long to match, as each may be of any length
_MOST_PLACEHOLDERS = 3
# A pattern whose entry is valid for one of these is valid. Some texts may not begin with a digit.
_EXAMPLES = ("1", "a")


# ---- patterns with `*` and `?`, found without a look at each of them ----


class Globs(Generic[Value]):
    """Patterns, each with a value, by their first and by their longest text without wildcards."""

    def __init__(self, entries: Iterable[tuple[str, Value]]) -> None:
        self._by_start = defaultdict[str, list[tuple[str, Value]]](list)
        self._by_longest = defaultdict[str, list[tuple[str, Value]]](list)
        for entry in entries:
            fixed = re.split("[*?]", entry[0])
            self._by_start[fixed[0]].append(entry)
            self._by_longest[max(fixed, key=len)].append(entry)
        self._starts = sorted(self._by_start)
        self._lengths = sorted({*map(len, self._by_longest)})

    def matching(self, id: str) -> Iterator[tuple[str, Value]]:
        for length in self._lengths:
            parts = (id[cut : cut + length] for cut in range(len(id) - length + 1))
            for part in dict.fromkeys(parts):
                known = self._by_longest.get(part, ())
                yield from (each for each in known if matches(id, (each[0],)))

    def overlapping(self, glob: str) -> Iterator[tuple[str, Value]]:
        """Yield each pattern that some text matches that ``glob`` matches too."""
        start, starts = re.split("[*?]", glob)[0], self._starts
        longer = starts[bisect_left(starts, start) : bisect_left(starts, f"{start}\U0010ffff")]
        shorter = (start[:cut] for cut in range(len(start)))
        for key in (*shorter, *longer):
            known = self._by_start.get(key, ())
            yield from (each for each in known if _overlap(glob, each[0]))


def _overlap(one: str, other: str) -> bool:
    start, *further = re.split("[*?]", one)
    begin, *wild = re.split("[*?]", other)
    common = min(len(start), len(begin))  # most pairs differ there
    if start[:common] != begin[:common] or not (further or wild):
        return one == other
    # row[j]: some text matches what was read of `one`, and the first j characters of `other`
    row = [True] + [other[:j].strip("*") == "" for j in range(1, len(other) + 1)]
    for char in one:
        above, row = row, [row[0] and char == "*"]
        for j, against in enumerate(other):
            if "*" in (char, against):
                row.append(above[j + 1] or row[j])
            else:
                row.append(above[j] and (char == against or "?" in (char, against)))
    return row[-1]


# ---- an entry whose id is a pattern ----


def may_match(pattern: str, ids: Iterable[str]) -> bool:
    """Return whether a pattern with ``*`` and ``?`` may match one of the ids, or of their nodes."""
    return any(
        _overlap(pattern, glob_of(id)) if is_pattern(id) else matches(id, (pattern,)) for id in ids
    )


@dataclass(frozen=True)
class EntryPattern(Generic[Entry]):
    """``data`` is the entry as it is written in ``file`` at ``place``; ``key`` names its id.

    ``numbers`` are the properties that are numbers elsewhere.
    """

    id: str
    key: str
    model: type[Entry]
    data: Mapping[str, Any]
    file: str
    place: tuple[int | str, ...]
    numbers: frozenset[str] = frozenset()

    @property
    def where(self) -> str:
        return f"{self.file}: {field_path(self.place)}"

    def example_ids(self) -> Iterator[str]:
        return (example_of(self.id, value) for value in _EXAMPLES)

    def values(self, id: str) -> dict[str, str] | None:
        values = values_in(self.id, id)
        return values and {**values, "id": id}

    def entry(self, id: str, own: Mapping[str, Any] = MappingProxyType({})) -> Entry:
        """Return the entry of an id that matches; raise ``InvalidInput`` with its faults.

        The fields ``own`` are those of this id alone; lists and mappings are added to the entry's.
        """
        data: Any = filled(self.data, self.values(id) or {})
        for name, value in own.items():
            match data.get(name), value:
                case list(listed), tuple():
                    data[name] = [*dict.fromkeys((*listed, *value))]
                case dict(known), dict():
                    data[name] = known | value
                case _:
                    data[name] = value
        for name, value in data.get("properties", {}).items() if self.numbers else ():
            if name in self.numbers and isinstance(value, str):
                _read_number(self.data, data, ("properties", name))
        try:
            try:
                return self.model.model_validate(data)
            except ValidationError as error:
                # a placeholder alone may stand for a number: the coordinates, a port
                for item in error.errors(include_url=False):
                    if item["type"] in ("float_type", "int_type"):
                        _read_number(self.data, data, item["loc"])
                return self.model.model_validate(data)
        except ValidationError as error:
            faults = faults_of(error, self.model, self.file, self.place)
        raise InvalidInput(faults)

    @cached_property
    def example(self) -> Entry:
        """The entry of an id that matches, but with the pattern as its id; may be invalid."""
        in_id, where = names(self.id), field_path(self.place)
        of_domain = self.model is Node and "@" in self.id
        if len(in_id) > _MOST_PLACEHOLDERS or "id" in in_id or of_domain:
            message = f"has {len(in_id)} placeholders; write at most three"
            if of_domain:
                message = "has an '@', which is between a node and its further domain; leave it out"
            if "id" in in_id:
                meant = quoted(self.id.replace("{id}", "{n}"))
                message = f"{{id}} stands for the whole id; write another name, such as {meant}"
            raise InvalidInput.at(f"{where}.{self.key}", message, file=self.file)
        known = {"id": None, **dict.fromkeys(in_id)}
        listed = ", ".join(f"{{{name}}}" for name in known)
        faults = [
            fault(path, f"{{{name}}} is not in the id {quoted(self.id)}; write one of {listed}")
            for path, name in unknown_names(self.data, where, known)
        ]
        if faults:
            raise InvalidInput(each.within(self.file) for each in faults)
        errors = []
        for id in self.example_ids():
            try:
                return self._with_names_as_written(self.entry(id))
            except InvalidInput as error:
                errors.append(error)
        raise min(errors, key=lambda error: len(error.faults))  # some only concern a digit

    def _with_names_as_written(self, entry: Entry) -> Entry:
        # which cluster, node or domain a text with placeholders names, only a real id says
        written: dict[str, Any] = {self.key: self.id}
        if isinstance(entry, Node):
            peers = zip(self.data.get("bridged", ()), entry.bridged.items(), strict=False)
            further = zip(self.data.get("accessDomains", ()), entry.access_domains, strict=True)
            written |= {
                "cluster": self.data["cluster"],
                "bridged": {at if is_pattern(at) else id: topics for at, (id, topics) in peers},
                "access_domains": tuple(
                    domain.model_copy(update={"name": at["name"]}) for at, domain in further
                ),
            }
        return entry.model_copy(update=written)


def _read_number(
    written: Mapping[Any, Any], data: dict[Any, Any], location: tuple[int | str, ...]
) -> None:
    *path, last = location
    with suppress(KeyError):  # a key with a placeholder
        for key in path:
            written, data = written[key], data[key]
        if is_pattern(written[last]) and _NUMBER.fullmatch(data[last]):
            data[last] = float(data[last]) if "." in data[last] else int(data[last])


class EntryPatterns(dict[str, EntryPattern[Entry]]):
    """The patterns of one kind of entry; ``find`` gives an id's entry, or why it has none.

    ``problems`` says what other files make of an entry: fields, each with what is wrong there.
    """

    def __init__(
        self,
        word: str,
        patterns: Iterable[EntryPattern[Entry]],
        problems: Callable[[Entry], Iterable[tuple[str, str]]],
    ) -> None:
        super().__init__({pattern.id: pattern for pattern in patterns})
        self._word, self._problems = word, problems
        self._globs = Globs((glob_of(pattern.id), pattern) for pattern in self.values())
        self.find = lru_cache(maxsize=65_536)(self._find)

    def matching(self, id: str) -> list[EntryPattern[Entry]]:
        if len(id) > MAX_ID:  # this is refused, but only after it was looked for
            return []
        return [pattern for _, pattern in self._globs.matching(id) if pattern.values(id)]

    def _find(self, id: str) -> tuple[Entry | None, str]:
        patterns = self.matching(id)
        if len(patterns) > 1:
            named = " and ".join(f"{quoted(each.id)} in {each.where}" for each in patterns[:2])
            return None, f"matches {named}; narrow one of these patterns"
        if not patterns:
            return None, ""
        (pattern,) = patterns
        try:
            entry, place = pattern.entry(id), field_path(pattern.place)
            for field, problem in self._problems(entry):
                raise InvalidInput.at(f"{place}.{field}", problem, file=pattern.file)
            return entry, ""
        except InvalidInput as error:
            named = quoted(pattern.id)
            return None, f"is no {self._word} of the pattern {named}: {error.faults[0]}"


# ---- what the patterns of an inventory give for an id that nobody listed ----


class OnDemand(dict[str, Value]):
    """The listed entries by id; the entry of another id is made when somebody asks for it."""

    def __init__(self, listed: Mapping[str, Value], make: Callable[[str], Value | None]) -> None:
        super().__init__(listed)
        self._make = make

    def __missing__(self, id: str) -> Value:
        if (made := self._make(id)) is None:
            raise KeyError(id)
        return made

    def get(self, id: str, default: Any = None) -> Any:  # noqa: ANN401 - as of any mapping
        try:
            return self[id]
        except KeyError:
            return default

    def __contains__(self, id: object) -> bool:
        return self.get(str(id)) is not None


class Unlisted(NamedTuple):
    """A node that a pattern gives, its access domain, and for ``edge@city`` its host ``edge``."""

    node: Node
    domain: AccessDomain | None
    host: str | None


class UnlistedNodes:
    """The nodes that patterns give; ``complete`` adds to a node what its access domain says."""

    def __init__(
        self,
        patterns: EntryPatterns[Node],
        domains: Mapping[str, AccessDomain],
        complete: Callable[[Node, AccessDomain | None], Node],
    ) -> None:
        self.patterns, self._domains, self._complete = patterns, domains, complete
        self._places: dict[str, Mapping[str, list[tuple[str, AccessDomain]]]] = {}
        # of the access domains, each with the name of its domain
        self.globs = Globs((glob, name) for name, d in domains.items() for glob in d.nodes)
        self.find = lru_cache(maxsize=65_536)(self._find)

    def _find(self, id: str) -> Unlisted | None:
        host, at, name = id.partition("@")
        node, _ = self.patterns.find(host)
        if node is None:
            return None
        first, domain = self.first_domain(host), self._domains.get(name)
        if not at:
            return Unlisted(self._complete(node, first), first, None)
        # as it is written: the ROS domain of its first access domain is not that of another
        for further in node.access_domains if first and domain else ():
            if further.name == name:
                return Unlisted(self._complete(node.in_domain(further), domain), domain, host)
        return None

    def why_not(self, id: str) -> str:
        """Return why an id that a pattern matches is no node, or in no domain, else nothing."""
        host = id.partition("@")[0]
        node, problem = self.patterns.find(host)
        return self.of_several_domains(host) if node else problem

    def places(self, node: Node, clusters: Iterable[str]) -> Iterator[tuple[Node, AccessDomain]]:
        """Yield what the example of a pattern stands for, with each domain of those nodes.

        Its placeholders have values that name a cluster and further domains; others give no node.
        """
        possible = list[dict[str, str]]([{}])
        asked = [(at.name, self._domains) for at in node.access_domains]
        for text, those in ((node.cluster, clusters), *asked):
            found = (
                (known, values_in(filled(text, known), name))
                for known in possible
                for name in (those if is_pattern(text) else (text,))
            )
            possible = [known | more for known, more in found if more is not None]
        for known in possible:
            further = [
                at.model_copy(update={"name": filled(at.name, known)}) for at in node.access_domains
            ]
            there = {"cluster": filled(node.cluster, known), "access_domains": further}
            id = filled(node.id, known)
            for name in sorted({name for _, name in self.globs.overlapping(glob_of(id))}):
                yield node.model_copy(update=there), self._domains[name]

    def places_by_id(
        self, node: Node, clusters: Iterable[str]
    ) -> Mapping[str, list[tuple[str, AccessDomain]]]:
        """Return each cluster and domain of the nodes of a pattern, and of those in its further
        domains, by the id as it is written: ``vehicle{n}@{area}``.
        """
        if node.id not in self._places:  # there may be many
            found = defaultdict[str, dict[tuple[str, str], tuple[str, AccessDomain]]](dict)
            for there, first in self.places(node, clusters):
                found[node.id][there.cluster, first.name] = there.cluster, first
                for written, at in zip(node.access_domains, there.access_domains, strict=True):
                    domain = self._domains.get(at.name)
                    if domain and domain is not first:
                        id = id_in_domain(node.id, written.name)
                        found[id][there.cluster, at.name] = there.cluster, domain
            self._places[node.id] = defaultdict(
                list, {id: [*places.values()] for id, places in found.items()}
            )
        return self._places[node.id]

    def first_domain(self, id: str) -> AccessDomain | None:
        names = {name for _, name in self.globs.matching(id)}
        return self._domains[names.pop()] if len(names) == 1 else None

    def of_several_domains(self, id: str) -> str:
        """Return which access domains match an id, if these are several; then it is in none."""
        by_name = {name: glob for glob, name in self.globs.matching(id)}
        if len(by_name) < 2:
            return ""
        named = " and ".join(f"'{name}' by {quoted(by_name[name])}" for name in sorted(by_name))
        return f"is in the access domains {named}; narrow these patterns"
