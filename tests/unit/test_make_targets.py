"""Every test file is run by a make target."""

from __future__ import annotations

import os
import shlex
import subprocess
from functools import lru_cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TEST_FILES = sorted((ROOT / "tests").rglob("test_*.py"))
TARGETS = (
    "test",
    "test-processes",
    "test-packages",
    "page",
    "docs",
    "simulate",
    "faults",
    "e2e",
    "e2e-argocd",
)


@lru_cache
def files_run_by(target: str) -> frozenset[Path]:
    environment = {name: value for name, value in os.environ.items() if "MAKE" not in name}
    printed = subprocess.run(
        ["make", "--dry-run", "--no-print-directory", target],
        cwd=ROOT,
        env=environment | {"E2E_KUBECONFIG": "a file"},  # so make e2e builds nothing
        capture_output=True,
        text=True,
        check=True,
    ).stdout.replace("\\\n", " ")
    (call,) = [line for line in printed.splitlines() if " -m pytest " in line]
    words = shlex.split(call.replace("--ignore ", "--ignore="))
    ignored = [ROOT / word.removeprefix("--ignore=") for word in words if "--ignore=" in word]
    named = [ROOT / word for word in words if word.startswith("tests")]
    assert all(path.exists() for path in (*named, *ignored))
    return frozenset(
        file
        for file in TEST_FILES
        if any(file.is_relative_to(path) for path in named)
        and not any(file.is_relative_to(path) for path in ignored)
    )


def test_every_test_file_is_run() -> None:
    run = frozenset[Path]().union(*map(files_run_by, TARGETS))
    assert [str(file.relative_to(ROOT)) for file in TEST_FILES if file not in run] == []


@pytest.mark.parametrize("target", TARGETS)
def test_a_target_runs_tests_of_its_own(target: str) -> None:
    others = (files_run_by(other) for other in TARGETS if other != target)
    assert files_run_by(target) - frozenset[Path]().union(*others)
