"""What `demandops serve` refuses at its start, and what a test reports about a start that hangs."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from tests.kit.cli import Run
from tests.kit.ros import Served

HANGS = """
import sys, threading

def hang():
    sys.stderr.write("hangs\\n")
    threading.Event().wait()

threading.Thread(target=hang).start()
hang()
"""
LOG_LEVEL = "parameter log_level is 'loud'; it takes debug, info, warn, error, fatal"


@pytest.mark.parametrize(
    ("args", "code", "message"),
    [
        (["--fetch-interval", "often"], 2, "fetch interval: 'often' is not a duration; write one"),
        (["--ros-args", "-p", "fetch_interval:=-3"], 2, "fetch interval: '-3' is not a duration"),
        (["--ros-args", "-p", "log_level:=loud"], 2, LOG_LEVEL),
        (
            ["--ros-args", "-p", "log_level"],
            2,
            "ROS does not start with the arguments after --ros-args: failed to initialize rcl",
        ),
        (
            ["--ros-args", "-p", "answer_timeout:=120"],
            2,
            "Trying to set parameter 'answer_timeout' to '120' of type 'INTEGER', expecting type",
        ),
        (
            ["--ros-args", "-p", "requester_queue_limit:=0"],
            2,
            "Parameter requester_queue_limit out of range. Min: 1, Max: 10000, value: 0",
        ),
        (["--webhook", "0.0.0.0:0"], 1, "error: --webhook: '0.0.0.0:0' can be reached from other"),
        (
            ["--webhook", "127.0.0.1:0", "--webhook-secret-file", "/nowhere/secret"],
            1,
            "error: /nowhere/secret: cannot be read: No such file",
        ),
        (["--leader-lease", "its"], 1, "error: --leader-lease: 'its' names no Lease; write"),
        (["--signing-key", "/no/such/key"], 1, "signing key /no/such/key is not a file"),
    ],
)
def test_what_cannot_be_served_is_refused_with_a_reason(
    bare: Path, demandops: Run, args: list[str], code: int, message: str
) -> None:
    threads = set(threading.enumerate())
    refused = demandops("serve", "--state-repo", bare, *args)
    assert refused.code == code
    assert message in " ".join(refused.err.split())
    assert set(threading.enumerate()) <= threads, "the refused start left a thread"


def test_a_missing_state_repo_is_refused_with_the_remedy(tmp_path: Path, demandops: Run) -> None:
    refused = demandops("serve", "--state-repo", tmp_path / "nowhere")
    assert refused.code == 1
    assert refused.err == (
        f"error: {tmp_path}/nowhere does not exist; correct the path, or make a state repo there "
        f"with `demandops init {tmp_path}/nowhere --bare`\n"
    )


@pytest.mark.parametrize(
    ("program", "told"),
    [
        ("raise SystemExit('over')", r"ended with 1\nover\n"),
        (HANGS, r"(?s)runs as \d+\n.*: ran \d+\.\d s, waited .*line 6 in hang\n.*line 6 in hang\n"),
    ],
)
def test_a_test_that_waits_in_vain_tells_what_the_process_does(
    tmp_path: Path, program: str, told: str
) -> None:
    log = tmp_path / "log"
    with log.open("w") as sink:
        command = [sys.executable, "-X", "faulthandler", "-c", program]
        served = Served(subprocess.Popen(command, stderr=sink, text=True), "", log, {}, 0)
    if program == HANGS:
        served.wait_for("hangs\nhangs\n")
    with pytest.raises(AssertionError, match=told):
        served.wait_for("taking demands", 60 if program != HANGS else 0.5)
    assert served.process.returncode in (1, -signal.SIGABRT)
