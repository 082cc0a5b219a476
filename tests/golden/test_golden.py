"""Every step of every case renders exactly the files that a reviewer has approved."""

from __future__ import annotations

import pytest
from demandops.decide.state import rendered_files

from tests.golden.cases import CASES, play, read, rendered, to_store, whole


@pytest.mark.parametrize("case", CASES)
def test_every_step_gives_the_files_that_were_reviewed(case: str) -> None:
    assert read(case) == to_store(case), "run `make golden` and review the diff"


@pytest.mark.parametrize("case", CASES)
def test_the_ledger_and_the_configuration_alone_render_the_same_files(case: str) -> None:
    for step, repo in play(case):
        files = whole(case)[step]
        without_ledger = {p: text for p, text in files.items() if not p.startswith("ledger/")}
        assert rendered_files(repo.state, files) == without_ledger


def test_between_steps_two_and_seven_only_the_fusions_inputs_change() -> None:
    path = "clusters/c-its/perception/edge/of-edge-object-detection-fusion-cf7e0180a8bb.yaml"
    texts = [files[path] for files in list(rendered("experiment").values())[2:8]]
    fixed = {
        "\n".join(line for line in text.splitlines() if not line.strip().startswith("- /"))
        for text in texts
    }
    assert len(fixed) == 1
    assert len(set(texts)) == len(texts)
