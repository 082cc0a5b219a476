"""A Jinja sandbox for templates of the state repo that also limits how much memory they use.

A reviewed template may still be wrong. An expression that would make millions of characters, such
as a product or a padding, is refused before it is evaluated. No chart value needs that much.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import wraps
from typing import Any

from jinja2.exceptions import SecurityError
from jinja2.runtime import Context
from jinja2.sandbox import ImmutableSandboxedEnvironment

MAX_LENGTH = 100_000
_MAX_POWER = 64
_WIDE = re.compile(r"\d{6,}|%[^a-zA-Z%]*\*|\{[^{}]*\{")
"""A field width of six digits or more, or one that is passed as an argument."""
_PADDING = ("format", "center", "indent", "batch", "slice", "wordwrap")


class Sandbox(ImmutableSandboxedEnvironment):
    """Jinja's sandbox with limits on the size of an expression's result."""

    intercepted_binops = frozenset({"*", "**", "%"})

    def __init__(self, **options: Any) -> None:  # noqa: ANN401
        super().__init__(**options)
        for name in _PADDING:
            self.filters[name] = _bounded(self.filters[name])

    def call_binop(self, context: Context, operator: str, left: Any, right: Any) -> Any:  # noqa: ANN401
        """Evaluate an operator; refuse products, powers and paddings that are too large."""
        sized = (str, list, tuple)
        if operator == "%":
            large = isinstance(left, str) and _WIDE.search(left) is not None
        elif operator == "**":
            large = isinstance(right, int | float) and right > _MAX_POWER
        elif isinstance(left, sized) and isinstance(right, int):
            large = len(left) * right > MAX_LENGTH
        else:
            large = isinstance(right, sized) and len(right) * left > MAX_LENGTH
        if large:
            raise SecurityError(f"the result of '{operator}' is too large")
        return super().call_binop(context, operator, left, right)

    def call(__self, __context: Context, __obj: Any, *args: Any, **kwargs: Any) -> Any:  # noqa: ANN401
        """Call a function; refuse string methods that pad too far (``'x'.ljust(10 ** 9)``)."""
        if isinstance(getattr(__obj, "__self__", None), str):
            _refuse_large(__obj.__self__, args, kwargs)
        return super().call(__context, __obj, *args, **kwargs)

    def wrap_str_format(self, value: Any) -> Callable[..., str] | None:  # noqa: ANN401
        """Wrap ``str.format``; refuse a format with a wide field."""
        wrapped = super().wrap_str_format(value)
        if wrapped is not None and _WIDE.search(value.__self__):
            raise SecurityError("the result of 'format' is too large")
        return wrapped


def _bounded(jinja_filter: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(jinja_filter)
    def bounded(*args: Any, **kwargs: Any) -> Any:  # noqa: ANN401
        text = next((arg for arg in args if isinstance(arg, str)), "")
        if jinja_filter.__name__ == "do_format" and _WIDE.search(text):
            raise SecurityError("the result of 'format' is too large")
        _refuse_large(jinja_filter.__name__, args, kwargs)
        return jinja_filter(*args, **kwargs)

    return bounded


def _refuse_large(name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
    for number in (*args, *kwargs.values()):
        if isinstance(number, int) and number > MAX_LENGTH:
            raise SecurityError(f"{number} is too large here, in '{name[:20]}'")
