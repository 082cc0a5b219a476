"""Mutants of a module: small changes of its syntax tree, each at one place.

Left out is what a test cannot or need not notice: annotations, decorators, docstrings,
and the wording of messages (f-strings, and texts with a space).
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_PAIRS = [
    *((ast.Lt, ast.LtE), (ast.Gt, ast.GtE), (ast.Eq, ast.NotEq), (ast.In, ast.NotIn)),
    *((ast.Is, ast.IsNot), (ast.And, ast.Or)),
    *((ast.Add, ast.Sub), (ast.Mult, ast.FloorDiv), (ast.BitOr, ast.BitAnd)),
]
_OTHER: dict[Any, Any] = dict(_PAIRS) | {two: one for one, two in _PAIRS} | {ast.Div: ast.Mult}
_WORD = re.compile(r"[\w./-]{1,30}")
_SKIPPED = {"annotation", "returns", "decorator_list", "type_params"}


@dataclass(frozen=True)
class Mutant:
    """A changed node of a module; when the node runs, so does one of ``lines``."""

    path: Path
    place: int
    variant: int
    text: str
    lines: frozenset[int]

    def tree(self) -> ast.Module:
        """Return the mutated module."""
        module = ast.parse(self.path.read_text())
        parent, name, index, node, _ = list(_places(module, frozenset()))[self.place]
        new = list(_changes(node))[self.variant]
        if index is None:
            setattr(parent, name, new)
        else:
            getattr(parent, name)[index] = new
        return ast.fix_missing_locations(module)


def mutants(path: Path) -> list[Mutant]:
    """Return all mutants of a module, in the order of its syntax tree."""
    return [
        Mutant(path, place, variant, f"{_short(node)} -> {_short(new)}", lines)
        for place, (*_, node, lines) in enumerate(_places(ast.parse(path.read_text()), frozenset()))
        for variant, new in enumerate(_changes(node))
    ]


_Place = tuple[ast.AST, str, "int | None", ast.AST, frozenset[int]]


def _places(parent: ast.AST, lines: frozenset[int]) -> Iterator[_Place]:
    """Yield (parent, field, index, node, lines) for each node below ``parent``."""
    for name, value in ast.iter_fields(parent):
        for index, node in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if name in _SKIPPED or not isinstance(node, ast.AST) or isinstance(node, ast.JoinedStr):
                continue
            own = frozenset({node.lineno} if hasattr(node, "lineno") else ())
            # an expression runs with its statement, a statement not with the block that it is in
            here = own if isinstance(node, ast.stmt) else lines | own
            yield parent, name, index, node, here
            yield from _places(node, here)


def _changes(node: ast.AST) -> Iterator[ast.AST]:
    """Yield a changed copy of a node for each change."""
    new: Any = deepcopy(node)
    match new:
        case ast.Expr(value=ast.Constant()) | ast.If(test=ast.Name(id="TYPE_CHECKING")):
            return
        case ast.Compare(ops=[operator]) if type(operator) in _OTHER:
            new.ops = [_OTHER[type(operator)]()]
            yield new
        case ast.BoolOp() | ast.BinOp() | ast.AugAssign() if type(new.op) in _OTHER:
            new.op = _OTHER[type(new.op)]()
            yield new
        case ast.UnaryOp(op=ast.Not()):
            yield new.operand
        case ast.If() | ast.While() | ast.IfExp():
            new.test = ast.UnaryOp(ast.Not(), new.test)
            yield new
        case ast.comprehension(ifs=[condition, *_]):
            new.ifs[0] = ast.UnaryOp(ast.Not(), condition)
            yield new
        case ast.Constant(value=bool() | int() | float() as value):
            yield ast.Constant(not value if isinstance(value, bool) else value + 1)
        case ast.Constant(value=str() as value) if _WORD.fullmatch(value):
            yield ast.Constant(f"{value}x")
        case ast.Return(value=ast.expr() as value) if ast.unparse(value) != "None":
            yield ast.Return(ast.Constant(None))
        case ast.Call(args=[one, two, *_]) if ast.unparse(one) != ast.unparse(two):
            if not isinstance(one, ast.Starred):
                new.args[:2] = [two, one]
                yield new
    if isinstance(node, ast.Expr | ast.AugAssign | ast.Raise | ast.Continue | ast.Break):
        yield ast.Pass()


def _short(node: ast.AST) -> str:
    text = ast.unparse(ast.fix_missing_locations(node)).partition("\n")[0]
    return text if len(text) < 80 else f"{text[:77]}..."
