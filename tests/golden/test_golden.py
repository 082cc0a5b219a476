"""Every step of every case renders exactly the files that a reviewer has approved."""

from __future__ import annotations

import pytest
from demandops.decide.state import rendered_files

from tests.golden.cases import CASES, play, read, to_store


@pytest.mark.parametrize("case", CASES)
def test_every_step_gives_the_files_that_were_reviewed(case: str) -> None:
    assert read(case) == to_store(case), "run `make golden` and review the diff"


@pytest.mark.parametrize("case", CASES)
def test_the_ledger_and_the_configuration_alone_render_the_same_files(case: str) -> None:
    for _, repo in play(case):
        without_ledger = {p: text for p, text in repo.files.items() if not p.startswith("ledger/")}
        assert rendered_files(repo.state, repo.files) == without_ledger
