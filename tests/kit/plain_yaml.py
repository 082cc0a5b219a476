"""YAML as plain data, by libyaml where it is there: tests read much of it."""

from __future__ import annotations

from typing import Any

import yaml

FAST: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def load(text: str) -> Any:
    """Return the data of the one document in a text."""
    return yaml.load(text, Loader=FAST)  # noqa: S506 - derives from SafeLoader
