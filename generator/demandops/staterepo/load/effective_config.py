"""What the generator goes by while something of people's is not valid, told in its commits.

``In-Force`` names the newest commit where all was valid, ``Configuration`` the one whose
configuration is in force, ``Stands-In`` each file of it that is in force in another version, as
path and blob. So a restart and a proof find again what was in force, without guessing.
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
from demandops.staterepo.load.last_valid_config import Source
from demandops.staterepo.load.snapshot import Snapshot

_NONE = "none"


def trailers(snapshot: Snapshot) -> list[tuple[str, str]]:
    """Return the trailers that say what is in force, where it is not all that stands there."""
    if not snapshot.problems or snapshot.sound is None:
        return []
    source = snapshot.configuration
    return [
        ("In-Force", str(snapshot.sound)),
        ("Configuration", str(source.commit)),
        *(
            ("Stands-In", f"{quote(path)} {blob or _NONE}")
            for path, blob in sorted(source.stand_ins.items())
        ),
    ]


def at(repo: Repository, commit: Commit, told: LogEntry) -> Snapshot:
    """Return what the generator went by at a commit, or goes by since.

    Args:
        told: its own newest commit up to that one.

    Raises:
        InvalidInput, StateRepoError: where something of that is not valid.
    """
    if not told.one("In-Force"):
        return snapshots.load(repo, commit.id)
    sound = snapshots.load(repo, told.one("In-Force"))
    source = _source(told)
    advance = snapshots.advance(repo, sound, commit.id)
    config = load_config(source.texts(repo))
    config = config.with_ended_overrides(
        ended_override_file.read(last_valid_config.markers_at(commit.tree))
    )
    state = State.of(config, advance.snapshot.state.ledger)
    snapshot, _, _ = quarantine.held_back(
        repo,
        replace(advance.snapshot, state=state),
        sound,
        advance.subjects,
        lambda path: None,
    )
    # what is wrong is found anew when the commits behind this one are taken in
    problems = snapshot.problems or (Fault("invalid", "", "is to be looked at again"),)
    return replace(snapshot, source=source, sound=sound.commit, problems=problems)


def _source(told: LogEntry) -> Source:
    commit = told.one("Configuration") or told.one("In-Force")
    stand_ins: dict[str, Oid | None] = {}
    for line in told.trailers.get("Stands-In", ()):
        path, _, blob = line.rpartition(" ")
        stand_ins[unquote(path)] = None if blob == _NONE else Oid(hex=blob)
    return Source(Oid(hex=commit), stand_ins)
