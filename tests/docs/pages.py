"""The code blocks of a documentation page, and how the commands in them are run.

A comment before a block says what a test does with it::

    <!-- run -->                  the commands are run, in the order of the page, in one folder
    <!-- run all -->              at the top of a page: so are those of all shell blocks without a
                                  comment of their own
    <!-- tested by tests/… -->    another test covers the commands, or they need a cluster
    <!-- not run: WHY -->

A block with a title (```yaml title="PATH") is a file that the reader writes. In a `console` block,
the lines after a command are its expected output. In the output, `…` stands for any text in a line.
A `…` alone on a line stands for any number of lines.
"""

from __future__ import annotations

import re
import subprocess
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from tests.kit.limits import PATIENCE_S

_TAG = re.compile(r"\s*<!-- (run|run all|tested by [^>]*|not run: [^>]*) -->\s*")
_FENCE = re.compile(r"(\s*)(`{3,})(\w*)(?: title=\"([^\"]*)\")?\s*")
_SHELL = ("sh", "bash", "shell", "console")
_COMMAND = re.compile(
    r"(?:\$ |\.venv/|\. |(?:[A-Z_]+=\S+ )*(?:"
    r"apt-get|argocd|cat|cd|chmod|colcon|cp|curl|demandops|docker|export|flux|gh|git|glab|helm|k3d|"
    r"kubectl|kustomize|make|mkdir|mv|pip|pipx|podman|pytest|python3?|rm|ros2|sed|ssh|ssh-keygen|"
    r"sudo|systemctl|tar|wget) )"
)


@dataclass(frozen=True)
class Block:
    line: int
    language: str
    title: str
    text: str
    tag: str

    @property
    def has_commands(self) -> bool:
        if self.language:
            return self.language in _SHELL
        return any(_COMMAND.match(line) for line in self.text.splitlines())


def blocks(markdown: str) -> Iterator[Block]:
    """Yield the fenced and the indented blocks of a page."""
    lines = markdown.splitlines()
    tag, at, blank, default = "", 0, True, ""
    while at < len(lines):
        line = lines[at]
        fence = _FENCE.fullmatch(line)
        if told := _TAG.fullmatch(line):
            tag, default = ("", "run") if told[1] == "run all" else (told[1], default)
        elif fence:
            end = next(n for n in range(at + 1, len(lines)) if lines[n].strip() == fence[2])
            body = textwrap.dedent("\n".join(lines[at + 1 : end]))
            told_tag = tag or (default if fence[3] in _SHELL else "")
            yield Block(at + 1, fence[3], fence[4] or "", body, told_tag)
            tag, at = "", end
        elif blank and line.startswith("    ") and not re.match(r"\s*(?:[-*|]|\d+\.) ", line):
            end = at
            while end < len(lines) and (not lines[end].strip() or lines[end].startswith("    ")):
                end += 1
            yield Block(at + 1, "", "", textwrap.dedent("\n".join(lines[at:end])).strip(), tag)
            tag, at = "", end - 1
        elif line.strip():
            tag = ""
        blank = not lines[at].strip() or fence is not None or told is not None
        at += 1


def run(markdown: str, folder: Path, environment: Mapping[str, str]) -> None:
    """Write the files of a page and run its commands.

    Raise an AssertionError if a command's output differs from what the page shows; the exit code
    does not count then. If the page shows no output, or only `…`, the command must succeed.
    """
    state = folder / ".state"
    state.write_text(f"cd {folder}\n")
    for block in blocks(markdown):
        if block.title:
            path = folder / block.title
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"{block.text}\n")
        elif block.tag == "run":
            for command, expected in _commands(block):
                ran = _ran(command, state, environment)
                said = f"line {block.line}: {command}\n{ran.stdout}"
                if expected in (None, "…"):
                    assert ran.returncode == 0, said
                else:
                    assert _pattern(expected).fullmatch(f"{ran.stdout.rstrip()}\n"), said


def _commands(block: Block) -> Iterator[tuple[str, str | None]]:
    if block.language != "console":
        yield block.text, None
        return
    for part in re.split(r"(?m)^\$ ", block.text)[1:]:
        command, _, printed = part.partition("\n")
        yield command, printed.rstrip() or None


def _ran(
    command: str, state: Path, environment: Mapping[str, str]
) -> subprocess.CompletedProcess[str]:
    """Run a command; it starts with the folder and the exports that the previous command left."""
    script = (
        f"set -e\n. {state}\n"
        f'trap \'{{ printf "cd %q\\n" "$PWD"; export -p; }} >{state}\' EXIT\n{command}\n'
    )
    return subprocess.run(
        ["bash", "-c", script],
        env=dict(environment),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
        timeout=PATIENCE_S,
    )


def _pattern(expected: str) -> re.Pattern[str]:
    """Return a pattern for the expected output; between words it accepts any number of spaces."""
    lines = []
    for line in expected.splitlines():
        words = [".*?".join(map(re.escape, word.split("…"))) for word in line.split()]
        lines.append("(?:.*\\n)*?" if words == [".*?"] else f" *{' +'.join(words)} *\\n")
    return re.compile("".join(lines))
