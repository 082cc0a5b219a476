"""What is rendered is what a reviewer has seen: byte for byte, for every step of every case."""

from __future__ import annotations

import pytest
from demandops.decision import rendered_files

from tests.golden.cases import CASES, HERE, play, requests_of, start


def _expected(case: str, name: str) -> dict[str, str]:
    folder = HERE / case / "expected" / name
    return {
        path.relative_to(folder).as_posix(): path.read_text()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.mark.parametrize("case", CASES)
def test_every_step_gives_the_files_that_were_reviewed(case: str) -> None:
    steps = dict(play(case))
    assert list(steps) == [file.stem for file in requests_of(case)]
    for name, files in steps.items():
        expected = _expected(case, name)
        assert sorted(files) == sorted(expected), f"{case}/{name}: other files (make golden)"
        for path, text in files.items():
            assert text == expected[path], f"{case}/{name}/{path} (make golden)"


def test_after_the_last_vehicle_left_only_what_init_laid_down_is_there() -> None:
    _, standing = start("experiment")
    *_, (_, last) = play("experiment")
    assert last == standing


def test_between_steps_two_and_seven_only_the_fusions_inputs_change() -> None:
    path = "clusters/c-its/perception/edge/of-edge-object-detection-fusion-cf7e0180a8bb.yaml"
    texts = [files[path] for _, files in list(play("experiment"))[1:7]]
    fixed = {
        "\n".join(line for line in text.splitlines() if not line.strip().startswith("- /"))
        for text in texts
    }
    assert len(fixed) == 1
    assert len(set(texts)) == len(texts)


def test_a_further_requester_changes_the_ledger_and_no_release() -> None:
    steps = dict(play("experiment"))
    before, after = steps["1-vehicle00-joins"], steps["2-vehicle01-joins"]
    station = "clusters/c-its/perception/edge/od-edge-station00.yaml"
    assert before[station] == after[station]
    assert not any("vehicle01" in before[p] for p in before if p.startswith("clusters/"))


def test_rendering_from_the_books_alone_gives_the_same_bytes() -> None:
    state, standing = start("experiment")
    assert rendered_files(state) == standing
