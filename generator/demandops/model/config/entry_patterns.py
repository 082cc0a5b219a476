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
from demandops.base.quoting import quoted
from demandops.model.config.base_model import faults_of, matches
from demandops.model.config.inventory import Node
from demandops.model.config.policy import AccessDomain

Entry = TypeVar("Entry", bound=BaseModel)
Value = TypeVar("Value")

# `${n}` and `{{n}}` mean something to others, and are plain text
_PLACEHOLDER = re.compile(r"(?<![${])\{([a-z][a-z0-9_]*)\}(?!\})")
# What a placeholder stands for in an id. None of these characters means anything in an expression
# or a path; what a topic or an address does not allow is a fault of the node.
_VALUE = "[A-Za-z0-9._-]+"
_NUMBER = re.compile(r"-?[0-9]+(\.[0-9]+)?")
# More would take long to match, as each may be of any length
_MOST_PLACEHOLDERS = 3
# A pattern whose entry is valid for one of these is valid. Some texts may not begin with a digit.
_EXAMPLES = ("1", "a")


# ---- patterns with `*` and `?`, found without a look at each of them ----


class Globs(Generic[Value]):
    """Patterns, each with a value, by the text before or after their wildcards."""

    def __init__(self, entries: Iterable[tuple[str, Value]]) -> None:
        self._by_start = defaultdict[str, list[tuple[str, Value]]](list)
        self._by_end = defaultdict[str, list[tuple[str, Value]]](list)
        for glob, value in entries:
            start, *further = re.split("[*?]", glob)
            end = further[-1] if further else ""
            known = self._by_end[end] if len(end) > len(start) else self._by_start[start]
            known.append((glob, value))
        self._starts = sorted(self._by_start)

    def matching(self, id: str) -> Iterator[tuple[str, Value]]:
        for cut in range(len(id) + 1):
            for known in (self._by_start.get(id[:cut], ()), self._by_end.get(id[cut:], ())):
                yield from (each for each in known if matches(id, (each[0],)))

    def overlapping(self, glob: str) -> Iterator[tuple[str, Value]]:
        """Yield each pattern that some text matches that ``glob`` matches too."""
        start, starts = re.split("[*?]", glob)[0], self._starts
        longer = starts[bisect_left(starts, start) : bisect_left(starts, f"{start}\U0010ffff")]
        shorter = (start[:cut] for cut in range(len(start)))
        by_start = (self._by_start.get(key, ()) for key in (*shorter, *longer))
        for known in (*by_start, *self._by_end.values()):
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


def is_pattern(id: object) -> bool:
    return isinstance(id, str) and _PLACEHOLDER.search(id) is not None


def glob_of(id: str) -> str:
    return _PLACEHOLDER.sub("?*", id)


@dataclass(frozen=True)
class EntryPattern(Generic[Entry]):
    """``data`` is the entry as it is written in ``file`` at ``place``; ``key`` names its id."""

    id: str
    key: str
    model: type[Entry]
    data: Mapping[str, Any]
    file: str
    place: tuple[int | str, ...]

    @property
    def where(self) -> str:
        return f"{self.file}: {field_path(self.place)}"

    @property
    def glob(self) -> str:
        return glob_of(self.id)

    def example_ids(self) -> Iterator[str]:
        return (_PLACEHOLDER.sub(value, self.id) for value in _EXAMPLES)

    def values(self, id: str) -> dict[str, str] | None:
        match = _expression(self.id).fullmatch(id)
        return {**match.groupdict(), "id": id} if match else None

    def entry(self, id: str, own: Mapping[str, Any] = MappingProxyType({})) -> Entry:
        """Return the entry of an id that matches; raise ``InvalidInput`` with its faults.

        The fields ``own`` are those of this id alone.
        """
        filled: Any = _filled(self.data, self.values(id) or {})
        data: Any = {**filled, **own}
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
        in_id = _PLACEHOLDER.findall(self.id)
        if len(in_id) > _MOST_PLACEHOLDERS:
            message = f"{quoted(self.id)} has {len(in_id)} placeholders; write at most three"
            raise InvalidInput([fault(field_path(self.place), message).within(self.file)])
        names = {"id": None, **dict.fromkeys(in_id)}
        if unknown := [name for name in _names_in(self.data) if name not in names]:
            known = ", ".join(f"{{{name}}}" for name in names)
            message = f"{{{unknown[0]}}} is not in the id {quoted(self.id)}; write one of {known}"
            raise InvalidInput([fault(field_path(self.place), message).within(self.file)])
        errors = []
        for id in self.example_ids():
            try:
                return self.entry(id).model_copy(update={self.key: self.id})
            except InvalidInput as error:
                errors.append(error)
        raise min(errors, key=lambda error: len(error.faults))  # some only concern a digit


@lru_cache(maxsize=65_536)
def _expression(pattern: str) -> re.Pattern[str]:
    expression, seen = "", set[str]()
    for index, part in enumerate(_PLACEHOLDER.split(pattern)):  # texts and names in turn
        if index % 2 == 0:
            expression += re.escape(part)
        else:
            expression += f"(?P={part})" if part in seen else f"(?P<{part}>{_VALUE})"
            seen.add(part)
    return re.compile(expression)


def any_value_of(text: str) -> str:
    """Return a regular expression of RE2 for each text that a text with placeholders may become."""
    parts = _PLACEHOLDER.split(text)
    return _VALUE.join(map(re.escape, parts[::2]))


def _filled(part: object, values: Mapping[str, str]) -> object:
    if isinstance(part, str):
        return _PLACEHOLDER.sub(lambda match: values.get(match[1], match[0]), part)
    if isinstance(part, dict):
        return {_filled(key, values): _filled(value, values) for key, value in part.items()}
    return [_filled(each, values) for each in part] if isinstance(part, list) else part


def _names_in(part: object) -> Iterator[str]:
    if isinstance(part, str):
        yield from _PLACEHOLDER.findall(part)
    elif isinstance(part, dict | list):
        for each in (*part, *part.values()) if isinstance(part, dict) else part:
            yield from _names_in(each)


def _read_number(
    written: Mapping[Any, Any], data: dict[Any, Any], location: tuple[int | str, ...]
) -> None:
    *path, last = location
    with suppress(KeyError):  # a key with a placeholder
        for key in path:
            written, data = written[key], data[key]
        if is_pattern(written[last]) and _NUMBER.fullmatch(data[last]):
            data[last] = float(data[last]) if "." in data[last] else int(data[last])


def only_entry(patterns: Iterable[EntryPattern[Entry]]) -> Callable[[str], Entry | None]:
    """Return a function that gives the valid entry of the only pattern that matches an id."""
    globs = Globs((pattern.glob, pattern) for pattern in patterns)

    @lru_cache(maxsize=65_536)
    def entry(id: str) -> Entry | None:
        matching = [pattern for _, pattern in globs.matching(id) if pattern.values(id)]
        with suppress(InvalidInput):
            return matching[0].entry(id) if len(matching) == 1 else None
        return None

    return entry


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
    """A node that a pattern gives, its access domain, and the id of the machine (``edge``)."""

    node: Node
    domain: AccessDomain | None
    host: str


class UnlistedNodes:
    """The nodes that patterns give; ``complete`` adds to a node what its access domain says."""

    def __init__(
        self,
        patterns: Iterable[EntryPattern[Node]],
        domains: Mapping[str, AccessDomain],
        complete: Callable[[Node, AccessDomain | None], Node],
    ) -> None:
        self._patterns = Globs((pattern.glob, pattern) for pattern in patterns)
        self._domains, self._complete = domains, complete
        self._globs = Globs((glob, name) for name, d in domains.items() for glob in d.nodes)
        self.find = lru_cache(maxsize=65_536)(self._find)

    def _find(self, id: str) -> Unlisted | None:
        host, _, name = id.rpartition("@")
        if not host:
            node, domain, _ = self._made(id)
            return Unlisted(self._complete(node, domain), domain, id) if node else None
        of_host, domain = self.find(host), self._domains.get(name)
        for further in of_host.node.access_domains if of_host and domain else ():
            if of_host and further.name == name:
                node = of_host.node.in_domain(further)
                return Unlisted(self._complete(node, domain), domain, host)
        return None

    def other_host(self, id: str) -> str | None:
        # as `Config.hosts`: for `edge@city`, but not for `edge`
        made = self.find(id)
        return made.host if made and made.host != id else None

    def why_not(self, id: str) -> str:
        """Return why an id that a pattern matches is no node, or in no domain, else nothing."""
        return self._made(id)[2]

    def possible_domains(self, pattern: str) -> list[AccessDomain]:
        names = {name for _, name in self._globs.overlapping(glob_of(pattern))}
        return [self._domains[name] for name in sorted(names)]

    def candidates(self, id: str) -> Iterator[tuple[str, EntryPattern[Node]]]:
        return self._patterns.matching(id)

    def _made(self, id: str) -> tuple[Node | None, AccessDomain | None, str]:
        patterns = [pattern for _, pattern in self._patterns.matching(id) if pattern.values(id)]
        if len(patterns) > 1:
            named = " and ".join(f"{quoted(each.id)} in {each.where}" for each in patterns[:2])
            return None, None, f"matches {named}; narrow one of these patterns"
        if not patterns:
            return None, None, ""
        (pattern,) = patterns
        try:
            node = pattern.entry(id)
        except InvalidInput as error:
            return None, None, f"is no node of the pattern {quoted(pattern.id)}: {error.faults[0]}"
        by_name = {name: glob for glob, name in self._globs.matching(id)}
        if len(by_name) > 1:
            named = " and ".join(f"'{name}' by {quoted(by_name[name])}" for name in sorted(by_name))
            return node, None, f"is in the access domains {named}; narrow these patterns"
        return node, self._domains[min(by_name)] if by_name else None, ""


NOTHING_UNLISTED = UnlistedNodes((), {}, lambda node, _: node)
