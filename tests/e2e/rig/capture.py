"""Print past pytest's capture: a cold build takes twenty minutes and must not look stuck."""

from __future__ import annotations

import sys
from typing import Any

import pytest

from .tools import Report


def uncaptured(config: pytest.Config) -> Report:
    """A `report` for `Rig` that a person sees at once, whatever pytest captures."""
    capture: Any = config.pluginmanager.getplugin("capturemanager")

    def say(text: str) -> None:
        if capture is None:  # switched off with -p no:capture
            print(text, file=sys.stderr, flush=True)
            return
        with capture.global_and_fixture_disabled():
            print(text, file=sys.stderr, flush=True)

    return say
