"""Strict reading and deterministic writing of YAML.

The program reads a YAML file with :func:`load` or, if the file may have several documents, with
:func:`load_all`. Duplicate keys, anchors and tags are errors. :func:`dump` writes strings so that
YAML 1.1 and 1.2, PyYAML and Go's parsers read the same value.
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
from functools import lru_cache
from itertools import islice
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import yaml

from demandops.base.errors import Fault, InvalidInput

# libyaml, which not every build of PyYAML has, reads and writes several times as fast
LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_Dumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)

# Finds texts that every parser reads as text without quotes, except for a few words
_PLAIN = re.compile(r"[A-Za-z/][A-Za-z0-9_./-]*(?:[:@=][A-Za-z0-9_./-]+)*")
_WORDS = frozenset(
    ["y", "n", "yes", "no", "on", "off", "true", "false", "null", "nan", "inf", "infinity", "none"]
)  # some parsers do not read these words as text

# How many characters a file may have; an inventory of 20,000 nodes has fewer
MAX_LENGTH = 4_000_000
MAX_DEPTH = 100
# How many bits a whole number may have. Python prints at most 4,300 digits.
_MAX_BITS = 14_000
# what PyYAML raises, beside its own errors, for texts that do not fit a tag, such as `!!int x`
_MISFITS = (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError)

# Finds the digits before the `e` of a JSON number like `1e-09`. YAML 1.1 would read such a number
# as text. The pattern matches quoted texts as a whole, so that no digits inside them are found.
_EXPONENT = re.compile(r'"(?:[^"\\]|\\.)*"|(?<![0-9.])([0-9]+)(?=e)')
_UNPRINTABLE = re.compile("[\x7f-\x9f\u2028\u2029\ud800-\udfff\ufeff\ufffe\uffff]")

_TAG = "tag:yaml.org,2002:"
_TEXT = f"{_TAG}str"
_RESOLVER, _CONSTRUCTOR = yaml.resolver.Resolver(), yaml.constructor.SafeConstructor()
_REPRESENTER = yaml.representer.SafeRepresenter()

_Result = TypeVar("_Result")
_LONGEST_WORD = 1_000


def _cached(function: Callable[[str], _Result]) -> Callable[[str], _Result]:
    # Words repeat often. Long texts, which requesters may send again and again, would fill the
    # memory.
    of_words = lru_cache(16_384)(function)
    return lambda text: (of_words if len(text) <= _LONGEST_WORD else function)(text)


@_cached
def _tag_of(text: str) -> str:
    # (True, False): the scalar has no quotes
    return str(_RESOLVER.resolve(yaml.ScalarNode, text, (True, False)))  # type: ignore[no-untyped-call]


def _integer(node: yaml.ScalarNode) -> int:
    number: int = _CONSTRUCTOR.construct_yaml_int(node)
    if number.bit_length() > _MAX_BITS:
        raise _problem(f"a whole number has more than {_MAX_BITS} bits; shorten it", node)
    return number


# The function that makes the value of a date, number, truth value or null, by YAML tag
_CONSTRUCT: Mapping[str, Callable[[yaml.ScalarNode], Any]] = {
    f"{_TAG}timestamp": _CONSTRUCTOR.construct_scalar,  # dates stay text
    f"{_TAG}int": _integer,
    f"{_TAG}float": _CONSTRUCTOR.construct_yaml_float,
    f"{_TAG}bool": _CONSTRUCTOR.construct_yaml_bool,
    f"{_TAG}null": _CONSTRUCTOR.construct_yaml_null,
}


def _problem(what: str, at: Any) -> yaml.YAMLError:  # noqa: ANN401 - an event or a node
    return yaml.constructor.ConstructorError(None, None, what, at.start_mark)


class _Misread(Exception):
    # stand-ins (_STAND_IN) cannot replace the lists of a text
    pass


class _Parser:
    """Builds the values of a text in one pass over PyYAML's events."""

    # `lists` maps each placeholder (`_STAND_IN`) in the text to the list that it replaces
    def __init__(self, text: str, lists: Mapping[str, list[str]] = MappingProxyType({})) -> None:
        self._next, self._lists = LOADER(text).get_event, dict(lists)

    def documents(self, most: float) -> Iterator[Any]:
        while not isinstance(event := self._next(), yaml.StreamEndEvent):
            if isinstance(event, yaml.DocumentStartEvent):
                most -= 1
                if most < 0:
                    raise _problem("another document starts here; only one is allowed", event)
                yield self._value(self._next(), 1)
        if self._lists:
            raise _Misread

    def _value(self, event: Any, depth: int) -> Any:  # noqa: ANN401
        kind = type(event)
        if kind is yaml.AliasEvent or event.anchor:
            # a few lines of aliases of aliases would grow to more than the memory holds
            where = f"line {event.start_mark.line + 1}"
            message = "anchors and aliases (& and *) are not allowed; write the value out"
            raise InvalidInput.at(where, message)
        if kind is yaml.ScalarEvent and event.value in self._lists:
            if event.tag or not event.implicit[0] or depth > MAX_DEPTH:
                raise _Misread
            return self._lists.pop(event.value)
        if kind is yaml.ScalarEvent:
            return self._scalar(event)
        # recursive code that later reads the values could exceed Python's limit
        if depth > MAX_DEPTH:
            raise InvalidInput.at("", f"is nested deeper than {MAX_DEPTH} levels; make it flatter")
        name = "seq" if kind is yaml.SequenceStartEvent else "map"
        if event.tag not in (None, "!", f"{_TAG}{name}"):
            raise _refused_tag(event.tag, event)
        if name == "seq":
            items = []
            while type(event := self._next()) is not yaml.SequenceEndEvent:
                items.append(self._value(event, depth + 1))
            return items
        mapping: dict[str, Any] = {}
        while type(event := self._next()) is not yaml.MappingEndEvent:
            key = self._value(event, depth + 1)
            if not isinstance(key, str):  # YAML 1.1 reads the key `on` as true
                raise _problem(f"the key {short_repr(key)} must be text; put it in quotes", event)
            if key in mapping:  # parsers differ in which of the two counts
                raise _problem(f"the key {key!r} appears twice; remove one", event)
            mapping[key] = self._value(self._next(), depth + 1)
        return mapping

    def _scalar(self, event: Any) -> Any:  # noqa: ANN401
        tag = event.tag
        if tag is None or tag == "!":
            tag = _tag_of(event.value) if event.implicit[0] else _TEXT
        if tag == _TEXT:
            return event.value
        if tag not in _CONSTRUCT:
            raise _refused_tag(tag, event)
        return _CONSTRUCT[tag](yaml.ScalarNode(tag, event.value, event.start_mark))


def _refused_tag(tag: str, at: Any) -> yaml.YAMLError:  # noqa: ANN401
    return _problem(f"the tag {short_repr(tag)} is not allowed; write plain data", at)


_START = (yaml.StreamStartEvent(), yaml.DocumentStartEvent(explicit=False))
_END = (yaml.DocumentEndEvent(explicit=False), yaml.StreamEndEvent())
_MAPPING = yaml.MappingStartEvent(None, None, True, flow_style=False), yaml.MappingEndEvent()
_SEQUENCE = yaml.SequenceStartEvent(None, None, True, flow_style=False), yaml.SequenceEndEvent()


def _events(value: Any) -> Iterator[yaml.Event]:  # noqa: ANN401
    # PyYAML's own dumper would write an anchor for a part that occurs twice, and `load` takes none
    if isinstance(value, str):
        yield _text(value)
    elif isinstance(value, list | tuple):
        yield _SEQUENCE[0]
        for item in value:
            yield from (_text(item),) if isinstance(item, str) else _events(item)
        yield _SEQUENCE[1]
    elif isinstance(value, Mapping):
        yield _MAPPING[0]
        for key, item in value.items():
            yield _text(key)
            yield from _events(item)
        yield _MAPPING[1]
    else:
        number = str(_REPRESENTER.represent_data(value).value)
        yield yaml.ScalarEvent(None, None, (True, False), number)


@_cached
def _text(text: str) -> yaml.ScalarEvent:
    """Return PyYAML's event that writes a text, in quotes if a parser could misread it."""
    if _PLAIN.fullmatch(text) and text.lower() not in _WORDS:
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


def short_repr(value: object) -> str:
    if value is None or isinstance(value, bool):
        return json.dumps(value)
    try:
        text = repr(value)
    except ValueError:  # Python does not print numbers of more than 4300 digits
        return "a number with thousands of digits"
    return text if len(text) <= 60 else text[:57] + "…"


@contextmanager
def _strict(file: str) -> Iterator[None]:
    try:
        yield
    except yaml.YAMLError as error:
        mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None)
        where = f"line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        message = f"not valid YAML: {problem or str(error).splitlines()[0]}"
        raise InvalidInput.at(where, message, file=file) from error
    except _MISFITS as error:
        message = "not valid YAML: it has a tag, number or character that cannot be read"
        raise InvalidInput.at("", message, file=file) from error
    except InvalidInput as error:
        raise InvalidInput(faults_in(error, file)) from None


def load_all(text: str, file: str = "", most: float = math.inf) -> Iterator[Any]:
    # an error may come only after some documents
    if len(text) > MAX_LENGTH:
        message = f"has {len(text)} characters; at most {MAX_LENGTH} are allowed"
        raise InvalidInput.at("", message, file=file)
    with _strict(file):
        yield from _Parser(text).documents(most)


# Matches a field with a list of plain texts, as `to_json` writes it
_LISTED = re.compile(
    r'^( *[A-Za-z][\w-]*: )(\["[ !#-\[\]-~]*"(?:, "[ !#-\[\]-~]*")*\])$', re.MULTILINE
)
# Lists of at least this many characters are read by the json module. It is 20 times faster than
# PyYAML.
_LONG = 200
# The prefix of the stand-ins: words that replace long lists while PyYAML reads the other text
_STAND_IN = "demandops-list"

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
    lists: dict[str, list[str]] = {}

    def stand_in(match: re.Match[str]) -> str:
        if len(match[2]) < _LONG:
            return match[0]
        name = f"{_STAND_IN}-{len(lists)}"
        lists[name] = json.loads(match[2])
        return match[1] + name

    if _LONG <= len(text) <= MAX_LENGTH and _STAND_IN not in text:
        short = _LISTED.sub(stand_in, text)
        if lists:
            # if this fails, the text is read unchanged, so that the fault names the right line
            with suppress(_Misread, yaml.YAMLError, InvalidInput, *_MISFITS):
                if documents := list(_Parser(short, lists).documents(1)):
                    return documents[0]
    documents = list(load_all(text, most=1))
    return documents[0] if documents else None


def dump(data: Mapping[str, Any]) -> str:
    try:
        return _block(data, "").lstrip("\n ") + "\n"
    except _NotSimple:
        events = (*_START, *_events(data), *_END)
        return str(yaml.emit(events, Dumper=_Dumper, allow_unicode=True, width=4096))


class _NotSimple(Exception):
    # only PyYAML writes such a text: with escapes, of several lines, or long
    pass


# Matches a text that fits in double quotes on one line, without escapes
_SIMPLE = re.compile(r"[ !#-\[\]-~]{0,1000}")
_LONGEST_KEY = 100  # PyYAML writes longer ones (128) on a line of their own, after `?`


def _block(value: Any, indent: str) -> str:  # noqa: ANN401
    # PyYAML writes the same text, but takes ten times as long. The first line follows `key:` or
    # `-`, and further lines begin with `indent`.
    if isinstance(value, str):
        return f" {_simple_text(value)}"
    inner = f"{indent}  "
    if isinstance(value, list | tuple):
        # the first line of an item's block is beside its dash
        items = [_block(item, inner).replace(f"\n{inner}", " ", 1) for item in value]
        return "".join([f"\n{indent}-{item}" for item in items]) or " []"
    if isinstance(value, Mapping):
        fields = []
        for key, item in value.items():
            if len(key) > _LONGEST_KEY:
                raise _NotSimple
            # a list below a key is not indented further, as PyYAML has it
            block = _block(item, indent if isinstance(item, list | tuple) else inner)
            fields.append(f"\n{indent}{_simple_text(key)}:{block}")
        return "".join(fields) or " {}"
    return f" {_REPRESENTER.represent_data(value).value}"


@_cached
def _simple_text(text: str) -> str:
    style = _text(text).style
    if not style:
        return text
    if style == "|" or not _SIMPLE.fullmatch(text):
        raise _NotSimple
    return f'"{text}"'


def set_key(text: str, key: str, value: object) -> str:
    """Return a file's text with one top-level key set; the rest stays, including comments.

    A form that does not permit this, such as a list, is a fault.
    """
    with _strict(""):
        node = yaml.compose(text, Loader=yaml.SafeLoader)
    pairs = node.value if isinstance(node, yaml.MappingNode) else []
    current = next((value for name, value in pairs if name.value == key), None)
    if isinstance(current, yaml.ScalarNode):
        start, end = current.start_mark.index, current.end_mark.index
        changed = text[:start] + dump({key: value}).partition(": ")[2].rstrip("\n") + text[end:]
    else:
        newline = "" if text.endswith("\n") else "\n"
        added = f"{newline}\n{dump({key: value})}"
        # a file from Windows keeps its line ends
        changed = text + (added.replace("\n", "\r\n") if "\r\n" in text else added)
    try:  # the text may have other forms than those above, such as flow style
        succeeded = load(changed) == {**load(text), key: value}
    except (InvalidInput, TypeError):
        succeeded = False
    if not succeeded:
        message = f"cannot be set automatically; set it to {short_repr(value)} by hand"
        raise InvalidInput.at(key, message)
    return changed


def without_field(text: str, field: str) -> str:
    """Return a file's text without a field, such as ``a.b``; the rest stays, including comments.

    If its form does not permit this, the text is returned unchanged.
    """
    *parents, last = field.split(".")
    try:
        wanted = inner = load(text)
        node: Any = yaml.compose(text, Loader=yaml.SafeLoader)
        for parent in parents:
            inner = inner[parent]
            node = next(value for name, value in node.value if name.value == parent)
        del inner[last]
        key, value = next(pair for pair in node.value if pair[0].value == last)
    except (InvalidInput, LookupError, StopIteration, TypeError, ValueError):
        return text  # it has several documents, or a key that is no text, like `1`
    head, tail = text[: key.start_mark.index], text[value.end_mark.index :]
    if len(node.value) == 1:
        head += "" if node.flow_style else "{}"
    elif node.flow_style:
        before_comma = re.sub(r",\s*\Z", "", head)
        if before_comma == head:  # the field is the first, or a comment precedes it
            tail = re.sub(r"\A\s*,\s*", "", tail)
        head = before_comma
    else:
        head, tail = head[: head.rfind("\n") + 1], tail.partition("\n")[2]
    try:
        return head + tail if load(head + tail) == wanted else text
    except InvalidInput:
        return text


def to_json(value: object) -> str:
    """Return JSON that is also valid YAML; ``{{ … }}`` in a template writes this text."""
    text = _JSON.encode(value)
    if "e-" in text or "e+" in text:
        text = _EXPONENT.sub(lambda match: f"{match[1]}.0" if match[1] else match[0], text)
    return _UNPRINTABLE.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def not_writable(value: object) -> str:
    kind = getattr(type(value), "__name__", "object")
    if callable(value):
        kind += "; add '()' to call it"
    return (
        "a template may write text, numbers, true, false, null, lists and mappings, but not a "
        f"{kind}"
    )


def _unknown(value: object) -> object:
    raise TypeError(not_writable(value))


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
        nodes = yaml.compose_all(text, Loader=LOADER)
        add(next(islice(nodes, document, None), None), "")
    return by_field


class FieldLines:
    """Finds the lines of fields in files; reads each file only once."""

    def __init__(self, text_of: Callable[[str], str | None]) -> None:
        self._text_of = text_of
        self._lines: dict[str, Mapping[str, int]] = {}

    def of(self, file: str, field: str) -> int | None:
        if field and file not in self._lines:
            self._lines[file] = lines(self._text_of(file) or "")
        return nearest(field, self._lines.get(file, {}))


def nearest(field: str, lines: Mapping[str, int]) -> int | None:
    # the field of a fault may be missing in the file, or be only a part of a text
    while field and field not in lines:
        field = field[: max(field.rfind("."), field.rfind("["), 0)]
    return lines[field] if field else None


def with_lines(faults: Iterable[Fault], text_of: Callable[[str], str | None]) -> list[Fault]:
    lines = FieldLines(text_of)
    return [
        replace(fault, line=fault.line or lines.of(fault.file, fault.field)) for fault in faults
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
