"""The state in effect at a commit, also while some file is not valid.

The generator's commits record it in trailers. ``In-Force`` names the newest commit where all files
were valid. ``Configuration`` names the commit whose configuration is in effect. Each ``Stands-In``
names a file that is in effect in another version, as path and blob. A restart and
``demandops verify`` start from these trailers. They then apply people's later changes with the same
code as a running generator.
"""

from __future__ import annotations

from dataclasses import replace
from urllib.parse import quote, unquote

from pygit2 import Oid, Repository

from demandops.config.config import CONFIG_ROOTS
from demandops.decision import rendered_files
from demandops.errors import Fault, InvalidInput, StateRepoError
from demandops.ledger import claim_file
from demandops.settings import GENERATED_ROOTS
from demandops.staterepo.git import tree as trees
from demandops.staterepo.git.repository import StateRepository
from demandops.staterepo.history import commit_log
from demandops.staterepo.history.commit_log import LogEntry
from demandops.staterepo.load import last_valid_config, quarantine
from demandops.staterepo.load import snapshot as snapshots
from demandops.staterepo.load.last_valid_config import ConfigSource
from demandops.staterepo.load.snapshot import Progress, Snapshot

_NONE = "none"
_ROOTS = (*CONFIG_ROOTS, claim_file.LEDGER_ROOT)


def trailers_of(snapshot: Snapshot) -> list[tuple[str, str]]:
    """Return the trailers; none if all files of the commit are in effect."""
    if not snapshot.problems:
        return []
    source = snapshot.config_source
    return [
        ("In-Force", str(snapshot.last_valid_commit)),
        ("Configuration", str(source.commit)),
        *(
            ("Stands-In", f"{quote(path)} {blob or _NONE}")
            for path, blob in sorted(source.replacements.items())
        ),
    ]


def first_snapshot(repository: StateRepository, progress: Progress) -> Snapshot:
    """Return the state to start from: :func:`start_at` of the newest commit.

    :func:`demandops.staterepo.load.snapshot.advance` then applies what people changed since.
    """
    objects, tip = repository.objects, repository.tip()
    last_valid_config.refuse_other_render_version(trees.commit_of(objects, tip).tree)
    return start_at(objects, tip, progress)


def state_at(
    repo: Repository, revision: str | Oid, progress: Progress = lambda done, total: None
) -> Snapshot:
    """Return the state in effect at any commit: the recorded state with people's later changes.

    Raises InvalidInput or StateRepoError if there never was a valid state.
    """
    commit = trees.commit_of(repo, revision)
    start = start_at(repo, commit.id, progress)
    if start.commit == commit.id:
        return start
    advance = snapshots.advance(repo, start, commit.id)
    judgement = quarantine.judge(repo, advance, start, commit.tree)
    accepted = judgement.with_new_config().snapshot
    try:
        if advance.config_changed:
            rendered_files(accepted.state, trees.texts(commit.tree, GENERATED_ROOTS))
    except InvalidInput as error:
        accepted = judgement.with_old_config(error.faults).snapshot
    return accepted


def start_at(
    repo: Repository, commit: Oid, progress: Progress = lambda done, total: None
) -> Snapshot:
    """Return the newest known state up to a commit: a recorded one, or one without invalid files.

    Raises InvalidInput or StateRepoError if there never was a valid state.
    """
    record = record_at(repo, commit)
    if record.first("In-Force"):
        return recorded_state(repo, record, progress)
    tried, faults = set[tuple[Oid | None, ...]](), list[InvalidInput | StateRepoError]()
    for ancestor in commit_log.first_parents(repo, record.commit):
        content = tuple(trees.entry_id(ancestor.tree, root) for root in _ROOTS)
        if content not in tried:
            tried.add(content)
            try:
                return snapshots.load(repo, ancestor.id, progress)
            except (InvalidInput, StateRepoError) as error:
                faults.append(error)
    raise faults[0]


def record_at(repo: Repository, revision: str | Oid) -> LogEntry:
    """Return the generator's newest commit up to a commit, else that commit itself."""
    commit = trees.commit_of(repo, revision)
    made = commit_log.last_generator_commit(repo, commit.id)
    return commit_log.entry_of(commit if made is None else trees.commit_of(repo, made))


def recorded_state(
    repo: Repository, record: LogEntry, progress: Progress = lambda done, total: None
) -> Snapshot:
    """Return the state in effect at a commit of the generator; raise if the record is not valid."""
    commit = trees.commit_of(repo, record.commit)
    if not record.first("In-Force"):
        return snapshots.load(repo, commit.id, progress)
    last_valid = snapshots.load(repo, record.first("In-Force"), progress)
    source = _source(record)
    advance = snapshots.advance(repo, last_valid, commit.id, source)
    snapshot = quarantine.judge(repo, advance, last_valid, commit.tree).with_new_config().snapshot
    # placeholder: advancing to later commits finds the real problems again
    problems = snapshot.problems or (Fault("invalid", "", "must be checked again"),)
    return replace(snapshot, last_valid_commit=last_valid.commit, problems=problems)


def _source(record: LogEntry) -> ConfigSource:
    commit = record.first("Configuration") or record.first("In-Force")
    replacements: dict[str, Oid | None] = {}
    for line in record.trailers.get("Stands-In", ()):
        path, _, blob = line.rpartition(" ")
        replacements[unquote(path)] = None if blob == _NONE else Oid(hex=blob)
    return ConfigSource(Oid(hex=commit), replacements)
