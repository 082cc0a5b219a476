"""The runtime reports a thread that fails, and starts it again."""

from __future__ import annotations

import logging

import pytest
from demandops.base.errors import StateRepoError, Unsound

from tests.kit.clock import Turns


def test_a_thread_that_fails_is_started_again_and_told_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    turns, began = Turns(1), list[float]()

    def work() -> None:
        began.append(turns.monotonic())
        if len(began) < 4:
            raise KeyError("odd")

    thread = turns.keep_running("watch", work)
    turns.sleep(0.5)
    assert turns.failures == {"watch": "KeyError('odd')"}
    thread.join()
    assert began == [0, 1, 3, 7], "each pause must be longer"
    told = [record for record in caplog.records if record.levelno >= logging.INFO]
    assert [record.getMessage() for record in told] == ["internal error in watch: KeyError('odd')"]
    assert told[0].exc_info is not None
    turns.sleep(200)
    assert turns.failures == {}, "a thread that works again has no failure"


def test_what_works_again_may_fail_again(caplog: pytest.LogCaptureFixture) -> None:
    turns = Turns(1)
    error = StateRepoError("the tip cannot be read")
    turns.failed("writer", error)
    turns.recovered("writer")
    assert turns.failures == {}
    turns.failed("writer", error)
    turns.failed("writer", error)
    assert caplog.messages == ["the tip cannot be read"] * 2


def test_a_thread_that_ends_as_unsound_is_not_restarted() -> None:
    turns, told = Turns(1), list[object]()
    turns.when_unsound = lambda: told.append(turns.unsound)

    def work() -> None:
        raise Unsound("an I/O error")

    turns.keep_running("writer", work).join()
    assert [str(each) for each in told] == ["an I/O error"]
