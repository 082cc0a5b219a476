"""Fixtures: a clock, Git servers with faults, and a person named Petra."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from demandops.serve import agenda

from tests.kit.clock import Clock
from tests.kit.git_over_http import Server, serving
from tests.kit.repo import Person, program

SSH = Path(__file__).with_name("ssh-with-faults.sh").read_text()


@pytest.fixture(autouse=True)
def _petra_commits(git_environment: None) -> None:
    """Make Petra the author of what a test commits with git."""


@pytest.fixture
def clock() -> Clock:
    """A clock that runs by itself, and that a test can also move."""
    return Clock()


@pytest.fixture
def server(bare: Path) -> Iterator[Server]:
    with serving(bare.parent) as running:
        yield running


@pytest.fixture
def http(server: Server) -> str:
    return f"{server.url}/state.git"


@pytest.fixture
def petra(person: Person, monkeypatch: pytest.MonkeyPatch) -> Person:
    """Petra, who may approve demands.

    The policy requires approval for all demands, and generators often check for decisions.
    """
    monkeypatch.setattr(agenda, "CHECK_LOCAL_S", 0.05)
    monkeypatch.setattr(agenda, "CHECK_REMOTE_S", 0.1)
    person.policy(approval="required")
    return person


@pytest.fixture
def ssh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A program in the place of ssh; files beside it set its faults.

    While `ssh.push` or `ssh.fetch` exists, it is silent at pushes or fetches. With the variable
    SAYS, it refuses pushes with these words, unless `ssh.open` exists.
    """
    ssh = program(tmp_path / "ssh", SSH, "/bin/bash")
    monkeypatch.setenv("GIT_SSH_COMMAND", str(ssh))
    monkeypatch.setenv("GIT_SSH_VARIANT", "ssh")
    return ssh
