"""Forced writes to disk are off in tests, except in tests that are marked ``synced``.

A forced write is an fsync. Without fsync, a power cut can lose data, but a killed process loses
none. The program has no switch for fsync, so the tests replace the functions that it calls.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import pygit2
from demandops.repo.git import tree as _  # noqa: F401 - its import switches libgit2's fsync on

_CALLS: Mapping[str, object] = {name: getattr(os, name) for name in ("fsync", "fdatasync")}


def force(on: bool) -> None:
    """Switch fsync in this process on or off."""
    pygit2.option(pygit2.enums.Option.ENABLE_FSYNC_GITDIR, int(on))
    for name, call in _CALLS.items():
        setattr(os, name, call if on else lambda file: None)


def force_in(repo: Path, on: bool) -> None:
    """Switch git's fsync in a repository on or off."""
    pygit2.Repository(str(repo)).config["core.fsync"] = "committed" if on else "none"
