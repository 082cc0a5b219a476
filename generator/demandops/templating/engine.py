"""Strict Jinja2 that writes every value as JSON, and the program's own templates.

``{{ x }}`` writes one JSON value, so a value cannot change the structure of the YAML. An undefined
name is an error. Templates of application definitions follow the same rules, in a sandbox and in
another process (:mod:`.values`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import cache
from types import CodeType
from typing import Any

from jinja2 import BytecodeCache, Environment, FileSystemLoader, StrictUndefined
from jinja2.bccache import Bucket
from jinja2.runtime import Undefined

from demandops.base import naming, strict_yaml
from demandops.base.settings import data_folder


class _Verbatim(str):
    """YAML text that a filter of this module returns. It is written unchanged."""


class CompiledTemplates(BytecodeCache):
    # each rendering has a sandbox of its own, with which Jinja's own cache of templates goes
    _LIMIT = 256

    def __init__(self) -> None:
        self._code: dict[tuple[str, str], CodeType] = {}

    def load_bytecode(self, bucket: Bucket) -> None:
        bucket.code = self._code.get((bucket.key, bucket.checksum))

    def dump_bytecode(self, bucket: Bucket) -> None:
        if len(self._code) >= self._LIMIT:
            self._code.clear()
        if bucket.code:
            self._code[bucket.key, bucket.checksum] = bucket.code


def _finalize(value: object) -> object:
    if isinstance(value, _Verbatim):
        return value
    if isinstance(value, Undefined):
        str(value)  # StrictUndefined raises an error here that names what is missing
    return strict_yaml.to_json(_plain(value))


def _plain(value: object) -> object:
    if isinstance(value, list | tuple):
        return [item if isinstance(item, str) else _plain(item) for item in value]
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    return value


def _block(value: Mapping[str, Any], indent: int) -> _Verbatim:
    text = strict_yaml.dump(value) if value else "{}\n"
    pad = " " * indent
    return _Verbatim("\n".join(line and pad + line for line in text.rstrip("\n").split("\n")))


def _literal(value: str, indent: int) -> _Verbatim:
    pad = " " * indent
    return _Verbatim("\n".join(pad + line for line in value.rstrip("\n").split("\n")))


def _bare(value: str) -> _Verbatim:
    if not re.fullmatch(r"[A-Za-z0-9._/-]+", value):
        raise ValueError(f"'{value}' is not a plain path, so it cannot be written in a comment")
    return _Verbatim(value)


FILTERS: dict[str, Callable[..., _Verbatim | str]] = {
    "block": _block,
    "literal": _literal,
    "bare": _bare,
    "ros_name": naming.ros_name,
}
OPTIONS: dict[str, Any] = {
    "undefined": StrictUndefined,
    "finalize": _finalize,
    "autoescape": False,
    "trim_blocks": True,
    "lstrip_blocks": True,
    "keep_trailing_newline": True,
    "auto_reload": False,  # would read each file's time at each use
}


@cache
def _own() -> Environment:
    environment = Environment(  # noqa: S701 - YAML, not HTML
        loader=FileSystemLoader(data_folder("templates")), **OPTIONS
    )
    del environment.filters["tojson"]  # _finalize writes JSON, and would quote that JSON again
    environment.filters |= FILTERS
    return environment


def text(template: str, **context: object) -> str:  # such as `flux/release.yaml.j2`
    return _own().get_template(template).render(**context)
