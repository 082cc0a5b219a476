"""Quarantine: people's changes that cannot be planned are not applied.

A claim that cannot be planned, for example because it names an unknown node, stays in its file. Its
last valid version is in effect (:func:`ledger_files.last_valid_claims`). If the new configuration
is the reason, the old configuration stays in effect.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from pygit2 import Repository, Tree

from demandops.decision import State, changeset_of_edit
from demandops.errors import Fault, InvalidInput
from demandops.ledger import claim_file
from demandops.staterepo.git import tree as trees
from demandops.staterepo.load import ledger_files
from demandops.staterepo.load.snapshot import Advance, Snapshot
from demandops.subject import Subject

Faults = Mapping[Subject, tuple[Fault, ...]]


@dataclass(frozen=True, slots=True)
class Judgement:
    """People's changes, and the faults of subjects with the new and with the old configuration.

    If a subject cannot be planned with either configuration, its claims are at fault. If it cannot
    be planned with the new one only, the new configuration is at fault.
    """

    repo: Repository
    before: Snapshot
    advance: Advance
    with_new: Faults
    with_old: Faults
    old: State
    """The new ledger with the configuration that was in effect before."""

    def with_new_config(self) -> Advance:
        """Return the state in effect, and what changed, if the new configuration is accepted."""
        faults = {
            subject: faults for subject, faults in self.with_new.items() if subject in self.with_old
        }
        return self._without(self.advance, faults)

    def with_old_config(self, faults: Iterable[Fault]) -> Advance:
        """Return the state in effect, and what changed, if the new configuration has ``faults``."""
        accepted = self.with_new_config()
        ledger, problems = accepted.snapshot.state.ledger, accepted.snapshot.problems
        snapshot = replace(
            accepted.snapshot,
            state=replace(self.old, ledger=ledger),
            problems=(*problems, *faults),
            last_valid_commit=self.before.last_valid_commit,
            other_config_source=self.before.config_source,
        )
        return self._without(replace(accepted, snapshot=snapshot), self.with_old)

    def _without(self, accepted: Advance, faults: Faults) -> Advance:
        """Put the last valid claims of faulty subjects in effect."""
        snapshot, before = accepted.snapshot, self.before
        problems, ledger = list(snapshot.problems), snapshot.state.ledger
        quarantined = dict.fromkeys(snapshot.quarantined_files)
        for subject in (subject for subject in accepted.subjects if subject in faults):
            claims = (*before.state.ledger.claims_on(subject), *ledger.claims_on(subject))
            keys = {claim_file.path_of(claim.key): claim.key for claim in claims}
            problems += _located_in_claim_files(faults[subject], snapshot, before, subject)
            last_valid = ledger_files.last_valid_claims(
                self.repo, before.last_valid_commit, snapshot.commit, keys
            )
            for path, key in keys.items():
                ledger = ledger.replace(key, last_valid[path])
            quarantined |= dict.fromkeys(keys)
        snapshot = replace(
            snapshot,
            state=replace(snapshot.state, ledger=ledger),
            problems=tuple(problems),
            last_valid_commit=before.last_valid_commit if problems else snapshot.commit,
            quarantined_files=tuple(quarantined),
        )
        good = tuple(subject for subject in accepted.subjects if subject not in faults)
        return replace(accepted, snapshot=snapshot, subjects=good)


def judge(repo: Repository, advance: Advance, before: Snapshot, tree: Tree) -> Judgement:
    """Return the subjects that people changed since ``before`` and that cannot be planned."""
    state, ledger = advance.snapshot.state, before.state.ledger
    old = replace(before.state, ledger=state.ledger)

    def faults_in(state: State) -> Faults:
        found = {}
        for subject in advance.subjects:
            try:
                changeset_of_edit(
                    state, ledger, [subject], lambda path: trees.read_text(tree, path)
                )
            except InvalidInput as error:
                found[subject] = error.faults
        return found

    with_new = faults_in(state)
    with_old = faults_in(old) if state.config != old.config else with_new
    return Judgement(repo, before, advance, with_new, with_old, old)


def _located_in_claim_files(
    faults: Iterable[Fault], snapshot: Snapshot, before: Snapshot, subject: Subject
) -> list[Fault]:
    """Return faults of a subject, located in the file of a claim that changed."""
    claims = snapshot.state.ledger.claims_on(subject)
    changed = [claim for claim in claims if before.state.ledger.get(claim.key) != claim]
    paths = [claim_file.path_of(claim.key) for claim in (changed or claims)]
    return [fault.within(paths[0]) if paths else fault for fault in faults]
