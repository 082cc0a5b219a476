"""Commits signed by an SSH key, in the same way as git signs them.

``ssh-keygen`` signs the commit's bytes, and the signature goes into the header ``gpgsig``, so
``git verify-commit`` accepts it, and so do forges that check SSH signatures. This module knows only
the key's path; ``ssh-keygen`` reads the key or asks an SSH agent.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from pathlib import Path

from pygit2 import Oid, Signature
from pygit2.enums import ObjectType

from demandops.base.errors import StateRepoError
from demandops.repo.git import child_processes
from demandops.repo.git.objects import NewObjects

_TIMEOUT_S = 20


class SigningFailed(StateRepoError):
    """Raised when ``ssh-keygen`` or the key cannot sign; then no commit is made."""


class Signer:
    """Signs with one key: a private key file, or the public file of a key that an agent holds."""

    def __init__(self, key: Path) -> None:
        self.key = key.expanduser()
        if not self.key.is_file():
            raise SigningFailed(
                f"signing key {key} is not a file; make one with `ssh-keygen -t ed25519 -f {key}`, "
                "or name an existing one"
            )
        # so that a key that cannot sign is noticed before a demand is accepted
        self.sign(b"demandops: can this key sign?\n")

    def sign(self, data: bytes) -> str:
        command = ["ssh-keygen", "-Y", "sign", "-n", "git", "-f", str(self.key)]
        environment = os.environ | {"SSH_ASKPASS_REQUIRE": "never", "LC_ALL": "C"}
        try:
            done = subprocess.run(
                command,
                input=data,
                capture_output=True,
                timeout=_TIMEOUT_S,
                check=False,
                env=environment | child_processes.mark(),
                start_new_session=True,  # no terminal, so that ssh-keygen asks for no passphrase
            )
        except FileNotFoundError:
            raise SigningFailed(
                "ssh-keygen, which signs the commits, is missing; install it (Debian: apt-get "
                "install openssh-client)"
            ) from None
        except subprocess.TimeoutExpired:
            raise SigningFailed(
                f"signing with {self.key} took more than {_TIMEOUT_S} s; check whether its agent "
                "waits for a confirmation"
            ) from None
        if done.returncode:
            raise SigningFailed(_key_fault(self.key, done.stderr.decode("utf-8", "replace")))
        return done.stdout.decode("ascii").rstrip("\n")


def _key_fault(key: Path, output: str) -> str:
    output = output.replace(str(key), "the key")  # the path may have any of the words below
    if "UNPROTECTED PRIVATE KEY" in output or "bad permissions" in output:
        return f"signing key {key} can be read by others; run: chmod 600 {key}"
    if "Permission denied" in output:
        return f"signing key {key} cannot be read; run as its owner, or name another key"
    if "passphrase" in output:
        return (
            f"signing key {key} has a passphrase; run `ssh-add {key}` and name {key}.pub, so that "
            "the agent signs"
        )
    last = next((line for line in reversed(output.strip().splitlines()) if line.strip()), "")
    if "agent" in output or "No private key found" in output:
        return (
            f"signing key {key} is public, and no agent signs for it ({last.strip()}); run "
            "`ssh-add` with the private key, and set SSH_AUTH_SOCK for this program too"
        )
    return f"signing key {key} cannot sign: {last.strip()}; name a private SSH key"


def create_commit(
    objects: NewObjects,
    signer: Signer | None,
    people: tuple[Signature, Signature],
    text: str,
    tree: Oid,
    parents: Sequence[Oid],
) -> Oid:
    """Add a commit by ``people`` (author, committer) to ``objects``, and return its id."""
    content = str(objects.repo.create_commit_string(*people, text, tree, list(parents)))
    if signer is not None:
        head, end, message = content.partition("\n\n")
        # in a commit's header, a line that begins with a space continues the line before
        signature = signer.sign(content.encode()).replace("\n", "\n ")
        content = f"{head}\ngpgsig {signature}{end}{message}"
    return objects.add(ObjectType.COMMIT, content.encode())
