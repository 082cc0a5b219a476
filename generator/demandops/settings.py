"""Constants of the program and where its own files are.

Known to every stage; knows none. Versions stand here because files carry them: a state repo
written by a newer generator is refused by its number, never guessed at.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Final

API_VERSION: Final = "demandops/v1"
"""``apiVersion`` of every file that people write."""

LEDGER_API_VERSION = "demandops.ledger/v1"
"""``apiVersion`` of every claim file."""

RENDER_VERSION = 1
"""Raised whenever the same ledger and configuration would give other bytes than before."""

MAIN_BRANCH = "main"
"""The branch that Flux and Argo CD read and the generator writes."""

DEFAULT_ACTION_NAME = "/event_detector_operator_plugin/operator_plugin/deployment_request"
"""Where the reference's clients send their goals (robotkube's event detector)."""

DEFAULT_DEMAND_ACTION_NAME = "/demandops/demand"
"""Where our own clients send theirs."""

QUEUE_LIMIT = 10_000
"""Demands that may wait at once; beyond it a new one is rejected rather than kept in memory."""

GENERATED_ROOTS = ("bootstrap", "clusters")
"""The top-level folders whose every file follows from ledger and configuration."""

NOTES_ROOT = ".demandops"
"""The top-level folder of what the generator tells people by files; nothing is read back from it
that a decision depends on."""

_PACKAGE = Path(__file__).parent
_CHECKOUT = _PACKAGE.parents[1]


def data_folder(name: str) -> Path:
    """Return the folder of packaged data: ``templates``, ``appdefs`` or ``skeleton``.

    In an installed wheel the folders lie inside the package; in a checkout or an editable
    install they are the repository's own top-level folders.
    """
    packaged = _PACKAGE / "_data" / name
    if packaged.is_dir():
        return packaged
    return _CHECKOUT / {"skeleton": "state-repo-skeleton"}.get(name, name)


def forge_token_file() -> Path | None:
    """Return the file with the token for the forge, as ``DEMANDOPS_FORGE_TOKEN_FILE`` names it."""
    named = os.environ.get("DEMANDOPS_FORGE_TOKEN_FILE")
    return Path(named).expanduser() if named else None


def data_home(state_repo: str) -> Path:
    """Return where the generator keeps its outbox and clone for one state repo.

    ``DEMANDOPS_DATA_HOME`` wins, else ``$XDG_STATE_HOME/demandops``; below it one folder for each
    state repo, named by a digest of its address (which may hold a password, so it is not shown).
    """
    if Path(state_repo).exists():  # however the folder is written, it is one
        state_repo = str(Path(state_repo).resolve())
    root = os.environ.get("DEMANDOPS_DATA_HOME")
    if root:
        base = Path(root)
    else:
        state = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
        base = Path(state) / "demandops"
    return base / hashlib.sha256(state_repo.encode()).hexdigest()[:16]
