"""Read and write YAML as plain data, with the fast libyaml if it is installed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

FAST: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_DUMPER: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


def load(text: str) -> Any:
    return yaml.load(text, Loader=FAST)  # noqa: S506 - derives from SafeLoader


def dump(data: Any) -> str:
    return str(yaml.dump(data, Dumper=_DUMPER))


def beside(test_file: str, name: str = "") -> Any:
    """Return what a YAML file beside a test's file says, by default that of the same name."""
    return load(Path(test_file).with_name(f"{name or Path(test_file).stem}.yaml").read_text())
