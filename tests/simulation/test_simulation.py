"""A seed determines the whole history, and the oracle finds each planted fault."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.simulation.faults import FAULTS
from tests.simulation.history import clean_up, play

ROOT = Path(__file__).parents[2]
SEEDS = range(120)


@pytest.fixture(scope="module", autouse=True)
def _cleaned() -> Iterator[None]:
    yield
    clean_up()


def test_a_seed_decides_all_and_the_told_command_plays_it_again(tmp_path: Path) -> None:
    (tip, counts), other = play(7), play(8)
    assert tip != other[0]
    assert counts["commits"] > counts["demands"] // 3 > 3
    environment = {"SEED": "7", "HISTORIES": "1", "PYTHONHASHSEED": "3"}
    paths = os.pathsep.join([str(ROOT), *sys.path])
    ran = subprocess.run(
        [sys.executable, "-m", "tests.simulation.run"],
        cwd=tmp_path,
        env=os.environ | environment | {"PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ran.returncode, ran.stderr) == (0, "")
    assert f"the last commit is {tip}\n" in ran.stdout
    assert "1 histories, " in ran.stdout


@pytest.mark.parametrize("title", FAULTS)
def test_a_planted_fault_is_found(title: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fault = FAULTS[title]
    fault.plant(monkeypatch.setattr)
    # the fault's own seed finds it at once, unless the program or the histories have changed
    for seed in (fault.seed, *SEEDS):
        try:
            play(seed)
        except AssertionError as error:
            print(f"found with seed {seed}: {str(error).splitlines()[0]}")
            return
    pytest.fail(f"not found with {len(SEEDS)} seeds")
