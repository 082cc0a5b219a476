"""The state in effect at a commit, even if some files are not valid.

While some files are not valid, the generator's commits record this state in trailers. ``In-Force``
names the newest commit where all files were valid. ``Configuration`` names the commit whose
configuration is in effect. Each ``Stands-In`` names a file that is in effect in another version, as
path and blob. Each ``Held-Back`` names a file of the ledger that is not in effect. A restart and
``demandops verify`` start from these trailers. They then apply people's later changes with the same
code as a running generator.

If a person's change of a claim is refused or cannot be planned, for example because the claim names
an unknown node, the change is quarantined: the generator leaves the file alone, but the file's last
valid version is in effect. If the new configuration is at fault, the old configuration stays in
effect.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain, takewhile
from urllib.parse import quote, unquote

from pygit2 import Blob, GitError, Oid, Repository, Tree

from demandops.base.errors import Fault, InvalidInput, StateRepoError
from demandops.base.naming import Subject
from demandops.base.settings import GENERATED_ROOTS
from demandops.decide.edits import changeset_of_edit, faults_of_edit
from demandops.decide.state import State, rendered_files
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger.ledger import ClaimChange
from demandops.repo.git import tree as trees
from demandops.repo.git.repository import StateRepository
from demandops.repo.history import commit_log
from demandops.repo.history.commit_log import LogEntry
from demandops.repo.load import last_valid_config, ledger_files
from demandops.repo.load import snapshot as snapshots
from demandops.repo.load.last_valid_config import ConfigSource
from demandops.repo.load.snapshot import Advance, Progress, Snapshot

_NONE = "none"
_HELD_BACK = "Held-Back"
# A placeholder for the problems of a recorded state, until the files are checked again.
_TO_CHECK = Fault("invalid", "", "must be checked again")


def trailers_of(snapshot: Snapshot) -> list[tuple[str, str]]:
    if not snapshot.problems:
        return []
    source = snapshot.config_source
    return [
        ("In-Force", str(snapshot.last_valid_commit)),
        ("Configuration", str(source.commit)),
        *(
            # quoted, so that a space in a path does not begin the blob
            ("Stands-In", f"{quote(path)} {blob or _NONE}")
            for path, blob in sorted(source.replacements.items())
        ),
        *((_HELD_BACK, path) for path in sorted(snapshot.quarantined_files)),
    ]


def first_snapshot(repository: StateRepository, progress: Progress) -> Snapshot:
    # the caller then follows people's later changes
    objects, tip = repository.objects, repository.tip()
    last_valid_config.refuse_other_render_version(objects, tip)
    return start_at(objects, tip, progress)


def state_at(
    repo: Repository, revision: str | Oid, progress: Progress = lambda done, total: None
) -> Snapshot:
    # InvalidInput or StateRepoError is raised if there never was a valid state
    commit = trees.commit_of(repo, revision)
    return state_after(repo, start_at(repo, commit.id, progress), commit.id)


def state_after(repo: Repository, start: Snapshot, to: Oid) -> Snapshot:
    if start.commit == to:
        return start
    commit, advance = trees.commit_of(repo, to), snapshots.advance(repo, start, to)
    judgement = judge(repo, advance, start, commit.tree)
    accepted = judgement.with_new_config().snapshot
    try:
        if advance.config_changed:
            rendered_files(
                accepted.state, trees.texts(commit.tree, GENERATED_ROOTS), keeps_late=True
            )
    except InvalidInput as error:
        accepted = judgement.with_old_config(error.faults).snapshot
    return accepted


def start_at(
    repo: Repository, commit: Oid, progress: Progress = lambda done, total: None
) -> Snapshot:
    """Return the state in effect that the generator's newest commit up to ``commit`` records.

    If the record is missing or wrong, return the state of the newest commit with only valid files
    up to the generator's commit or, if there is none, up to ``commit``.
    """
    record = record_at(repo, commit)
    tried, faults = set[tuple[Oid | None, ...]](), list[InvalidInput | StateRepoError]()
    if record.first("In-Force"):
        # the record may be forged, or name commits that people have removed from the history
        with suppress(InvalidInput, StateRepoError):
            return recorded_state(repo, record, progress)
    line = commit_log.first_parents(repo, commit)
    newer = list(takewhile(lambda by_person: str(by_person.id) != record.commit, line))
    for ancestor in chain(commit_log.first_parents(repo, record.commit), newer):
        content = tuple(trees.entry_id(ancestor.tree, root) for root in snapshots.ROOTS)
        if content not in tried:  # most commits change other files, and loading takes time
            tried.add(content)
            try:
                snapshot = snapshots.load(repo, ancestor.id, progress)
                return replace(snapshot, is_rendered=ancestor not in newer)
            except (InvalidInput, StateRepoError) as error:
                faults.append(error)
    raise faults[0]


def snapshot_at(
    repo: Repository, revision: str | Oid, progress: Progress = lambda done, total: None
) -> Snapshot:
    # unlike state_at, this fails if a file is not valid and no generator has quarantined it
    if record_at(repo, revision).first("In-Force"):
        return state_at(repo, revision, progress)
    return snapshots.load(repo, revision, progress)


def record_at(repo: Repository, revision: str | Oid) -> LogEntry:
    """Return the generator's newest commit, else the revision's own commit without trailers."""
    commit = trees.commit_of(repo, revision)
    last = commit_log.last_generator_commit(repo, commit.id)
    if last is None:
        return replace(commit_log.entry_of(commit), trailers={})
    return commit_log.entry_of(trees.commit_of(repo, last))


def recorded_state(
    repo: Repository, record: LogEntry, progress: Progress = lambda done, total: None
) -> Snapshot:
    commit = trees.commit_of(repo, record.commit)
    if not record.first("In-Force"):
        return snapshots.load(repo, commit.id, progress)
    last_valid = snapshots.load(repo, record.first("In-Force"), progress)
    configuration = record.first("Configuration") or record.first("In-Force")
    replacements: dict[str, Oid | None] = {}
    try:
        for line in record.trailers.get("Stands-In", ()):
            path, _, blob = line.rpartition(" ")
            replacements[unquote(path)] = None if blob == _NONE else repo[blob].peel(Blob).id
        source = ConfigSource(Oid(hex=configuration), replacements)
    except (ValueError, KeyError, GitError):
        raise StateRepoError(
            f"commit {record.commit} has unreadable trailers about invalid files; revert it, or "
            "merge valid files"
        ) from None
    advance = snapshots.advance(repo, last_valid, commit.id, source)
    held_back = record.trailers.get(_HELD_BACK, ())
    judgement = judge(repo, advance, last_valid, commit.tree, held_back)
    snapshot = judgement.with_new_config().snapshot
    problems = snapshot.problems or (_TO_CHECK,)
    return replace(snapshot, last_valid_commit=last_valid.commit, problems=problems)


Faults = Mapping[Subject, tuple[Fault, ...]]


@dataclass(frozen=True, slots=True)
class Judgement:
    # of people's changes with the new and with the old configuration, by subject
    repo: Repository
    before: Snapshot
    advance: Advance
    with_new: Faults  # why a subject cannot be planned with the new configuration
    with_old: Faults  # why a subject cannot be planned, or is refused, with the old configuration
    refused: Faults  # why a person's claim on the subject is refused with the new configuration
    old: State  # the configuration that was in effect before, with the new ledger

    def with_new_config(self) -> Advance:
        # with the last valid versions of claims at fault; what has a fault only with the new
        # configuration is not the claims' fault
        faults = {
            subject: faults for subject, faults in self.with_new.items() if subject in self.with_old
        }
        return self._quarantined(self.advance, _merged(faults, self.refused))

    def with_old_config(self, faults: Iterable[Fault]) -> Advance:
        accepted = self.with_new_config()
        ledger, problems = accepted.snapshot.state.ledger, accepted.snapshot.problems
        snapshot = replace(
            accepted.snapshot,
            state=replace(self.old, ledger=ledger),
            problems=(*problems, *faults),
            last_valid_commit=self.before.last_valid_commit,
            other_config_source=self.before.config_source,
        )
        return self._quarantined(replace(accepted, snapshot=snapshot), self.with_old)

    def _quarantined(self, accepted: Advance, faults: Faults) -> Advance:
        snapshot, before = accepted.snapshot, self.before
        problems, ledger = list(snapshot.problems), snapshot.state.ledger
        quarantined = dict.fromkeys(snapshot.quarantined_files)
        for subject in (subject for subject in accepted.subjects if subject in faults):
            claims = (*before.state.ledger.claims_on(subject), *ledger.claims_on(subject))
            keys = {claim_files.path_of(claim.key): claim.key for claim in claims}
            # a fault outside claim files is told at a claim on the subject, best at a changed one
            now = snapshot.state.ledger.claims_on(subject)
            changed = [claim for claim in now if before.state.ledger.get(claim.key) != claim]
            paths = [claim_files.path_of(claim.key) for claim in (changed or now)]
            problems += [
                fault.within(paths[0])
                if paths and claim_files.kind_of(fault.file) is None
                else fault
                for fault in faults[subject]
            ]
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


def judge(
    repo: Repository,
    advance: Advance,
    before: Snapshot,
    tree: Tree,
    held_back: Collection[str] | None = None,
) -> Judgement:
    """Return the judgement of people's changes, from the snapshot ``before`` to ``advance``.

    ``tree`` has the current generated files. ``held_back`` are the claim files that a generator's
    commit records as not in effect; without them, it is decided anew which claims are refused.
    """
    state, ledger = advance.snapshot.state, before.state.ledger
    old = replace(before.state, ledger=state.ledger)

    def faults_in(state: State) -> Faults:
        faults = {}
        for subject in advance.subjects:
            try:
                changeset_of_edit(
                    state, ledger, [subject], lambda path: trees.read_text(tree, path)
                )
            except InvalidInput as error:
                faults[subject] = error.faults
        return faults

    start, commit = before.last_valid_commit, advance.snapshot.commit
    by_people = list[ClaimChange]()
    if held_back is None and advance.subjects:
        by_people = ledger_files.claims_by_people(repo, start, commit, ledger)

    def refused_in(state: State) -> Faults:
        refused: dict[Subject, tuple[Fault, ...]] = {}
        for change in by_people:
            faults = tuple(faults_of_edit(before.state, state, [change]))
            if faults:
                refused[change.key.subject] = (*refused.get(change.key.subject, ()), *faults)
        return refused

    with_new, refused = faults_in(state), refused_in(state)
    if held_back is not None:
        refused = {
            subject: (_TO_CHECK,)
            for subject in advance.subjects
            if any(claim_files.path_of(c.key) in held_back for c in state.ledger.claims_on(subject))
        }
    if state.config == old.config:
        return Judgement(repo, before, advance, with_new, with_new, refused, old)
    with_old = _merged(faults_in(old), refused_in(old))
    return Judgement(repo, before, advance, with_new, with_old, refused, old)


def _merged(one: Faults, other: Faults) -> Faults:
    return {subject: (*one.get(subject, ()), *other.get(subject, ())) for subject in {*one, *other}}
