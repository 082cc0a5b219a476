"""Read YAML as plain data, with the fast libyaml if it is installed."""

from __future__ import annotations

from typing import Any

import yaml

FAST: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def load(text: str) -> Any:
    return yaml.load(text, Loader=FAST)  # noqa: S506 - derives from SafeLoader
