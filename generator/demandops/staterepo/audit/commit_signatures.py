"""Signatures: whether each commit of the generator is signed by an allowed key.

People list the keys in ``policy/allowed-signers`` (ssh-keygen's ALLOWED SIGNERS format). The list
in the commit's parent counts, so that a commit cannot allow its own key. One git process checks
all commits with the same list.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import git
from pygit2 import Repository

from demandops.staterepo.audit.verification import Verdict
from demandops.staterepo.git import tree as trees
from demandops.staterepo.history.commit_log import entry_of

ALLOWED_SIGNERS = "policy/allowed-signers"

_SSH = "-----BEGIN SSH SIGNATURE-----"
_CONFIG = ("-c", "gpg.ssh.program=ssh-keygen", "-c", "gpg.minTrustLevel=undefined")


def with_signatures(repo: Repository, verdicts: Iterable[Verdict]) -> list[Verdict]:
    """Return the verdicts with the check of each commit's signature added."""
    verdicts, signatures = list(verdicts), dict[str, str]()
    lists: dict[str, list[str]] = {}
    for verdict in verdicts:
        commit = trees.commit_of(repo, verdict.commit)
        signatures[verdict.commit] = (commit.gpg_signature[0] or b"").decode("utf-8", "replace")
        allowed = trees.read_text(trees.parent_tree(commit), ALLOWED_SIGNERS)
        if allowed is not None and entry_of(commit).by_generator:
            lists.setdefault(allowed, []).append(verdict.commit)
    checked: dict[str, tuple[str, str]] = {}
    for allowed, commits in lists.items():
        checked |= _check_with_git(repo, allowed, commits)
    return [
        _with_signature(verdict, signatures[verdict.commit], checked.get(verdict.commit))
        for verdict in verdicts
    ]


def _with_signature(verdict: Verdict, signature: str, checked: tuple[str, str] | None) -> Verdict:
    verdict = replace(verdict, signed=bool(signature))
    if checked is None:
        return verdict
    state, signer = checked
    if not signature:
        fault = f"is not signed, but {ALLOWED_SIGNERS} requires it"
    elif state == "B":
        fault = "has a signature of another commit"
    elif state != "G" or not signature.lstrip().startswith(_SSH):
        fault = f"is signed, but not by a key that {ALLOWED_SIGNERS} lists"
    else:
        return replace(verdict, signer=signer)
    return replace(verdict, holds=False, signature=fault)


def _check_with_git(
    repo: Repository, allowed: str, commits: list[str]
) -> dict[str, tuple[str, str]]:
    """Return commit → (git's letter for its signature, the signer)."""
    with tempfile.TemporaryDirectory(prefix="demandops-") as folder, git.Repo(repo.path) as opened:
        file = Path(folder) / "allowed-signers"
        file.write_text(allowed)
        revisions = Path(folder) / "commits"
        revisions.write_text("\n".join(commits) + "\n")
        with revisions.open("rb") as lines:
            output = opened.git.execute(
                [
                    *(opened.git.GIT_PYTHON_GIT_EXECUTABLE, *_CONFIG),
                    *("-c", f"gpg.ssh.allowedSignersFile={file}"),
                    *("log", "--no-show-signature", "--no-walk=unsorted", "--stdin"),
                    "--format=%H %G? %GS",
                ],
                istream=lines,
            )
    rows = (line.split(" ", 2) for line in str(output).splitlines())
    return {row[0]: (row[1], row[2] if len(row) > 2 else "") for row in rows}
