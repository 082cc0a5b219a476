"""Signatures of commits: made with an SSH key, and checked against the keys that people allow."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from pygit2 import Commit, Oid, Repository

from demandops.base.errors import StateRepoError
from demandops.repo.git import child_processes
from demandops.repo.git import tree as trees

# ---- signing with an SSH key, in the same way as git ----
#
# ``ssh-keygen`` signs the commit's bytes, and the signature goes into the header ``gpgsig``, so
# ``git verify-commit`` accepts it, and so do forges that check SSH signatures. This module knows
# only the key's path; ``ssh-keygen`` reads the key or asks an SSH agent.

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
        if not done.returncode:
            return done.stdout.decode("ascii").rstrip("\n")
        output = done.stderr.decode("utf-8", "replace")
        output = output.replace(str(self.key), "the key")  # its path may have any of these words
        last = next((line for line in reversed(output.strip().splitlines()) if line.strip()), "")
        if "UNPROTECTED PRIVATE KEY" in output or "bad permissions" in output:
            why = f"can be read by others; run: chmod 600 {self.key}"
        elif "Permission denied" in output:
            why = "cannot be read; run as its owner, or name another key"
        elif "passphrase" in output:
            why = f"has a passphrase; run `ssh-add {self.key}` and name {self.key}.pub, so that "
            why += "the agent signs"
        elif "agent" in output or "No private key found" in output:
            why = f"is public, and no agent signs for it ({last.strip()}); run `ssh-add` with the "
            why += "private key, and set SSH_AUTH_SOCK for this program too"
        else:
            why = f"cannot sign: {last.strip()}; name a private SSH key"
        raise SigningFailed(f"signing key {self.key} {why}")


# ---- checking against the keys that people allow ----
#
# People list the keys in ``policy/allowed-signers`` (ssh-keygen's ALLOWED SIGNERS format). The list
# in the commit's parent counts, so that a commit cannot allow its own key. One git process checks
# all commits with the same list.

ALLOWED_SIGNERS = "policy/allowed-signers"

_SSH = "-----BEGIN SSH SIGNATURE-----"
_SSH_KEYGEN = "ssh-keygen"
_CONFIG = ("-c", f"gpg.ssh.program={_SSH_KEYGEN}", "-c", "gpg.minTrustLevel=undefined")
_MOST_KNOWN = 100_000


class Check(NamedTuple):
    """The result of checking a signature: who signed, or why it is not valid."""

    signer: str = ""
    fault: str = ""


# Commit → result, for each commit whose signature was found valid. A result stays true, because
# neither a commit, its signature nor its parent's list of keys changes.
_good: dict[str, Check] = {}


def are_listed(repo: Repository, commit: Oid) -> bool:
    return trees.entry(trees.commit_of(repo, commit).tree, ALLOWED_SIGNERS) is not None


def signature_of(commit: Commit) -> str:
    return (commit.gpg_signature[0] or b"").decode("utf-8", "replace")


def faults(repo: Repository, commits: Iterable[Commit]) -> dict[str, str]:
    return {commit: check.fault for commit, check in checks(repo, commits).items() if check.fault}


def checks(repo: Repository, commits: Iterable[Commit]) -> dict[str, Check]:
    """Check the signatures of those commits whose first parent lists the allowed keys."""
    signatures, results = dict[str, str](), dict[str, Check]()
    lists: dict[str, list[str]] = {}
    for commit in commits:
        id = str(commit.id)
        allowed = trees.read_text(trees.parent_tree(commit), ALLOWED_SIGNERS)
        if allowed is not None and id in _good:
            results[id] = _good[id]
        elif allowed is not None:
            signatures[id] = signature_of(commit)
            lists.setdefault(allowed, []).append(id)
    if len(_good) > _MOST_KNOWN:
        _good.clear()
    if any(signatures.values()) and shutil.which(_SSH_KEYGEN) is None:
        raise StateRepoError(
            f"{_SSH_KEYGEN}, which checks the signatures of commits, is missing; install it "
            "(Debian: apt-get install openssh-client)"
        )
    for allowed, ids in lists.items():
        with tempfile.NamedTemporaryFile("w", prefix="demandops-") as file:
            file.write(allowed)
            file.flush()
            ran = child_processes.run_git(
                repo.path,
                *_CONFIG,
                *("-c", f"gpg.ssh.allowedSignersFile={file.name}"),
                *("log", "--no-show-signature", "--no-walk=unsorted", "--stdin"),
                *("-z", "--format=%H %G? %GS"),
                stdin="\n".join(ids) + "\n",
            )
        if ran.returncode:
            raise StateRepoError(f"git cannot check signatures: {ran.stderr}")
        rows = (row.split(" ", 2) for row in ran.stdout.split("\0") if row)
        states = {id: (state, signer) for id, state, signer in rows}
        for id in ids:
            state, signer = states.get(id, ("", ""))  # %G? and %GS of git
            signature = signatures[id]
            if not signature:
                fault = f"is not signed, but {ALLOWED_SIGNERS} requires a signature"
            elif state == "B":
                fault = "has a signature that does not match its content"
            # git also finds a GPG signature good, by this machine's keyring
            elif state != "G" or not signature.lstrip().startswith(_SSH):
                fault = f"is signed, but not by a key that {ALLOWED_SIGNERS} lists"
            else:
                results[id] = _good[id] = Check(signer)
                continue
            results[id] = Check(fault=fault)
    return results
