"""Signed commits of demands that came over real ROS 2, as the real git checks them."""

from __future__ import annotations

import subprocess
from pathlib import Path

from tests.kit.goals import link as connection
from tests.kit.repo import git
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


def test_the_commit_of_a_goal_is_signed(serve: Serve, client: Client, tmp_path: Path) -> None:
    key = keygen(tmp_path / "key")
    served = serve(None, "--signing-key", str(key))
    client.ready()
    answer = client.call(connection(1))
    tip = git(served.state_repo, "rev-parse", "main")
    assert (answer.status, answer.message) == ("succeeded", f"booked: {tip}")
    assert is_signed(served.state_repo, tip, key)
    assert not is_signed(served.state_repo, tip, keygen(tmp_path / "other"))
    assert not is_signed(served.state_repo, f"{tip}~1", key)
    assert "1 of 1 are signed" in served.demandops("verify", "main")
