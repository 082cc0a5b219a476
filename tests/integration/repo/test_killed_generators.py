"""What a generator has started ends when the generator is killed, also while a server is silent."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from tests.kit import rig
from tests.kit.git_over_http import Server
from tests.kit.repo import keygen
from tests.kit.rig import goal, wait_until

# The second line of the input lets it submit a demand; it ends only if it is killed.
GENERATOR = """
import json, sys, threading
from pathlib import Path
from demandops.serve.generator import Generator
address, key = sys.argv[1:]
generator = Generator(address, signing_key=Path(key) if key else None)
print("ready", flush=True)
generator.submit(json.loads(sys.stdin.readline()), "op-hanging")
threading.Event().wait()
"""


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
    address: str, text: str, *, key: str = "", hang: Callable[[], object] | None = None
) -> None:
    """Kill a generator that waits for a process with ``text`` in its command; nothing is left.

    If ``hang`` is given, it is called before a demand, otherwise the start hangs.
    """
    process = subprocess.Popen(
        [sys.executable, "-c", GENERATOR, address, key],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert process.stdin and process.stdout
    try:
        if hang is not None:
            assert process.stdout.readline() == "ready\n"
            hang()
            process.stdin.write(json.dumps(goal(1)) + "\n")
            process.stdin.flush()
        wait_until(lambda: any(text in command(pid) for pid in started_by(process.pid)), text)
        left = started_by(process.pid)
    finally:
        process.kill()
        process.communicate()
    wait_until(
        lambda: not [pid for pid, start in left.items() if _stat(pid)[19:20] == [start]],
        "what the generator had started ended",
    )


def test_a_push_over_http_ends_with_its_generator(http: str, server: Server, bare: Path) -> None:
    silence = threading.Event()
    try:
        kill_while_hanging(
            http, "git-remote-http", hang=lambda: setattr(server.faults, "hang", silence)
        )
        server.faults.hang = None  # but the server still holds the killed push
        assert rig.restart(http) is True
        assert rig.operations(bare) == ["op-hanging"]
    finally:
        silence.set()


def test_a_clone_or_a_push_over_ssh_ends_with_its_generator(bare: Path, ssh: Path) -> None:
    address = f"ssh://host{bare}"
    push, fetch = (ssh.with_name(f"ssh.{silent}") for silent in ("push", "fetch"))
    fetch.touch()
    kill_while_hanging(address, "sleep 1000")
    fetch.unlink()
    kill_while_hanging(address, "sleep 1000", hang=push.touch)
    push.unlink()
    assert rig.restart(address) is True
    assert rig.operations(bare) == ["op-hanging"]


def test_a_signature_that_an_agent_does_not_give_ends_with_its_generator(
    bare: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = keygen(tmp_path / "key")
    key.unlink()  # so that only an agent can sign
    with socket.socket(socket.AF_UNIX) as agent, tempfile.TemporaryDirectory() as short:
        agent.bind(f"{short}/agent")
        agent.listen()
        monkeypatch.setenv("SSH_AUTH_SOCK", f"{short}/agent")
        kill_while_hanging(str(bare), "ssh-keygen", key=f"{key}.pub")
