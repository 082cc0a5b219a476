"""A Jinja sandbox in which a template gives the same text in every process.

Templates can use only the filters and methods listed here, and the engine's own filters. Many of
the others give random results or make HTML. Nothing that is no data becomes text, because the text
of a method, say, has an address of memory. How long a template runs and how large its values become
is not the sandbox's matter: it runs in a process with limits (:mod:`demandops.evaluator`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, ItemsView, Iterator, KeysView, Mapping, ValuesView
from functools import lru_cache, wraps
from typing import Any

from jinja2 import nodes
from jinja2.exceptions import SecurityError
from jinja2.runtime import Context, Undefined
from jinja2.sandbox import ImmutableSandboxedEnvironment
from jinja2.visitor import NodeTransformer

from demandops.strict_yaml import not_writable

_FILTERS = re.findall(
    r"\w+",
    "abs attr batch capitalize center count d default dictsort first float format groupby indent "
    "int items join last length list lower map max min reject rejectattr replace reverse round "
    "select selectattr slice sort string sum title trim truncate unique upper urlencode "
    "wordcount",
)
_METHODS: dict[type, list[str]] = {
    str: re.findall(
        r"\w+",
        "capitalize center count endswith find index isalnum isalpha isdigit islower isnumeric "
        "isupper join ljust lower lstrip partition removeprefix removesuffix replace rfind rjust "
        "rpartition rsplit rstrip split splitlines startswith strip title upper zfill",
    ),
    dict: ["get", "items", "keys", "values"],
    list: ["count", "index"],
    tuple: ["count", "index"],
}
_BUILT_IN = (str, int, float, bytes, dict, list, tuple, range)
_VIEWS = (KeysView, ItemsView, ValuesView)
# the text of StrictUndefined is an error of its own, which names what is missing
_PLAIN = (str, int, float, type(None), range, Undefined)


def _as_data(value: Any) -> Any:  # noqa: ANN401
    """Return a value, an iterator or view as a list; raise SecurityError if a part is no data."""
    if isinstance(value, (Iterator, *_VIEWS)):
        value = list(value)
    parts = [value]
    while parts:
        part = parts.pop()
        if isinstance(part, (list, tuple, *_VIEWS)):
            parts.extend(part)
        elif isinstance(part, Mapping):
            parts.extend(part)
            parts.extend(part.values())
        elif not isinstance(part, _PLAIN):
            raise SecurityError(not_writable(part))
    return value


@lru_cache(maxsize=256)  # each rendering has a sandbox, but all have the same filters
def _of_data(function: Callable[..., Any]) -> Callable[..., Any]:
    """Change a filter or format so that its arguments must be data."""
    passed = 1 if hasattr(function, "jinja_pass_arg") else 0

    @wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:  # noqa: ANN401
        named = {name: _as_data(value) for name, value in kwargs.items()}
        return function(*args[:passed], *map(_as_data, args[passed:]), **named)

    return checked


def _concatenated(parts: list[Any]) -> str:
    return "".join(map(str, parts))


class _Concatenations(NodeTransformer):
    """Replaces each ``~`` of a template by a filter, so that its operands must be data."""

    def __init__(self, environment: Sandbox) -> None:
        self._environment = environment

    def visit_Concat(self, node: nodes.Concat) -> nodes.Filter:
        self.generic_visit(node)
        operands = nodes.List(node.nodes, lineno=node.lineno)
        place = {"lineno": node.lineno, "environment": self._environment}
        return nodes.Filter(operands, "_concatenated", [], [], None, None, **place)


class Sandbox(ImmutableSandboxedEnvironment):
    intercepted_binops = frozenset({"%"})  # the format `%s` would write anything as text

    def __init__(self, filters: Mapping[str, Callable[..., Any]], **options: Any) -> None:  # noqa: ANN401
        super().__init__(**options)
        finalize = self.finalize
        assert finalize is not None  # noqa: S101 - our own options
        self.finalize = lambda value: finalize(_as_data(value))
        listed = {name: self.filters[name] for name in _FILTERS}
        allowed = {**listed, **filters, "_concatenated": _concatenated}
        self.filters = {name: _of_data(function) for name, function in allowed.items()}
        del self.tests["sameas"]  # whether two values are one object is an accident
        del self.globals["lipsum"]  # writes random text

    def _parse(self, source: str, name: str | None, filename: str | None) -> nodes.Template:
        tree: nodes.Template = _Concatenations(self).visit(super()._parse(source, name, filename))
        return tree

    def call_binop(self, context: Context, operator: str, left: Any, right: Any) -> Any:  # noqa: ANN401
        return super().call_binop(context, operator, left, _as_data(right))

    def call(__self, __context: Context, __obj: Any, *args: Any, **kwargs: Any) -> Any:  # noqa: ANN401
        owner = getattr(__obj, "__self__", None)
        for kind in _BUILT_IN:
            if isinstance(owner, kind) and __obj.__name__ not in _METHODS.get(kind, ()):
                raise SecurityError(f"a template may not call the method '{__obj.__name__}'")
        return super().call(__context, __obj, *args, **kwargs)

    def wrap_str_format(self, value: Any) -> Callable[..., str] | None:  # noqa: ANN401
        wrapped = super().wrap_str_format(value)
        return _of_data(wrapped) if wrapped else None
