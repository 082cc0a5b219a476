"""If the fault injection resumes an interrupted run, it tries only the tasks that are left."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults import progress
from tests.faults.injection import Result
from tests.faults.progress import Passed

SOUND = Result("remote", ("git push", "openat", "state.git/HEAD"), "EIO", ())
BROKEN = Result(
    "remote", ("git push", "write", "state.git/HEAD"), "EIO", ("acknowledged, missing",)
)


def interrupted(file: Path) -> None:
    """Add two tasks, of which one breaks a promise, and do not finish the run."""
    run = Passed(file, resume=False)
    run.add("one", [SOUND, SOUND])
    run.add("two", [SOUND, BROKEN])


def test_a_run_goes_on_with_what_was_not_tried_or_not_sound(tmp_path: Path) -> None:
    file = tmp_path / "build" / "tried.jsonl"
    interrupted(file)
    assert Passed(file, resume=True).sound == {"one": [SOUND, SOUND]}


def test_a_line_that_the_interruption_cut_off_is_tried_again(tmp_path: Path) -> None:
    file = tmp_path / "tried.jsonl"
    interrupted(file)
    whole = file.read_text()
    file.write_text(whole + '["three", [{"pa')
    resumed = Passed(file, resume=True)
    resumed.add("four", [SOUND])
    assert list(resumed.sound) == ["one"]
    assert list(Passed(file, resume=True).sound) == ["one", "four"]


def test_a_run_begins_anew_unless_it_is_told_to_go_on(tmp_path: Path) -> None:
    file = tmp_path / "tried.jsonl"
    interrupted(file)
    assert Passed(file, resume=False).sound == {}
    assert Passed(file, resume=True).sound == {}


def test_nothing_is_taken_over_from_another_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "tried.jsonl"
    interrupted(file)
    monkeypatch.setattr(progress, "_program", lambda: "another")
    assert Passed(file, resume=True).sound == {}
    assert "the program has changed" in capsys.readouterr().out


def test_a_run_that_reached_its_end_leaves_nothing(tmp_path: Path) -> None:
    file = tmp_path / "tried.jsonl"
    interrupted(file)
    Passed(file, resume=True).finish()
    assert not file.exists()
