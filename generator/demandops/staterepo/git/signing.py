"""Commits signed by an SSH key, exactly as git signs them.

The signature is ``ssh-keygen``'s over the commit's bytes, kept in the header ``gpgsig``, so that
``git verify-commit`` and every forge accept it. Only the key's path is known here; the key itself
is read by ``ssh-keygen`` or held by an agent.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from pathlib import Path

from pygit2 import Oid, Repository, Signature

from demandops.errors import StateRepoError

_TIMEOUT_S = 20
_FIELD = "gpgsig"
_PROBE = b"demandops: can this key sign?\n"


class SigningFailed(StateRepoError):
    """A commit that could not be signed, and so was not made."""


class Signer:
    """Signs with one key: a private key file, or the public one of a key that an agent holds."""

    def __init__(self, key: Path) -> None:
        """Try the key at once: one that cannot sign is told before any demand is taken.

        Raises:
            SigningFailed: saying what is wrong with the key and how to mend it.
        """
        self.key = key.expanduser()
        if not self.key.is_file():
            raise SigningFailed(
                f"signing key {key} is no file; make one with `ssh-keygen -t ed25519 -f {key}`, or "
                "name the one you have"
            )
        self.sign(_PROBE)

    def sign(self, data: bytes) -> str:
        """Return the signature of ``data``, in the armour that git keeps.

        Raises:
            SigningFailed: where there is none.
        """
        command = ["ssh-keygen", "-Y", "sign", "-n", "git", "-f", str(self.key)]
        environment = dict(os.environ) | {"SSH_ASKPASS_REQUIRE": "never", "LC_ALL": "C"}
        try:
            done = subprocess.run(
                command,
                input=data,
                capture_output=True,
                timeout=_TIMEOUT_S,
                check=False,
                env=environment,
                start_new_session=True,  # no terminal, so that nobody is asked for a passphrase
            )
        except FileNotFoundError:
            raise SigningFailed(
                "ssh-keygen is missing, and signs the commits; install it (Debian: apt-get install "
                "openssh-client)"
            ) from None
        except subprocess.TimeoutExpired:
            raise SigningFailed(
                f"signing with {self.key} took more than {_TIMEOUT_S} s; does its agent wait for "
                "somebody to confirm?"
            ) from None
        if done.returncode:
            raise SigningFailed(_key_fault(self.key, done.stderr.decode("utf-8", "replace")))
        return done.stdout.decode("ascii").rstrip("\n")


def _key_fault(key: Path, said: str) -> str:
    """Return what is wrong with a key, from what ssh-keygen said of it."""
    if "UNPROTECTED PRIVATE KEY" in said or "bad permissions" in said:
        return f"signing key {key} can be read by others; run: chmod 600 {key}"
    if "Permission denied" in said:
        return f"signing key {key} cannot be read; run as its owner, or name another"
    if "passphrase" in said:
        return (
            f"signing key {key} has a passphrase; run `ssh-add {key}` and name {key}.pub, so that "
            "the agent signs"
        )
    last = next((line for line in reversed(said.strip().splitlines()) if line.strip()), "")
    if "agent" in said or "No private key found" in said:
        return (
            f"signing key {key} is public, and no agent signs for it ({last.strip()}); run "
            "`ssh-add` with the private key, with SSH_AUTH_SOCK set here as well"
        )
    return f"signing key {key} does not sign: {last.strip()}; name a private SSH key"


def create_commit(
    repo: Repository,
    signer: Signer | None,
    people: tuple[Signature, Signature],
    text: str,
    tree: Oid,
    parents: Sequence[Oid],
) -> Oid:
    """Write a commit by ``people`` (author, committer), signed where there is a signer."""
    author, committer = people
    if signer is None:
        return repo.create_commit(None, author, committer, text, tree, list(parents))
    content = str(repo.create_commit_string(author, committer, text, tree, list(parents)))
    return repo.create_commit_with_signature(content, signer.sign(content.encode()), _FIELD)
