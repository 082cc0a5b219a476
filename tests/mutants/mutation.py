"""Mutants of a module: small changes of its syntax tree, but not of types, decorators and prose."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from itertools import islice
from operator import setitem
from pathlib import Path
from typing import Any

_PAIRS = [
    *((ast.Lt, ast.LtE), (ast.Gt, ast.GtE), (ast.Eq, ast.NotEq), (ast.In, ast.NotIn)),
    *((ast.Is, ast.IsNot), (ast.And, ast.Or), (ast.Add, ast.Sub), (ast.BitOr, ast.BitAnd)),
]
_OTHER: dict[Any, Any] = dict(_PAIRS) | {two: one for one, two in _PAIRS}
_OTHER |= {ast.Mult: ast.FloorDiv, ast.Div: ast.Mult}
_WORD = re.compile(r"[\w./-]{1,30}")
_SKIPPED = {"annotation", "returns", "decorator_list", "type_params"}


@dataclass(frozen=True)
class Mutant:
    """The ``number``-th change of a module; one of ``lines`` runs when the changed code does."""

    path: Path
    number: int
    text: str
    lines: frozenset[int]

    def __str__(self) -> str:
        return f"{'/'.join(self.path.parts[-2:])}:{max(self.lines)} ({self.number}) {self.text}"

    def tree(self) -> ast.Module:
        module = ast.parse(self.path.read_text())
        _, _, put = next(islice(_each(module, frozenset()), self.number, None))
        put()
        return ast.fix_missing_locations(module)


def mutants(path: Path) -> list[Mutant]:
    found = enumerate(_each(ast.parse(path.read_text()), frozenset()))
    return [Mutant(path, number, text, lines) for number, (text, lines, _) in found]


def _each(parent: ast.AST, lines: frozenset[int]) -> Iterator[tuple[str, frozenset[int], Any]]:
    """Yield each change below a node: in words, with its lines, and a function that makes it."""
    for name, value in ast.iter_fields(parent):
        of: Any = value if isinstance(value, list) else vars(parent)
        for key, node in enumerate(value) if of is value else [(name, value)]:
            if name in _SKIPPED or not isinstance(node, ast.AST) or isinstance(node, ast.JoinedStr):
                continue
            own = frozenset({node.lineno} if hasattr(node, "lineno") else ())
            # an expression runs with its statement, a statement not with the block that it is in
            here = own if isinstance(node, ast.stmt) else lines | own
            for new in _changes(node):
                yield f"{_short(node)} -> {_short(new)}", here, partial(setitem, of, key, new)
            yield from _each(node, here)


def _changes(node: ast.AST) -> Iterator[ast.AST]:
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
            new.args[:2] = [two, one]
            yield new
    if isinstance(node, ast.Expr | ast.AugAssign | ast.Raise | ast.Continue | ast.Break):
        yield ast.Pass()


def _short(node: ast.AST) -> str:
    text = ast.unparse(ast.fix_missing_locations(node)).partition("\n")[0]
    return text if len(text) < 80 else f"{text[:77]}..."
