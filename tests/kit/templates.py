"""Jinja templates, compiled once in a test process instead of once by each generator.

Compiling takes a tenth of a second, more than evaluating five demands. The result depends only on
the source and the environment's class, since the program gives all environments the same options.
"""

from __future__ import annotations

from functools import cache
from types import CodeType
from typing import Any

from jinja2 import Environment

_compile = Environment.compile


class _Key:
    """An environment that equals every other of its class with the same filters."""

    def __init__(self, environment: Environment) -> None:
        self.environment = environment
        self._says = (type(environment), *sorted(environment.filters))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self._says == other._says

    def __hash__(self) -> int:
        return hash(self._says)


@cache
def _compiled(key: _Key, source: str, more: tuple[Any, ...], options: Any) -> CodeType:
    return _compile(key.environment, source, *more, **dict(options))


def compile_once() -> None:
    """Keep what is compiled from now on; a template with errors is compiled each time."""

    def compile_(self: Environment, source: Any, *more: Any, **options: Any) -> Any:
        if not isinstance(source, str):
            return _compile(self, source, *more, **options)
        return _compiled(_Key(self), source, more, tuple(sorted(options.items())))

    Environment.compile = compile_  # type: ignore[method-assign]
