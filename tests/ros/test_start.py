"""What `demandops serve` refuses at its start."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from tests.kit import plain_yaml
from tests.kit.cli import Run

REFUSED = plain_yaml.load(Path(__file__).with_name("refused.yaml").read_text())


@pytest.mark.parametrize(("args", "code", "message"), REFUSED["start"])
def test_what_cannot_be_served_is_refused_with_a_reason(
    bare: Path, demandops: Run, args: str, code: int, message: str
) -> None:
    threads = set(threading.enumerate())
    refused = demandops("serve", "--state-repo", bare, *args.split())
    assert refused.code == code
    assert message in " ".join(refused.err.split())
    assert set(threading.enumerate()) <= threads, "the refused start left a thread"
