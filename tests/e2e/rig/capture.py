"""Print progress past pytest's capture, because a cold build takes twenty minutes."""

from __future__ import annotations

import sys
from typing import Any

import pytest

from .tools import Report


def uncaptured(config: pytest.Config) -> Report:
    """Return the `report` of a `Rig`: it prints at once, even while pytest captures output."""
    capture: Any = config.pluginmanager.getplugin("capturemanager")

    def say(text: str) -> None:
        if capture is None:  # disabled with -p no:capture
            print(text, file=sys.stderr, flush=True)
            return
        with capture.global_and_fixture_disabled():
            print(text, file=sys.stderr, flush=True)

    return say
