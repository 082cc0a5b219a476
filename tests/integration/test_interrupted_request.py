"""`demandops request` ends at once after Ctrl-C or SIGTERM, and says which demands are answered."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path

import pytest
import yaml
from demandops.cli.main import run

from tests.kit import rig


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_an_interrupted_request_says_which_demands_are_answered(
    bare: Path, data_home: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], number: int
) -> None:
    """Once a batch is published, the test puts a folder where Git needs the lock file of `main`.

    So nothing more is committed, and some demands have no answer when the interrupt comes. On a
    busy machine it comes before the last ones are sent.
    """
    file = tmp_path / "demands.yaml"
    file.write_text(yaml.safe_dump_all(rig.goal(each) for each in range(60)))
    lock = bare / "refs" / "heads" / "main.lock"

    def interrupt() -> None:
        rig.wait_until(lambda: rig.operations(bare), "a batch is published")
        lock.mkdir()
        os.kill(os.getpid(), number)

    handler = signal.getsignal(signal.SIGTERM)
    helper = threading.Thread(target=interrupt)
    helper.start()
    code = run(["request", str(file), "--state-repo", str(bare)])
    helper.join()
    lock.rmdir()
    told, booked = capfd.readouterr(), len(rig.operations(bare))
    assert code == 130
    assert told.out.count(" booked in ") == booked < 60
    unsent = told.err.count("was not sent")
    assert told.err.count(" has no answer yet") == 60 - booked - unsent > 0
    assert f"{booked + unsent} of 60 requests have an answer" in told.err
    assert "stay in the journal" in told.err
    assert signal.getsignal(signal.SIGTERM) is handler
    assert rig.restart(bare) is True
    assert 60 - unsent - 1 <= len(rig.operations(bare)) <= 60 - unsent
