"""Strict reading and deterministic writing of YAML.

The program reads a YAML file with :func:`load` or, if the file may have several documents, with
:func:`load_all`. A scalar without quotes means what it means to Helm and kubectl, which read with
go-yaml 2: numbers as YAML 1.2 has them, and ``yes``, ``on`` or ``0644`` as YAML 1.1. Duplicate
keys, anchors and tags are errors. :func:`dump` writes text so that all parsers, of YAML 1.1 and 1.2
and Go's mixtures of both, read the same text.
"""

from __future__ import annotations

import json
import marshal
import math
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache, lru_cache
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import yaml

from demandops.base.errors import Fault, InvalidInput

# libyaml, which not every build of PyYAML has, reads and writes several times as fast
_CLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_CDumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)

# How many characters a file may have; an inventory of 20,000 nodes has fewer
MAX_LENGTH = 4_000_000
MAX_DEPTH = 100

_Result = TypeVar("_Result")
_LONGEST_WORD = 1_000


def _cached(function: Callable[[str], _Result]) -> Callable[[str], _Result]:
    # Words repeat often. Long texts, which requesters may send again and again, would fill the
    # memory.
    of_words = lru_cache(16_384)(function)
    return lambda text: (of_words if len(text) <= _LONGEST_WORD else function)(text)


# ---- what a scalar without quotes means: the rules of go-yaml 2 (resolve.go) ----

_WORDS: Mapping[str, bool | None] = dict.fromkeys(("", "~", "null", "Null", "NULL")) | {
    form: value
    for value, words in ((True, "true yes on y"), (False, "false no off n"))
    for word in words.split()
    for form in (word, word.title(), word.upper())
}
_WITH_BASE = re.compile(r"[-+]?0([xX][0-9a-fA-F]+|[bB][01]+|[oO]?[0-7]+)")
_DECIMAL = re.compile(r"[-+]?[0-9]*(?:\.[0-9_]*)?(?:[eE][-+]?[0-9]+)?")
_NOT_IN_JSON = re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")


@_cached
def plain_value(text: str) -> str | float | bool | None:
    """Return what a scalar without quotes means, such as 420 for ``0o644``."""
    if text in _WORDS:
        return _WORDS[text]
    if text[0] not in "+-.0123456789":
        return text  # dates, times and `12:30` too are text
    if _NOT_IN_JSON.fullmatch(text):
        raise ValueError(f"{text} is no number to Helm or JSON; write a number, or use quotes")
    # `1_000` is a number, but before a point Go wants a digit on both sides of each `_`
    digits = text if text.startswith(".") else text.replace("_", "")
    if _WITH_BASE.fullmatch(digits):
        is_old = digits.lstrip("+-")[1:].isdigit()  # 0644 is octal in YAML 1.1
        number = int(digits, 8 if is_old else 0)
        if -(2**63) <= number < 2**64:
            return number
        if not is_old:
            return text
    with suppress(ValueError):  # of `-` and `.5_`
        # what is too large for 64 bits is text to Go
        if _DECIMAL.fullmatch(digits) and math.isfinite(value := float(digits)):
            return int(digits) if digits.lstrip("+-").isdigit() else value
    return text


# ---- reading ----

_TAG = "tag:yaml.org,2002:"
# the tag `!` says that the scalar is text
_TAGS = {
    yaml.ScalarEvent: (None, "!", f"{_TAG}str"),
    yaml.SequenceStartEvent: (None, "!", f"{_TAG}seq"),
    yaml.MappingStartEvent: (None, "!", f"{_TAG}map"),
}


# How many characters a key may have as :func:`to_json` writes it: YAML ends such keys there. An
# escape has up to six.
_LONGEST_KEY = 1024
_MOST_UNCHECKED = 128


def _problem(what: str, at: Any) -> yaml.YAMLError:  # noqa: ANN401 - an event or a node
    return yaml.constructor.ConstructorError(None, None, what, at.start_mark)


class Loader(_CLoader):  # type: ignore[misc]
    """Builds the values of a text in one pass over libyaml's events."""

    def documents(self, most: float = math.inf) -> Iterator[Any]:
        while not isinstance(event := self.get_event(), yaml.StreamEndEvent):
            if isinstance(event, yaml.DocumentStartEvent):
                most -= 1
                if most < 0:
                    raise _problem("another document starts here; only one is allowed", event)
                yield self._value(self.get_event(), 1)

    def _value(self, event: Any, depth: int) -> Any:  # noqa: ANN401, PLR0912
        kind = type(event)
        if kind is yaml.AliasEvent or event.anchor:
            # a few lines of aliases of aliases would grow to more than the memory holds
            where = f"line {event.start_mark.line + 1}"
            message = "anchors and aliases (& and *) are not allowed; write the value out"
            raise InvalidInput.at(where, message)
        if event.tag not in _TAGS[kind]:
            raise _problem(
                f"the tag {short_repr(event.tag)} is not allowed; write plain data", event
            )
        if kind is yaml.ScalarEvent:
            if event.tag or not event.implicit[0]:
                return event.value
            try:
                return plain_value(event.value)
            except ValueError as error:
                raise _problem(str(error), event) from None
        # recursive code that later reads the values could exceed Python's limit
        if depth > MAX_DEPTH:
            raise InvalidInput.at("", f"is nested deeper than {MAX_DEPTH} levels; make it flatter")
        if kind is yaml.SequenceStartEvent:
            items = []
            while type(event := self.get_event()) is not yaml.SequenceEndEvent:
                items.append(self._value(event, depth + 1))
            return items
        mapping: dict[str, Any] = {}
        while type(event := self.get_event()) is not yaml.MappingEndEvent:
            key = self._value(event, depth + 1)
            if isinstance(key, bool) and event.value in "yYnN":
                key = event.value  # a coordinate, rather than yes or no
            if not isinstance(key, str):  # Helm reads the key `on` as true
                shown = getattr(event, "value", "") or short_repr(key)
                raise _problem(f"the key {shown} must be text; put it in quotes", event)
            if len(key) > _MOST_UNCHECKED and len(to_json(key)) > _LONGEST_KEY:
                message = f"a key has more than {_LONGEST_KEY} characters; shorten it"
                raise _problem(message, event)
            if key == "<<" and event.implicit[0]:
                raise _problem("'<<' is not allowed; write the fields out", event)
            if key in mapping:  # parsers differ in which of the two counts
                raise _problem(f"the key {key!r} appears twice; remove one", event)
            mapping[key] = self._value(self.get_event(), depth + 1)
        return mapping


def short_repr(value: object) -> str:
    if value is None or isinstance(value, bool):
        return json.dumps(value)
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "…"


def load_all(text: str, file: str = "", most: float = math.inf) -> Iterator[Any]:
    # an error may come only after some documents
    if len(text) > MAX_LENGTH:
        message = f"has {len(text)} characters; at most {MAX_LENGTH} are allowed"
        raise InvalidInput.at("", message, file=file)
    try:
        yield from Loader(text).documents(most)
    except yaml.YAMLError as error:
        mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None)
        where = f"line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        message = f"not valid YAML: {problem or str(error).splitlines()[0]}"
        raise InvalidInput.at(where, message, file=file) from error
    except ValueError as error:  # of libyaml, for `"\Uffffffff"`
        message = "not valid YAML: it has a character that cannot be read"
        raise InvalidInput.at("", message, file=file) from error
    except InvalidInput as error:
        raise InvalidInput(faults_in(error, file)) from None


# How many characters a text may have for its value to be cached
_MOST_CACHED = 10_000


def load(text: str, file: str = "") -> Any:  # noqa: ANN401 - raw YAML, which models then parse
    try:
        if len(text) > _MOST_CACHED:
            return _only_document(text)
        return marshal.loads(_document_as_bytes(text))  # noqa: S302 - bytes of this process
    except InvalidInput as error:
        raise InvalidInput(faults_in(error, file)) from error.__cause__


# Most files are unchanged when a configuration is loaded again. To read the bytes takes a fiftieth
# of the time of parsing, and gives each caller a copy of its own.
@lru_cache(1024)
def _document_as_bytes(text: str) -> bytes:
    return marshal.dumps(_only_document(text))


def _only_document(text: str) -> Any:  # noqa: ANN401
    documents = [*load_all(text, most=1)]
    return documents[0] if documents else None


# ---- writing ----

# Finds texts that every parser reads as text without quotes, except for a few words
_PLAIN = re.compile(r"[A-Za-z/][A-Za-z0-9_./-]*(?:[:@=][A-Za-z0-9_./-]+)*")
_NOT_TEXT = {word.lower() for word in _WORDS} | {"nan", "inf", "infinity", "none"}

_START = yaml.DocumentStartEvent(explicit=False)
_END = yaml.DocumentEndEvent(explicit=False)
_MAPPING = yaml.MappingStartEvent(None, None, True, flow_style=False), yaml.MappingEndEvent()
_SEQUENCE = yaml.SequenceStartEvent(None, None, True, flow_style=False), yaml.SequenceEndEvent()


class Dumper(_CDumper):  # type: ignore[misc]
    """Writes values in the order in which they are, and text in quotes if it needs them."""

    def represent(self, data: object) -> None:
        self.emit(_START)
        self._write(data)
        self.emit(_END)

    def _write(self, value: Any) -> None:  # noqa: ANN401
        # PyYAML's own would write an anchor for a part that occurs twice, and `load` takes none
        if isinstance(value, str):
            self.emit(_text(value))
        elif isinstance(value, list | tuple):
            self.emit(_SEQUENCE[0])
            for item in value:
                self._write(item)
            self.emit(_SEQUENCE[1])
        elif isinstance(value, Mapping):
            self.emit(_MAPPING[0])
            for key, item in value.items():
                self.emit(_text(key))
                self._write(item)
            self.emit(_MAPPING[1])
        else:
            self.emit(yaml.ScalarEvent(None, None, (True, False), to_json(value)))


def dump(data: Mapping[str, Any]) -> str:
    return str(yaml.dump(data, Dumper=Dumper, allow_unicode=True, width=4096))


@_cached
def _text(text: str) -> yaml.ScalarEvent:
    """Return PyYAML's event that writes a text, in quotes if a parser could misread it."""
    if _PLAIN.fullmatch(text) and text.lower() not in _NOT_TEXT:
        return yaml.ScalarEvent(None, None, (True, False), text)
    # a literal block has no escapes, and with another begin or end it would need an indicator
    is_block = (
        text.endswith("\n")
        and not text.endswith("\n\n")
        and not text.startswith((" ", "\n"))
        and text.count("\n") > 1
        and not re.search(r"[ \t]\n|[^\x20-\x7e\n]", text)
    )
    style = "|" if is_block else '"'
    return yaml.ScalarEvent(None, None, (False, True), text, style=style)


def set_key(text: str, key: str, value: object) -> str:
    """Return a file's text with one top-level key set; the rest stays, including comments.

    A form that does not permit this, such as a list, is a fault.
    """
    before, written = load(text), dump({key: value})
    line = re.compile(rf"^{re.escape(key)}:.*?(?=[ \t]*(?:#.*)?\r?$)", re.MULTILINE)
    changed, count = line.subn(lambda _: written.rstrip("\n"), text, count=1)
    if not count:
        added = f"{'' if text.endswith(chr(10)) else chr(10)}\n{written}"
        # a file from Windows keeps its line ends
        changed = text + (added.replace("\n", "\r\n") if "\r\n" in text else added)
    with suppress(InvalidInput, TypeError):  # the text may have another form, such as flow style
        if load(changed) == {**before, key: value}:
            return changed
    message = f"cannot be set automatically; set it to {short_repr(value)} by hand"
    raise InvalidInput.at(key, message)


def set_flag(text: str, items: str, id: str, key: str, value: bool) -> str:
    """Return a file's text with a key of one item of a list set; the rest stays, with comments.

    A key whose line has nothing else is taken away instead of set to false, which is the default.
    """
    wanted, written = load(text), f"{key}: {str(value).lower()}"
    found = next(item for item in wanted[items] if item["id"] == id)
    found[key] = value
    root: Any = yaml.compose(text, Loader=_CLoader)
    for item in next(each for node, each in root.value if node.value == items).value:
        entries = {node.value: (node, each) for node, each in item.value}
        if entries["id"][1].value != id:
            continue
        if key in entries:
            start, end = entries[key][0].start_mark.index, entries[key][1].end_mark.index
            first, last = text.rfind("\n", 0, start) + 1, text.find("\n", end) + 1
            if not value and last and not text[first:start].strip():
                del found[key]
                start, end, written = first, last, ""
            changed = f"{text[:start]}{written}{text[end:]}"
        elif item.flow_style:
            end = entries["id"][1].end_mark.index
            changed = f"{text[:end]}, {written}{text[end:]}"
        else:
            place, line_end = entries["id"], "\r\n" if "\r\n" in text else "\n"
            end = text.find("\n", place[1].end_mark.index) + 1
            line = f"{' ' * place[0].start_mark.column}{written}{line_end}"
            changed = f"{text[:end]}{line}{text[end:]}" if end else f"{text}{line_end}{line}"
        with suppress(InvalidInput):  # such as a key in an anchor that other items share
            if load(changed) == wanted:
                return changed
    raise InvalidInput.at(items, f"cannot be changed automatically; write {written} at '{id}'")


# Finds the digits before the `e` of a JSON number like `1e-09`. YAML 1.1 would read such a number
# as text. The pattern matches quoted texts as a whole, so that no digits inside them are found.
_EXPONENT = re.compile(r'"(?:[^"\\]|\\.)*"|(?<![0-9.])([0-9]+)(?=e)')
_UNPRINTABLE = re.compile("[\x7f-\x9f\u2028\u2029\ud800-\udfff\ufeff\ufffe\uffff]")


def to_json(value: object) -> str:
    """Return JSON that is also valid YAML; ``{{ … }}`` in a template writes this text."""
    text = _JSON.encode(value)
    if "e-" in text or "e+" in text:
        text = _EXPONENT.sub(lambda match: f"{match[1]}.0" if match[1] else match[0], text)
    return _UNPRINTABLE.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def _unknown(value: object) -> object:
    kind = getattr(type(value), "__name__", "object")
    if callable(value):
        kind += "; add '()' to call it"
    raise TypeError(
        "a template may write text, numbers, true, false, null, lists and mappings, but not a "
        f"{kind}"
    )


_JSON = json.JSONEncoder(ensure_ascii=False, allow_nan=False, default=_unknown)


def faults_in(error: InvalidInput, file: str) -> list[Fault]:
    return [fault.within(file) for fault in error.faults]


# ---- the lines of a file's fields, so that a fault can name its line ----


def lines(text: str, document: int = 0) -> dict[str, int]:
    """Return the line of each field of a document; empty if :func:`load_all` refuses the text."""
    by_field: dict[str, int] = {}

    def add(node: yaml.Node | None, path: str) -> None:
        if isinstance(node, yaml.MappingNode):
            for key, value in node.value:
                field = f"{path}.{key.value}" if path else str(key.value)
                by_field[field] = key.start_mark.line + 1
                add(value, field)
        elif isinstance(node, yaml.SequenceNode):
            for index, item in enumerate(node.value):
                by_field[f"{path}[{index}]"] = item.start_mark.line + 1
                add(item, f"{path}[{index}]")

    with suppress(InvalidInput, yaml.YAMLError):
        for _ in load_all(text):  # refuses what nests too deeply for `add`
            pass
        nodes = yaml.compose_all(text, Loader=_CLoader)
        add(next(islice(nodes, document, None), None), "")
    return by_field


def nearest(field: str, lines: Mapping[str, int]) -> int | None:
    # the field of a fault may be missing in the file, or be only a part of a text
    while field and field not in lines:
        field = field[: max(field.rfind("."), field.rfind("["), 0)]
    return lines[field] if field else None


def with_lines(faults: Iterable[Fault], text_of: Callable[[str], str | None]) -> list[Fault]:
    lines_of = cache(lambda file: lines(text_of(file) or ""))
    return [
        replace(fault, line=nearest(fault.field, lines_of(fault.file)))
        if fault.field and not fault.line
        else fault
        for fault in faults
    ]


@contextmanager
def located_in(text: str) -> Iterator[None]:
    try:
        yield
    except InvalidInput as error:
        raise InvalidInput(with_lines(error.faults, lambda _: text)) from None


# ---- files that a person names for a command or for the service: texts and secrets ----


def read_input(file: str | Path) -> tuple[str, str]:
    # the name as messages give it; `-` is standard input
    name = "standard input" if file == "-" else str(file)
    try:
        data = sys.stdin.buffer.read() if file == "-" else Path(file).read_bytes()
        return name, data.decode("utf-8")
    except UnicodeDecodeError:
        problem = "is not UTF-8 text; save it as UTF-8"
    except (OSError, ValueError) as error:  # a ValueError if the path has the character NUL
        problem = f"cannot be read: {getattr(error, 'strerror', None) or error}; check the path"
    raise InvalidInput.at("", problem, file=name)


def read_secret(path: Path, *, private: bool = False) -> bytes:
    # `private` refuses a file on which everybody has a right
    secret = b""
    try:
        # the group may have rights: a Secret's volume in Kubernetes gives the file to fsGroup
        if private and path.stat().st_mode & 0o007:
            problem = "is open to everybody on this machine; run chmod o= on it"
        else:
            # editors and `echo` end a file with a line break, which is no part of the secret
            secret = path.read_bytes().rstrip(b"\r\n")
            problem = "is empty; write the secret into this file"
    except (OSError, ValueError) as error:  # a ValueError if the path has the character NUL
        why = getattr(error, "strerror", None) or error
        problem = f"cannot be read: {why}; write the secret into this file, and make it readable"
    if not secret.strip():
        raise InvalidInput.at("", problem, file=str(path))
    return secret
