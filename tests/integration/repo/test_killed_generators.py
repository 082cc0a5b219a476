"""What a generator has started ends when the generator is killed, also while a server is silent."""

from __future__ import annotations

import json
import socket
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest

from tests.kit import rig
from tests.kit.git_over_http import Server
from tests.kit.repo import keygen
from tests.kit.rig import Drivers, demand, goal, wait_until


def _stat(pid: int) -> list[str]:
    """Return the fields of a process after its name: state, parent, …; none if it has ended."""
    with suppress(OSError):
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        if fields[0] != "Z":
            return fields
    return []


def started_by(pid: int) -> dict[int, str]:
    """Return each running descendant of a process with the time of its start."""
    known = {int(at.name): _stat(int(at.name)) for at in Path("/proc").glob("[0-9]*")}
    found, parents = dict[int, str](), {pid}
    while parents:
        children = {each for each, fields in known.items() if fields and int(fields[1]) in parents}
        found |= {each: known[each][19] for each in children}
        parents = children
    return found


def command(pid: int) -> str:
    with suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ")
    return ""


def kill_while_hanging(
    drivers: Drivers,
    address: str | Path,
    text: str,
    *,
    key: Path | None = None,
    hang: Callable[[], object] | None = None,
) -> None:
    """Kill a generator that waits for a process with ``text`` in its command; nothing is left.

    If ``hang`` is given, it is called before a demand, otherwise the start hangs.
    """
    run = drivers.start(address, [[demand("hanging", goal(1))]], key=key)
    assert run.stdin and run.stdout
    try:
        if hang is not None:
            assert json.loads(run.stdout.readline()) == {"ready": True}
            hang()
            run.stdin.close()
        wait_until(lambda: any(text in command(pid) for pid in started_by(run.pid)), text)
        left = started_by(run.pid)
    finally:
        run.kill()
        run.wait(rig.PATIENCE_S)
    wait_until(
        lambda: not [pid for pid, start in left.items() if _stat(pid)[19:20] == [start]],
        "what the generator had started ended",
    )


def test_a_push_over_http_ends_with_its_generator(
    drivers: Drivers, http: str, server: Server, bare: Path
) -> None:
    silence = threading.Event()
    try:
        hang = partial(setattr, server.faults, "hang", silence)
        kill_while_hanging(drivers, http, "git-remote-http", hang=hang)
        server.faults.hang = None  # but the server still holds the killed push
        assert rig.restart(http) is True
        assert rig.operations(bare) == ["op-hanging"]
    finally:
        silence.set()


def test_a_clone_or_a_push_over_ssh_ends_with_its_generator(
    drivers: Drivers, bare: Path, ssh: Path
) -> None:
    address = f"ssh://host{bare}"
    push, fetch = (ssh.with_name(f"ssh.{silent}") for silent in ("push", "fetch"))
    fetch.touch()
    kill_while_hanging(drivers, address, "sleep 1000")
    fetch.unlink()
    kill_while_hanging(drivers, address, "sleep 1000", hang=push.touch)
    push.unlink()
    assert rig.restart(address) is True
    assert rig.operations(bare) == ["op-hanging"]


def test_a_signature_that_an_agent_does_not_give_ends_with_its_generator(
    drivers: Drivers, bare: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = keygen(tmp_path / "key")
    key.unlink()  # so that only an agent can sign
    with socket.socket(socket.AF_UNIX) as agent, tempfile.TemporaryDirectory() as short:
        agent.bind(f"{short}/agent")
        agent.listen()
        monkeypatch.setenv("SSH_AUTH_SOCK", f"{short}/agent")
        kill_while_hanging(drivers, bare, "ssh-keygen", key=key.with_suffix(".pub"))
