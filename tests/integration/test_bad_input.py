"""Bad input through ``demandops request``, mainly attacks in YAML.

The message names file and place, the exit code is 1, nothing is booked, and nothing is left in the
journal.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from tests.integration.conftest import On
from tests.kit import plain_yaml
from tests.kit.cli import process
from tests.kit.repo import GitRepo

APPDEF = "appdefs/object-detection-fusion"
CHART = f"{APPDEF}/charts/object-detection"


@pytest.fixture(autouse=True)
def _nothing_is_left_behind(data_home: Path) -> Iterator[None]:
    yield
    for journal in data_home.rglob("outbox.jsonl"):
        lines = [yaml.safe_load(line) for line in journal.read_text().splitlines()]
        done = {line["done"] for line in lines if "done" in line}
        assert not [line for line in lines if "done" not in line and line["operation"] not in done]


TOLD = plain_yaml.beside(__file__, "attacks")
MORE = TOLD.pop("more")
MORE += [
    "connections: [{id: c, type: 0x" + "f" * 5000 + "}]\n", "id: 0x" + "f" * 5000 + "\n",
    "id: " + "9" * 5000 + "\n", "id: 0b" + "1" * 20000 + "\n", "- " * 1500 + "a\n",
    "apps: " + "[" * 900 + "]" * 900 + "\n", "apps: " + "{a: " * 900 + "}" * 900 + "\n",
    "".join(" " * depth + "a:\n" for depth in range(1500)), "a" * 100_000, "? " * 500,
    "\n" * 10_000 + "&a b",
]  # fmt: skip
NO_UTF8 = "is not UTF-8 text"
ATTACKS: dict[str, tuple[str | bytes, str]] = TOLD | {
    "binary": (bytes(range(256)), NO_UTF8),
    "UTF-16": ("id: a\n".encode("utf-16"), NO_UTF8),
    "a picture": (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", NO_UTF8),
}
EACH = """
import sys
from demandops.cli.main import run
for file in sys.argv[2:]:
    print(run(["request", file, "--state-repo", sys.argv[1]]))
"""


@pytest.mark.parametrize(("content", "told"), ATTACKS.values(), ids=ATTACKS)
def test_a_file_is_refused_with_its_name_and_the_place(
    on: On, tmp_path: Path, content: str | bytes, told: str
) -> None:
    file, trace = tmp_path / "request.yaml", tmp_path / "trace"
    if isinstance(content, str):
        content = content.replace("{trace}", str(trace)).replace("{digits}", "9" * 4000)
        content = content.encode()
    file.write_bytes(content)
    errors = on.refused("request", file)
    assert str(file) in errors and told.format(file=file) in errors
    assert not trace.exists()


def test_any_content_of_a_file_ends_in_an_error_message(on: On, tmp_path: Path) -> None:
    file = tmp_path / "request.yaml"
    for content in MORE:
        file.write_text(content)
        errors, shown = on.refused("request", file), repr(content[:24])
        assert str(file) in errors, shown
        assert "fault of" not in errors, f"{shown} is the user's to fix"
        assert len(errors) < 5000, f"{shown}: a message that nobody reads"


def test_brackets_without_end_crash_nothing(
    state: GitRepo, tmp_path: Path, data_home: Path
) -> None:
    """The commands run in another process, because a parser might overflow its stack."""
    files = [tmp_path / "lists.yaml", tmp_path / "mappings.yaml"]
    for file, opening, closing in zip(files, ("[", "{a: "), "]}", strict=True):
        file.write_text("apps: " + opening * 40_000 + closing * 40_000)
    ran = process(sys.executable, "-c", EACH, state.path, *files)
    assert (ran.code, ran.out) == (0, "1\n1\n")
    for file, said in zip(files, ran.err.splitlines(), strict=True):
        assert said.startswith(f"error: {file}: ")
        assert "nested" in said
