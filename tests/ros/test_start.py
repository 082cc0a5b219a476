"""What `demandops serve` refuses at its start."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from tests.kit.cli import Run


@pytest.mark.parametrize(
    ("args", "code", "message"),
    [
        ("--fetch-interval often", 2, "fetch interval: 'often' is not a duration; write one"),
        ("--ros-args -p fetch_interval:=-3", 2, "fetch interval: '-3' is not a duration"),
        ("--ros-args -p log_level:=loud", 2, "parameter log_level is 'loud'; it takes debug, info"),
        ("--ros-args -p log_level", 2, "ROS does not start with the arguments after --ros-args:"),
        ("--ros-args -p answer_timeout:=120", 2, "'120' of type 'INTEGER', expecting type"),
        ("--ros-args -p requester_queue_limit:=0", 2, "limit out of range. Min: 1, Max: 10000"),
        ("--webhook 0.0.0.0:0", 1, "error: --webhook: '0.0.0.0:0' can be reached from other"),
        ("--webhook 127.0.0.1:0 --webhook-secret-file /nowhere/secret", 1,
         "error: /nowhere/secret: cannot be read: No such file"),
        ("--leader-lease its", 1, "error: --leader-lease: 'its' names no Lease; write"),
        ("--signing-key /no/such/key", 1, "signing key /no/such/key is not a file"),
        ("--state-repo /nowhere", 1, "/nowhere does not exist; correct the path, or make a state"),
    ],
)  # fmt: skip
def test_what_cannot_be_served_is_refused_with_a_reason(
    bare: Path, demandops: Run, args: str, code: int, message: str
) -> None:
    threads = set(threading.enumerate())
    refused = demandops("serve", "--state-repo", bare, *args.split())
    assert refused.code == code
    assert message in " ".join(refused.err.split())
    assert set(threading.enumerate()) <= threads, "the refused start left a thread"
