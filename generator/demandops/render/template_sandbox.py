"""A Jinja sandbox that limits a template's time and memory, and prevents random results.

Each loop, call, filter and comparison takes steps from a budget. The number of steps depends on the
size of the values, and no value can become large. So a template that exceeds the budget fails at
the same place on every machine. Templates can use only the filters and methods that this module
lists, and the engine's own filters. Many of the others give random results, expose memory
addresses, or make HTML.
"""

from __future__ import annotations

import re
from collections.abc import (
    Callable,
    Collection,
    ItemsView,
    Iterable,
    Iterator,
    KeysView,
    Mapping,
    ValuesView,
)
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache, wraps
from itertools import islice
from typing import Any, cast

from jinja2 import nodes, pass_context
from jinja2.environment import Template
from jinja2.exceptions import SecurityError
from jinja2.runtime import Context, Undefined
from jinja2.sandbox import ImmutableSandboxedEnvironment
from jinja2.visitor import NodeTransformer

from demandops.strict_yaml import not_writable

MAX_STEPS = 1_000_000
"""How many steps a rendering may take: a few seconds of work.

A template that lists 100 topics takes a few hundred steps.
"""
MAX_LENGTH = 1_000_000
"""How many characters a text may have. Kubernetes accepts objects of at most 1.5 MB."""
MAX_SIZE = 100_000
"""How many parts a value may have. An item, a key and 16 characters of text each count as one."""
_MAX_BITS = 1024

_DIGITS = re.compile(r"\d{1,9}")
_WIDTH_AS_ARGUMENT = re.compile(r"%[^a-zA-Z%]*\*|\{[^{}]*\{")
_FILTERS = re.findall(
    r"\w+",
    "abs attr batch capitalize center count d default dictsort first float format groupby indent "
    "int items join last length list lower map max min reject rejectattr replace reverse round "
    "select selectattr slice sort string sum title trim truncate unique upper urlencode "
    "wordcount",
)
_ONE_STEP = frozenset({"count", "d", "default", "first", "last", "length"})
"""Filters that take only one step from the budget. They do not process the parts of a value."""
_EACH = frozenset({"map", "reject", "rejectattr", "select", "selectattr"})
"""Filters that call another filter or test for each item. Each such call takes steps too."""
_SLOW = dict.fromkeys(("dictsort", "groupby", "sort", "title", "urlencode", "wordcount"), 8)
"""For each slow filter, the factor by which its steps are multiplied."""
_PADDING = frozenset(
    {"batch", "center", "indent", "literal", "block", "round", "slice", "truncate"}
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
_MAPPING = (dict, Mapping)  # ``dict`` first, because its check is faster
_PLAIN = (str, int, float, type(None), Undefined)


class _Budget:
    """The steps that a rendering has left."""

    def __init__(self) -> None:
        self.left = MAX_STEPS

    def take(self, steps: int) -> None:
        """Take steps from the budget; raise SecurityError if too few are left."""
        self.left -= steps
        if self.left < 0:
            raise SecurityError(f"the template takes more than {MAX_STEPS} steps; make it simpler")


_budget: ContextVar[_Budget] = ContextVar("budget")


@contextmanager
def budget() -> Iterator[None]:
    """Provide a full budget for the templates that are compiled or rendered in the block."""
    token = _budget.set(_Budget())
    try:
        yield
    finally:
        _budget.reset(token)


def _size(value: object, *, data: bool = True) -> int:
    """Return the size of a value with all its parts. A part that occurs twice counts twice.

    Raise SecurityError if the value has too many parts. With ``data``, also raise it for an object
    that is no data, such as a method. Its text could contain a memory address, which differs
    between machines.
    """
    if isinstance(value, str):
        return 1 + (len(value) >> 4)
    size = text = 0
    rest: list[Collection[object]] = [(value,)]
    while rest:
        parts = rest.pop()
        size += len(parts)
        if {*map(type, parts)} == {str}:
            text += sum(map(len, cast(Collection[str], parts)))
            parts = ()
        for part in parts:
            if isinstance(part, str):
                text += len(part)
            elif isinstance(part, list | tuple):
                rest.append(part)
            elif isinstance(part, _MAPPING):
                rest += (part, part.values())
            elif isinstance(part, range):
                size += len(part)
            elif data and not isinstance(part, _PLAIN):
                raise SecurityError(not_writable(part))
        if size + (text >> 4) > MAX_SIZE:
            raise SecurityError(f"a value is too large: it has more than {MAX_SIZE} parts")
    return size + (text >> 4)


def _counted_value(value: Any, *, data: bool = False) -> Any:  # noqa: ANN401
    """Take a step from the budget for each part of a value, and return the value.

    An iterator or a view of a mapping becomes a list.
    """
    if isinstance(value, Iterator | KeysView | ItemsView | ValuesView):
        value = list(islice(value, MAX_SIZE + 1))
    if isinstance(value, str) and len(value) > MAX_LENGTH:
        raise SecurityError(f"a text is longer than {MAX_LENGTH} characters")
    _budget.get().take(_size(value, data=data))
    return value


def _refuse_large(name: str, size: int, most: int = MAX_LENGTH) -> None:
    if size > most:
        raise SecurityError(f"the result of '{name}' is too large")


def _refuse_wide(name: str, form: str, values: Iterable[object]) -> None:
    """Raise SecurityError if formatting ``values`` with ``form`` may give too large a text.

    Also raise it if ``form`` takes a width from a value, because the size is not known then.
    """
    if _WIDTH_AS_ARGUMENT.search(form):
        raise SecurityError(
            f"the format of '{name}' has '*' or a brace inside braces; write each width as a number"
        )
    fields = form.count("%") + form.count("{")
    widths = sum(map(int, _DIGITS.findall(form)))
    _refuse_large(name, len(form) + widths + fields * sum(16 * _size(value) for value in values))


def _refuse_growth(name: str, values: tuple[Any, ...]) -> None:
    """Raise SecurityError if a filter or method may give too large a result for these values."""
    subject, *others = values or ("",)
    if name in _PADDING or name in ("ljust", "rjust", "zfill"):
        numbers = [abs(each) for each in others if isinstance(each, int)]
        lines = subject.count("\n") + 1 if name == "indent" and isinstance(subject, str) else 1
        if name in ("block", "literal"):
            lines = 16 * _size(subject)
        _refuse_large(name, lines * max([0, *numbers]))
        widths = [len(each) for each in others if isinstance(each, str)]
        _refuse_large(name, lines * max([0, *widths]))
    elif name == "replace" and len(others) > 1:
        old, new = str(others[0]), str(others[1])
        text = str(subject)
        _refuse_large(name, len(text) + text.count(old) * len(new))
    elif name == "join" and others:
        glue, items = (others[0], subject) if not isinstance(subject, str) else (subject, others[0])
        count = len(items) if hasattr(items, "__len__") else 1
        _refuse_large(name, count * len(str(glue)))
    elif name == "format":
        _refuse_wide(name, str(subject), others)
    elif name == "sum" and any(not isinstance(each, int | float | str) for each in others):
        raise SecurityError("'sum' adds numbers only")


@lru_cache(maxsize=256)  # each configuration has a sandbox, but all have the same filters
def _counted_filter(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """Change a Jinja filter so that it takes steps from the budget and refuses a large result."""
    passed = 1 if hasattr(function, "jinja_pass_arg") else 0

    @wraps(function)
    def counted(*args: Any, **kwargs: Any) -> Any:  # noqa: ANN401
        values = (*args[passed:], *kwargs.values())
        steps = _budget.get()
        if name in _ONE_STEP:
            steps.take(1)
            return function(*args, **kwargs)
        for value in values:
            of_items = name in _EACH and isinstance(value, list | tuple)
            steps.take(len(value) if of_items else _size(value) * _SLOW.get(name, 1))
        _refuse_growth(name, values)
        return _counted_value(function(*args, **kwargs))

    return counted


@lru_cache(maxsize=256)
def _counted_test(function: Callable[..., Any]) -> Callable[..., Any]:
    """Change a Jinja test (``is …``) so that it takes steps from the budget."""
    passed = 1 if hasattr(function, "jinja_pass_arg") else 0

    @wraps(function)
    def counted(*args: Any, **kwargs: Any) -> Any:  # noqa: ANN401
        for value in args[passed:]:
            _budget.get().take(_size(value, data=False))
        return function(*args, **kwargs)

    return counted


@pass_context
def _iterated(context: Context, items: Iterable[Any], steps: int) -> Iterator[Any]:
    budget = _budget.get()
    for item in items:
        budget.take(steps)
        yield item


@pass_context
def _measured(context: Context, value: Any) -> Any:  # noqa: ANN401
    _budget.get().take(_size(value, data=False))
    return value


@pass_context
def _concatenated(context: Context, parts: list[Any]) -> str:
    size = sum(_size(part) for part in parts)
    _refuse_large("~", size, MAX_SIZE)
    _budget.get().take(size)
    text = "".join(map(str, parts))
    _refuse_large("~", len(text))
    return text


class _Counting(NodeTransformer):
    """Changes a parsed template: loops, literals and comparisons take steps from the budget."""

    def __init__(self, environment: Sandbox) -> None:
        self._environment = environment

    def _filter(self, node: nodes.Expr, name: str, *args: nodes.Expr) -> nodes.Expr:
        if isinstance(node, nodes.Const):
            return node
        return nodes.Filter(
            node,
            name,
            list(args),
            [],
            None,
            None,
            lineno=node.lineno,
            environment=self._environment,
        )

    def visit_For(self, node: nodes.For) -> nodes.For:
        fixed = sum(len(part.data) for part in node.find_all(nodes.TemplateData))
        fixed += sum(len(part.value) for part in node.find_all(nodes.Const) if _is_text(part))
        self.generic_visit(node)
        steps = nodes.Const(1 + (fixed >> 4), lineno=node.lineno)
        node.iter = self._filter(node.iter, "_iterated", steps)  # type: ignore[arg-type]
        return node

    def visit_List(self, node: nodes.List | nodes.Dict) -> nodes.Expr:
        self.generic_visit(node)
        return self._filter(node, "_measured")

    visit_Dict = visit_List

    def visit_Tuple(self, node: nodes.Tuple) -> nodes.Expr:
        self.generic_visit(node)
        return self._filter(node, "_measured") if node.ctx == "load" else node

    def visit_Concat(self, node: nodes.Concat) -> nodes.Expr:
        self.generic_visit(node)
        return self._filter(nodes.List(node.nodes, lineno=node.lineno), "_concatenated")

    def visit_Compare(self, node: nodes.Compare) -> nodes.Compare:
        self.generic_visit(node)
        node.expr = self._filter(node.expr, "_measured")
        for operand in node.ops:
            operand.expr = self._filter(operand.expr, "_measured")
        return node

    def visit_Getitem(self, node: nodes.Getitem) -> nodes.Getitem:
        self.generic_visit(node)
        if isinstance(node.arg, nodes.Slice):
            node.node = self._filter(node.node, "_measured")
        return node


def _is_text(node: nodes.Const) -> bool:
    return isinstance(node.value, str)


class Sandbox(ImmutableSandboxedEnvironment):
    """Jinja's sandbox with a budget.

    Templates can be compiled and rendered only inside a ``with`` block of :func:`budget`.
    """

    intercepted_binops = frozenset({"+", "*", "**", "%"})

    def __init__(self, filters: Mapping[str, Callable[..., Any]], **options: Any) -> None:  # noqa: ANN401
        """Create a sandbox.

        Args:
            filters: the filters that templates may use besides Jinja's filters in ``_FILTERS``.
            options: the options of Jinja's environment.
        """
        super().__init__(**options)
        written = self.finalize
        assert written is not None  # noqa: S101 - our own options
        self.finalize = lambda value: written(_counted_value(value, data=True))
        kept = {name: one for name, one in self.filters.items() if name in _FILTERS}
        self.filters = {
            name: _counted_filter(name, one) for name, one in {**kept, **filters}.items()
        }
        self.filters |= {"_iterated": _iterated, "_measured": _measured}
        self.filters["_concatenated"] = _concatenated
        self.tests = {
            name: _counted_test(cast(Callable[..., Any], one))
            for name, one in self.tests.items()
            if name != "sameas"
        }
        del self.globals["lipsum"]

    def _parse(self, source: str, name: str | None, filename: str | None) -> nodes.Template:
        tree: nodes.Template = _Counting(self).visit(super()._parse(source, name, filename))
        return tree

    def _load_template(self, name: str, globals: Any) -> Template:  # noqa: ANN401
        found = super()._load_template(name, globals)
        assert self.loader is not None  # noqa: S101 - our own options
        _budget.get().take(1 + (len(self.loader.get_source(self, name)[0]) >> 4))
        return found

    def concat(self, parts: Iterable[str]) -> str:
        """Return the joined parts; raise SecurityError if the text is too long."""
        pieces, length = [], 0
        for part in parts:
            pieces.append(part)
            length += len(part)
            if length > MAX_LENGTH:
                raise SecurityError(f"the text is longer than {MAX_LENGTH} characters")
        return "".join(pieces)

    def call_binop(self, context: Context, operator: str, left: Any, right: Any) -> Any:  # noqa: ANN401
        """Return the result of an operator; raise SecurityError if it would be too large."""
        if isinstance(left, int) and isinstance(right, int):
            bits = left.bit_length() * right if operator == "**" else left.bit_length()
            _refuse_large(
                operator, bits + (right.bit_length() if operator == "*" else 0), _MAX_BITS
            )
        elif operator == "%" and isinstance(left, str):
            _refuse_wide(operator, left, [right])
        elif operator == "*" and isinstance(left, int | float) != isinstance(right, int | float):
            value, times = (right, left) if isinstance(left, int | float) else (left, right)
            length = len(value) if isinstance(value, str) else 16 * _size(value)
            _refuse_large(operator, length * int(times))
        elif not isinstance(left, float) and not isinstance(right, float):
            _refuse_large(operator, _size(left) + _size(right), MAX_SIZE)
        return _counted_value(super().call_binop(context, operator, left, right))

    def getitem(self, obj: Any, argument: Any) -> Any:  # noqa: ANN401
        """Return an item of a value.

        If the key is a tuple, each of its items takes one step from the budget.
        """
        if isinstance(argument, tuple):
            _budget.get().take(_size(argument))
        return super().getitem(obj, argument)

    def call(__self, __context: Context, __obj: Any, *args: Any, **kwargs: Any) -> Any:  # noqa: ANN401
        """Return the result of a macro, function or method.

        Raises:
            SecurityError: if ``_METHODS`` does not list the method of a built-in type, the result
                would be too large, or too few steps are left.
        """
        steps = _budget.get()
        for value in (*args, *kwargs.values()):
            steps.take(_size(value, data=False))
        owner = getattr(__obj, "__self__", None)
        for kind in (str, int, float, bytes, dict, list, tuple, range):
            if isinstance(owner, kind):
                steps.take(1 if kind is dict else _size(owner))
                if __obj.__name__ not in _METHODS.get(kind, ()):
                    raise SecurityError(f"a template may not call the method '{__obj.__name__}'")
                _refuse_growth(__obj.__name__, (owner, *args, *kwargs.values()))
        steps.take(1)
        return _counted_value(super().call(__context, __obj, *args, **kwargs))

    def wrap_str_format(self, value: Any) -> Callable[..., str] | None:  # noqa: ANN401
        """Return a function that replaces a format method and refuses too large a result.

        Return None if ``value`` is neither ``str.format`` nor ``str.format_map``.
        """
        wrapped = super().wrap_str_format(value)
        if wrapped is None:
            return None

        def format(*args: Any, **kwargs: Any) -> str:  # noqa: ANN401
            _refuse_wide("format", value.__self__, (*args, *kwargs.values()))
            return wrapped(*args, **kwargs)

        return format
