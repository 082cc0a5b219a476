"""Collects the messages of errors that the program raises outside of checks, from its source."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

PROGRAM = Path(__file__).parents[1] / "generator" / "demandops"
SECTIONS = {
    "repo": "The state repo and Git",
    "cluster": "Clusters",
    "serve": "The generator",
    "cli": "The command line",
}
"""The folders whose messages are in no list of mistakes, each with the title of its section."""

_RAISED = (
    "StateRepoError",
    "RemoteAway",
    "PushDenied",
    "NoAnswer",
    "Unsound",
    "QueueFull",
    "ShuttingDown",
    "TurnedDown",
    "NotReached",
    "Withdrawn",
    "InvalidInput",
    "Refused",
)
_OPEN = "…"


def messages() -> dict[str, list[str]]:
    """Return the messages of each section, sorted; ``…`` stands for what differs each time."""
    found: dict[str, set[str]] = {room: set() for room in SECTIONS}
    for room, texts in found.items():
        for path in PROGRAM.joinpath(room).rglob("*.py"):
            texts.update(_of(ast.parse(path.read_text())))
    return {SECTIONS[room]: sorted(texts, key=str.casefold) for room, texts in found.items()}


def _of(module: ast.Module) -> Iterator[str]:
    for node in ast.walk(module):
        if not isinstance(node, ast.Call):
            continue
        called = node.func
        is_at = isinstance(called, ast.Attribute) and called.attr == "at"
        name = called.value if isinstance(called, ast.Attribute) and is_at else called
        if not isinstance(name, ast.Name) or name.id not in _RAISED:
            continue
        parts = [_text(one) for one in node.args[: 2 if is_at else None]]
        text = ": ".join(part for part in parts[0 if is_at else -1 :] if part)
        if len(re.findall(r"[a-z]{2,}", text.replace(_OPEN, ""))) > 2:
            yield text


def _text(node: ast.expr) -> str:
    """Return the text that an expression gives; ``…`` stands for each part that is computed."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(map(_text, node.values))
    if isinstance(node, ast.BinOp):
        return _text(node.left) + _text(node.right)
    return _OPEN
