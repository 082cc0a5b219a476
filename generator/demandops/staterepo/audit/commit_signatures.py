"""Checking signatures: is every commit of the generator signed by a key that people listed?

The list is people's, ``policy/allowed-signers`` (ssh-keygen's ALLOWED SIGNERS format), and a commit
is held to what its parent says there: it cannot vouch for itself. Git does the checking, all
commits that go by one list in one process.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import git
from pygit2 import Commit, Repository

from demandops.staterepo.audit.verification import Verdict
from demandops.staterepo.git import tree as trees
from demandops.staterepo.history.commit_log import entry_of

ALLOWED_SIGNERS = "policy/allowed-signers"

_SSH = "-----BEGIN SSH SIGNATURE-----"
_GOOD = "G"
_CONFIG = ("-c", "gpg.ssh.program=ssh-keygen", "-c", "gpg.minTrustLevel=undefined")


def with_signatures(repo: Repository, verdicts: Iterable[Verdict]) -> list[Verdict]:
    """Return the verdicts with what is to be said of each commit's signature."""
    verdicts = list(verdicts)
    lists: dict[str, list[str]] = {}
    armour = {}
    for verdict in verdicts:
        commit = trees.commit_of(repo, verdict.commit)
        armour[verdict.commit] = (commit.gpg_signature[0] or b"").decode("utf-8", "replace")
        allowed = _allowed(commit)
        if allowed is not None and entry_of(commit).by_generator:
            lists.setdefault(allowed, []).append(verdict.commit)
    found: dict[str, tuple[str, str]] = {}
    for allowed, commits in lists.items():
        found |= _check_with_git(repo, allowed, commits)
    return [_with_signature(verdict, armour[verdict.commit], found) for verdict in verdicts]


def _allowed(commit: Commit) -> str | None:
    return trees.read_text(commit.parents[0].tree, ALLOWED_SIGNERS) if commit.parents else None


def _with_signature(verdict: Verdict, armour: str, found: dict[str, tuple[str, str]]) -> Verdict:
    verdict = replace(verdict, signed=bool(armour))
    if verdict.commit not in found:
        return verdict
    state, signer = found[verdict.commit]
    if not armour:
        fault = f"is not signed, and {ALLOWED_SIGNERS} asks for it"
    elif state != _GOOD or not armour.lstrip().startswith(_SSH):
        fault = f"is signed, but not by a key that {ALLOWED_SIGNERS} lists"
        if state == "B":
            fault = "has a signature that is not of this commit"
    else:
        return replace(verdict, signer=signer)
    return replace(verdict, holds=False, signature=fault)


def _check_with_git(
    repo: Repository, allowed: str, commits: list[str]
) -> dict[str, tuple[str, str]]:
    """Return commit → (git's word for its signature, whose it is)."""
    with tempfile.TemporaryDirectory(prefix="demandops-") as folder, git.Repo(repo.path) as opened:
        file = Path(folder) / "allowed-signers"
        file.write_text(allowed)
        asked = Path(folder) / "commits"
        asked.write_text("\n".join(commits) + "\n")
        with asked.open("rb") as lines:
            said = opened.git.execute(
                [
                    *(opened.git.GIT_PYTHON_GIT_EXECUTABLE, *_CONFIG),
                    *("-c", f"gpg.ssh.allowedSignersFile={file}"),
                    *(
                        "log",
                        "--no-show-signature",
                        "--no-walk=unsorted",
                        "--stdin",
                        "--format=%H %G? %GS",
                    ),
                ],
                istream=lines,
            )
    rows = (line.split(" ", 2) for line in str(said).splitlines())
    return {row[0]: (row[1], row[2] if len(row) > 2 else "") for row in rows}
