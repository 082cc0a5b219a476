"""Signed commits of demands that came over real ROS 2, as the real git checks them."""

from __future__ import annotations

import subprocess
from pathlib import Path

from tests.kit.goals import link as connection
from tests.kit.repo import git
from tests.kit.repo import init as new_state_repo
from tests.kit.ros import Client, Serve


def keygen(path: Path) -> Path:
    command = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "", "-f", str(path)]
    subprocess.run(command, check=True)
    return path


def is_signed(repo: str, commit: str, key: Path) -> bool:
    allowed = key.with_name("allowed-signers")
    public = key.with_name(f"{key.name}.pub").read_text()
    allowed.write_text(f'generator@example.org namespaces="git" {public}')
    config = ["-c", "gpg.format=ssh", "-c", f"gpg.ssh.allowedSignersFile={allowed}"]
    command = ["git", "-C", repo, *config, "verify-commit", commit]
    return subprocess.run(command, check=False, capture_output=True).returncode == 0


def test_what_a_goal_asks_is_a_signed_commit(serve: Serve, client: Client, tmp_path: Path) -> None:
    key = keygen(tmp_path / "key")
    served = serve(None, "--signing-key", str(key))
    client.ready()
    told = client.call(connection(1))
    tip = git(served.state_repo, "rev-parse", "main")
    assert (told.status, told.message) == ("succeeded", f"booked: {tip}")
    assert is_signed(served.state_repo, tip, key)
    assert not is_signed(served.state_repo, tip, keygen(tmp_path / "other"))
    assert not is_signed(served.state_repo, f"{tip}~1", key)
    assert "1 of 1 are signed" in served.demandops("verify", "main")


def test_a_key_that_cannot_sign_is_told_at_the_start(serve: Serve, tmp_path: Path) -> None:
    served = serve(str(new_state_repo(tmp_path / "state.git")), "--signing-key", "/no/such/key")
    assert served.process.wait(30) == 1
    assert "signing key /no/such/key is not a file" in served.log.read_text()
