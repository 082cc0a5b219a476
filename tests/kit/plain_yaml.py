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


def beside(test_file: str) -> Any:
    """Return what the YAML file of the same name beside a test's file says."""
    return load(Path(test_file).with_suffix(".yaml").read_text())
