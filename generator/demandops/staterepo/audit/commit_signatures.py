"""Checks the signatures of the commits that ``demandops verify`` judges; adds to its verdicts."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from pygit2 import Repository

from demandops.staterepo.audit.verification import Verdict
from demandops.staterepo.git import tree as trees
from demandops.staterepo.history import allowed_signers
from demandops.staterepo.history.commit_log import entry_of


def with_signatures(repo: Repository, verdicts: Iterable[Verdict]) -> list[Verdict]:
    """Return the verdicts; one of a generator's commit fails if it lacks a required signature."""
    pairs = [(verdict, trees.commit_of(repo, verdict.commit)) for verdict in verdicts]
    checks = allowed_signers.checks(
        repo, [commit for _, commit in pairs if entry_of(commit).by_generator]
    )
    signed = []
    for verdict, commit in pairs:
        check = checks.get(verdict.commit, allowed_signers.Check())
        signed.append(
            replace(
                verdict,
                holds=verdict.holds and not check.fault,
                signed=bool(allowed_signers.signature_of(commit)),
                signer=check.signer,
                signature=check.fault,
            )
        )
    return signed
