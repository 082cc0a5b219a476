"""A command that Ctrl-C or SIGTERM interrupts says what is answered, and leaves nothing behind."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
from pathlib import Path

import pytest
import yaml
from demandops.cli.main import run

from tests.kit import rig
from tests.kit.cli import PROGRAM
from tests.kit.limits import PATIENCE_S
from tests.kit.repo import program
from tests.kit.rig import Person

DEMANDS = 120  # in so many batches that the first is seen before the last


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_an_interrupted_request_says_which_demands_are_answered(
    bare: Path, data_home: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], number: int
) -> None:
    """Once a batch is published, the test puts a folder where Git needs the lock file of `main`.

    So nothing more is committed, and some demands have no answer when the interrupt comes. On a
    busy machine it comes before the last ones are sent.
    """
    file = tmp_path / "demands.yaml"
    file.write_text(yaml.safe_dump_all(rig.goal(each) for each in range(DEMANDS)))
    lock = bare / "refs" / "heads" / "main.lock"

    def interrupt() -> None:
        rig.wait_until(lambda: rig.operations(bare), "a batch is published")
        lock.mkdir()
        os.kill(os.getpid(), number)

    if number == signal.SIGHUP:  # tests that run under nohup ignore it, and so would the command
        signal.signal(number, signal.SIG_DFL)
    handler = signal.getsignal(signal.SIGTERM)
    helper = threading.Thread(target=interrupt)
    helper.start()
    code = run(["request", str(file), "--state-repo", str(bare)])
    helper.join()
    lock.rmdir()
    told, booked = capfd.readouterr(), len(rig.operations(bare))
    assert code == 130
    assert told.out.count(" booked in ") == booked < DEMANDS
    unsent = told.err.count("was not sent")
    assert told.err.count(" has no answer yet") == DEMANDS - booked - unsent > 0
    assert f"{booked + unsent} of {DEMANDS} requests have an answer" in told.err
    assert "stay in the journal" in told.err
    assert signal.getsignal(signal.SIGTERM) is handler
    assert rig.restart(bare) is True
    assert DEMANDS - unsent - 1 <= len(rig.operations(bare)) <= DEMANDS - unsent


def test_an_interrupted_check_leaves_no_folder(person: Person, tmp_path: Path) -> None:
    scratch, started = tmp_path / "scratch", tmp_path / "started"
    helm = program(tmp_path / "helm", f"touch {started}\nexec sleep 600")
    scratch.mkdir()
    person.fetch()
    chart = person.folder / "appdefs/object-detection-fusion/charts/object-fusion/values.yaml"
    chart.write_text(chart.read_text() + "# a new chart is rendered\n")
    command = [*PROGRAM, "check", str(person.folder)]
    environment = {**os.environ, "HELM_BIN": str(helm), "TMPDIR": str(scratch)}
    process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
    rig.wait_until(started.exists, "helm runs")
    assert [path.name[:15] for path in scratch.iterdir()] == ["demandops-helm-"]
    process.send_signal(signal.SIGTERM)
    _, told = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, "interrupted" in told) == (130, True)
    assert list(scratch.iterdir()) == []
