"""Strict reading and deterministic writing of YAML.

The program reads every file with :func:`load`. Duplicate keys, anchors and further documents are
errors. It writes every file with :func:`dump`. Strings are written so that YAML 1.1 and 1.2,
PyYAML and Go's parsers read the same value.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import yaml

from demandops.errors import Fault, InvalidInput

_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_Dumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)

_PLAIN = re.compile(r"[A-Za-z/][A-Za-z0-9_./-]*(?:[:@=][A-Za-z0-9_./-]+)*")
_WORDS = frozenset(
    ["y", "n", "yes", "no", "on", "off", "true", "false", "null", "nan", "inf", "infinity", "none"]
)  # some parsers do not read these words as text

_OPENING = (yaml.MappingStartEvent, yaml.SequenceStartEvent)
_CLOSING = (yaml.MappingEndEvent, yaml.SequenceEndEvent)
MAX_LENGTH = 4_000_000
"""The characters of a file that is read; an inventory of 20,000 nodes has fewer."""
_MAX_DEPTH = 100
_MAX_BITS = 14_000
"""Of a whole number; Python prints no more than 4,300 digits."""
_NEEDS_CHECK = re.compile(r"[&*]|[-?:][ \t]+[-?][ \t]|^\?", re.MULTILINE)
"""Text that may hold an alias, or many levels on one line."""
_MISFITS = (ValueError, TypeError, KeyError, AttributeError, IndexError, RecursionError)
_MISFIT = "not valid YAML: a tag or number is not allowed there"

_EXPONENT = re.compile(r'"(?:[^"\\]|\\.)*"|(?<![0-9.])([0-9]+)(?=e)')
"""A text, or a JSON number like ``1e-09``: without a dot, YAML 1.1 reads text."""
_UNPRINTABLE = re.compile("[\x7f-\x9f\u2028\u2029\ud800-\udfff\ufeff\ufffe\uffff]")


class _StrictLoader(_Loader):  # type: ignore[misc]
    """A safe loader that rejects duplicate keys and keeps dates as text."""


def _mapping(loader: Any, node: yaml.MappingNode) -> dict[str, Any]:  # noqa: ANN401
    if not isinstance(node, yaml.MappingNode):
        raise yaml.constructor.ConstructorError(
            None, None, "a mapping is expected here", node.start_mark
        )
    seen: dict[str, Any] = {}
    for key_node, value_node in node.value:
        key = loader.construct_object(key_node, deep=True)
        if not isinstance(key, str):
            raise yaml.constructor.ConstructorError(
                None,
                None,
                f"the key {short_repr(key)} must be text; put it in quotes",
                key_node.start_mark,
            )
        if key in seen:
            raise yaml.constructor.ConstructorError(
                None, None, f"the key {key!r} appears twice", key_node.start_mark
            )
        seen[key] = loader.construct_object(value_node, deep=True)
    return seen


def _integer(loader: Any, node: yaml.ScalarNode) -> int:  # noqa: ANN401
    number: int = loader.construct_yaml_int(node)
    if number.bit_length() > _MAX_BITS:
        raise yaml.constructor.ConstructorError(
            None, None, f"a whole number has more than {_MAX_BITS} bits", node.start_mark
        )
    return number


def _not_data(loader: Any, node: yaml.Node) -> None:  # noqa: ANN401
    raise yaml.constructor.ConstructorError(
        None,
        None,
        f"the tag {short_repr(node.tag)} is not allowed; write plain data",
        node.start_mark,
    )


_StrictLoader.add_constructor("tag:yaml.org,2002:map", _mapping)
_StrictLoader.add_constructor("tag:yaml.org,2002:int", _integer)
for _tag in ("binary", "set", "omap", "pairs"):  # JSON has no such values
    _StrictLoader.add_constructor(f"tag:yaml.org,2002:{_tag}", _not_data)
# PyYAML resolves each scalar anew; the same words and topics come again and again
_StrictLoader.resolve = staticmethod(lru_cache(16_384)(yaml.resolver.Resolver().resolve))
_StrictLoader.add_constructor(
    "tag:yaml.org,2002:timestamp", lambda loader, node: loader.construct_scalar(node)
)


class _PlainDumper(_Dumper):  # type: ignore[misc]
    """A dumper that writes no anchors and quotes every string that a parser could misread."""

    def ignore_aliases(self, data: object) -> bool:
        """Return True, so that a value that occurs twice is written twice."""
        return True


def _text(dumper: Any, text: str) -> yaml.ScalarNode:  # noqa: ANN401
    tag = "tag:yaml.org,2002:str"
    if _PLAIN.fullmatch(text) and text.lower() not in _WORDS:
        return dumper.represent_scalar(tag, text)  # type: ignore[no-any-return]
    style = "|" if _readable_block(text) else '"'
    return dumper.represent_scalar(tag, text, style=style)  # type: ignore[no-any-return]


def _readable_block(text: str) -> bool:
    """Return whether a literal block can hold ``text`` unchanged."""
    return (
        text.endswith("\n")
        and not text.endswith("\n\n")
        and not text.startswith((" ", "\n"))
        and text.count("\n") > 1
        and not re.search(r"[ \t]\n|[^\x20-\x7e\n]", text)
    )


_PlainDumper.add_representer(str, _text)


def short_repr(value: object) -> str:
    """Return a short form of any value for a message."""
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
        raise InvalidInput.at("", _MISFIT, file=file) from error


def load_all(text: str, file: str = "") -> Iterator[Any]:
    """Yield the documents of ``text``.

    Raises:
        InvalidInput: if it is not strict YAML; the fault names ``file``.
    """
    if len(text) > MAX_LENGTH:
        message = f"has {len(text)} characters; at most {MAX_LENGTH} are allowed"
        raise InvalidInput.at("", message, file=file)
    with _strict(file):
        depth = 0
        for event in yaml.parse(text, Loader=_Loader):
            depth += isinstance(event, _OPENING) - isinstance(event, _CLOSING)
            if depth > _MAX_DEPTH:  # before the C parser builds it and overruns its stack
                message = f"is nested deeper than {_MAX_DEPTH} levels"
                raise InvalidInput.at("", message, file=file)
            if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
                where = f"line {event.start_mark.line + 1}" if event.start_mark else ""
                message = "anchors and aliases (& and *) are not allowed; write the value out"
                raise InvalidInput.at(where, message, file=file)
        yield from yaml.load_all(text, Loader=_StrictLoader)


def load(text: str, file: str = "") -> Any:  # noqa: ANN401 - raw YAML, which models then parse
    """Return the only document of ``text``, or ``None`` if it is empty.

    Raises:
        InvalidInput: if it is not strict YAML; the fault names ``file``.
    """
    documents = list(load_all(text, file))
    if len(documents) > 1:
        message = f"holds {len(documents)} documents; only one is allowed"
        raise InvalidInput.at("", message, file=file)
    return documents[0] if documents else None


def load_rendered(text: str) -> Any:  # noqa: ANN401
    """Return the document that a template produced.

    Anchors and depth are checked only if the text can have them, which saves a pass for most.

    Raises:
        InvalidInput: if it is not strict YAML.
    """
    if _NEEDS_CHECK.search(text) or text.count("[") + text.count("{") > _MAX_DEPTH:
        return load(text)
    with _strict(""):
        return yaml.load(text, Loader=_StrictLoader)  # noqa: S506 - derives from SafeLoader


def dump(data: Mapping[str, Any]) -> str:
    """Return ``data`` as block YAML in the given order, with a newline at the end."""
    return str(
        yaml.dump(
            data,
            Dumper=_PlainDumper,
            sort_keys=False,
            allow_unicode=True,
            default_flow_style=False,
            width=4096,
        )
    )


def set_key(text: str, key: str, value: object) -> str:
    """Return a file's text with one top-level key set; all else, also comments, stays the same.

    A plain value is replaced in place. A missing key is added at the end.

    Raises:
        InvalidInput: if the file's form does not allow that.
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
        changed = text + (added.replace("\n", "\r\n") if "\r\n" in text else added)
    try:
        succeeded = load(changed) == {**load(text), key: value}
    except (InvalidInput, TypeError):
        succeeded = False
    if not succeeded:
        message = f"cannot be set automatically; write {short_repr(value)} there"
        raise InvalidInput.at(key, message)
    return changed


def to_json(value: object) -> str:
    """Return ``value`` as JSON that is also valid YAML; a template's ``{{ … }}`` writes this.

    Characters that YAML cannot print become ``\\uXXXX``; the others stay readable.
    """
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, default=_unknown)
    if "e-" in text or "e+" in text:
        text = _EXPONENT.sub(lambda match: f"{match[1]}.0" if match[1] else match[0], text)
    return _UNPRINTABLE.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def _unknown(value: object) -> object:
    raise TypeError(f"a template may write text, numbers, lists and mappings, not {type(value)}")


def faults_in(error: InvalidInput, file: str) -> list[Fault]:
    """Return the faults of ``error``, located in ``file``."""
    return [fault.within(file) for fault in error.faults]
