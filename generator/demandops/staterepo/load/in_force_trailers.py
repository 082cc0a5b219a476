"""The trailers that record which configuration is in effect while some file is not valid.

``In-Force`` names the newest commit where all files were valid. ``Configuration`` names the commit
whose configuration is in effect. Each ``Stands-In`` names a file that is in effect in another
version, as path and blob. A restart and ``demandops verify`` read the state in effect from them.
"""

from __future__ import annotations

from dataclasses import replace
from urllib.parse import quote, unquote

from pygit2 import Commit, Oid, Repository

from demandops.config.load import load as load_config
from demandops.decision import State
from demandops.errors import Fault
from demandops.ledger import ended_override_file
from demandops.staterepo.history.commit_log import LogEntry
from demandops.staterepo.load import last_valid_config, quarantine
from demandops.staterepo.load import snapshot as snapshots
from demandops.staterepo.load.last_valid_config import ConfigSource
from demandops.staterepo.load.snapshot import Snapshot

_NONE = "none"


def trailers_of(snapshot: Snapshot) -> list[tuple[str, str]]:
    """Return the trailers; none if all files of the commit are in effect."""
    if not snapshot.problems or snapshot.last_valid_commit is None:
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


def snapshot_at(repo: Repository, commit: Commit, record: LogEntry) -> Snapshot:
    """Return the snapshot that was in effect at a commit.

    Args:
        record: the generator's newest commit up to that one, which has the trailers.

    Raises:
        InvalidInput, StateRepoError: the recorded state is not valid.
    """
    if not record.first("In-Force"):
        return snapshots.load(repo, commit.id)
    last_valid = snapshots.load(repo, record.first("In-Force"))
    source = _source(record)
    advance = snapshots.advance(repo, last_valid, commit.id)
    config = load_config(source.texts(repo))
    config = config.with_ended_overrides(
        ended_override_file.read(last_valid_config.end_markers_at(commit.tree))
    )
    state = State.of(config, advance.snapshot.state.ledger)
    snapshot, _, _ = quarantine.quarantine_invalid(
        repo,
        replace(advance.snapshot, state=state),
        last_valid,
        advance.subjects,
        lambda path: None,
    )
    # placeholder: advancing to later commits finds the real problems again
    problems = snapshot.problems or (Fault("invalid", "", "must be checked again"),)
    return replace(
        snapshot,
        other_config_source=source,
        last_valid_commit=last_valid.commit,
        problems=problems,
    )


def _source(record: LogEntry) -> ConfigSource:
    commit = record.first("Configuration") or record.first("In-Force")
    replacements: dict[str, Oid | None] = {}
    for line in record.trailers.get("Stands-In", ()):
        path, _, blob = line.rpartition(" ")
        replacements[unquote(path)] = None if blob == _NONE else Oid(hex=blob)
    return ConfigSource(Oid(hex=commit), replacements)
