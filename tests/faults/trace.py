"""The system calls in strace's output: who made each one, and on which class of file."""

from __future__ import annotations

import ast
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from tests.kit import plain_yaml

_LINE = re.compile(r"(?:(\d+) +)?(.*)")
"""A line begins with the number of a process, unless strace follows only one."""
_CALL = re.compile(r"(\w+)\((.*)\) += (-?\d+|\?|0x[0-9a-f]+)(.*)", re.DOTALL)
_TEXT = re.compile(r'"((?:[^"\\]|\\.)*)"')
_FILE = re.compile(r"(?:AT_FDCWD|\d+)<((?:[^>\\]|\\.)*)>")
_NAME_IN = re.compile(rf"{_FILE.pattern}, {_TEXT.pattern}")
_TRAITS = plain_yaml.beside(__file__, "calls")
_FORKS = ("clone", "clone3", "fork", "vfork")
_RANDOM = (
    (re.compile(r"\b[0-9a-f]{2}/[0-9a-f]{38}\b"), "??/*"),
    (re.compile(r"(?<=/)[0-9a-f]{2}(?=/|$)"), "??"),
    (re.compile(r"(pack_git2_)[0-9a-f]+?(idx|rev|$)"), r"\1*\2"),
    (re.compile(r"(?<![a-z])[0-9a-f]{12,}"), "*"),
    (re.compile(r"(demandops-pack-|tmp_\w+?_|incoming-)\w+"), r"\1*"),
)


@dataclass(frozen=True)
class Call:
    """The n-th call of a kind in a thread or process, and the class of file that it touches.

    ``role`` is the name of the thread, or the git command of the process, such as ``git push``. For
    a thread, ``which`` is 0. For a process, ``which`` is its number, from 1, among the processes of
    the same git command.
    """

    role: str
    kind: str
    file: str
    n: int
    arguments: str
    result: str
    paths: tuple[str, ...]
    which: int = 0
    place: int = 0
    """How many calls of the same class came before this one."""

    @property
    def call_class(self) -> tuple[str, str, str, bool]:
        return self.role, self.kind, self.file, self.creates

    @property
    def creates(self) -> bool:
        return "O_CREAT" in self.arguments

    @property
    def changes(self) -> bool:
        return self.kind in calls_of("changes") or self.creates

    @property
    def failed(self) -> bool:
        return self.result.startswith(("-1", "?"))

    @property
    def text(self) -> bytes:
        found = _TEXT.search(self.arguments)
        return _decoded(found[1]) if found else b""


@cache
def calls_of(trait: str) -> frozenset[str]:
    return frozenset(kind for kind, traits in _TRAITS.items() if trait in traits)


def file_class(path: str, root: Path) -> str:
    name = path.removeprefix(f"{root}/")
    for pattern, stands in _RANDOM:
        name = pattern.sub(stands, name)
    return name


def parse(
    text: str, roles: dict[int, str], root: Path, folder: str = "/", which: int = 0
) -> list[Call]:
    """Return the calls that touch a file below ``root``, in the order in which they ended.

    ``roles`` names threads and processes; any other process is named after its program. A process
    that strace does not number has the number 0.
    """
    known, roles = set(roles), dict(roles)
    folders: dict[int, str] = {}
    counts: dict[tuple[int, str], int] = {}
    if first := _LINE.match(text):
        folders[int(first[1] or 0)] = folder
    found = []
    for process, line in _whole_lines(text, roles, folders):
        match = _CALL.match(line)
        if match is None:
            continue
        kind, arguments, result = match[1], match[2], match[3] + match[4]
        if kind in _FORKS:
            child = int(match[3]) if match[3].isdigit() else 0
            if roles.get(child, "?") == "?":
                roles[child] = f"{roles.get(process, '?')} > ?"
                folders[child] = folders.get(process, "/")
            continue
        if "faults-begin" in arguments:
            counts = {key: n for key, n in counts.items() if key[0] != process}
        counts[process, kind] = n = counts.get((process, kind), 0) + 1
        paths = [
            os.path.normpath(path) for path in _paths(kind, arguments, folders.get(process, "/"))
        ]
        if kind == "execve" and result.startswith("0") and process not in known:
            roles[process] = _program(arguments, roles.get(process, ""))
        elif kind == "chdir" and not result.startswith("-1"):
            folders[process] = paths[0]
        inside = tuple(path for path in paths if path.startswith(f"{root}/"))
        if inside:
            role = roles.get(process, "?")
            file = file_class(inside[-1], root)
            found.append(Call(role, kind, file, n, arguments, result, inside, which))
    return found


def _whole_lines(
    text: str, roles: dict[int, str], folders: dict[int, str]
) -> Iterator[tuple[int, str]]:
    """Yield each call with its process; join the two parts of an interrupted call."""
    begun: dict[int, str] = {}
    for raw in text.splitlines():
        number, line = _LINE.fullmatch(raw).groups()
        process = int(number or 0)
        if process not in folders:
            parents = [p for p, part in begun.items() if part.startswith(_FORKS)]
            folders[process] = folders.get(parents[-1], "/") if parents else "/"
            roles.setdefault(process, roles.get(parents[-1], "?") + " > ?" if parents else "?")
        if line.endswith("<unfinished ...>"):
            begun[process] = line.removesuffix("<unfinished ...>").rstrip()
            continue
        resumed = re.match(r"<\.\.\. \w+ resumed>", line)
        if resumed:
            line = begun.pop(process, "") + line[resumed.end() :]
        elif line.startswith("+++ killed") and process in begun:
            yield process, begun.pop(process) + ") = ? (INJECTED)"
        yield process, line


def _program(arguments: str, before: str) -> str:
    words = [_decoded(word).decode() for word in _TEXT.findall(arguments.partition("[")[2])]
    names = [word for word in words if not (word.startswith("-") or "=" in word)]
    name = names[0].rsplit("/", 1)[-1] if names else "?"
    if name == "git" and len(names) > 1:
        name = f"git {names[1]}"
    command = before.partition(" > ")[0]
    return f"{command} > {name}" if command.startswith("git ") else name


def _paths(kind: str, arguments: str, folder: str) -> list[str]:
    """Return the paths of a call's files, by name or by number.

    Only the kind of the call shows whether a text in quotes is a name or data.
    """
    if kind in calls_of("at a folder"):
        named = [Path(_name(base), _name(name)) for base, name in _NAME_IN.findall(arguments)]
    elif arguments.startswith('"'):
        named = [Path(folder, _name(name)) for name in _TEXT.findall(arguments)]
    else:
        numbered = map(_name, _FILE.findall(_TEXT.sub("", arguments)))
        return [path for path in numbered if path.startswith("/")]
    return [str(path) for path in named[: 2 if kind in calls_of("two names") else 1]]


def _name(text: str) -> str:
    return _decoded(text).decode(errors="replace")


def _decoded(text: str) -> bytes:
    value: bytes = ast.literal_eval(f'b"{text}"')
    return value
