"""Markers: files of the ledger that record which overrides ended, and when.

The repo alone, not the clock, decides whether an override applies, because a replay and ``verify``
must give the same bytes as the original run. So the generator commits a marker when an override
ends. If a person then writes another end into the override, or removes the end, the override is in
effect again.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from demandops import strict_yaml
from demandops.config.base_model import FrozenModel, parse_file
from demandops.config.override import Override, format_time, parse_time
from demandops.errors import InvalidInput
from demandops.ledger.claim_file import LEDGER_ROOT
from demandops.settings import LEDGER_API_VERSION

MARKERS_ROOT = f"{LEDGER_ROOT}/overrides"


class _Marker(FrozenModel):
    apiVersion: Literal["demandops.ledger/v1", "demandops.ledger/v2"]
    kind: Literal["EndedOverride"]
    override: str
    expires: str


def path_of(name: str) -> str:
    return f"{MARKERS_ROOT}/{name}.yaml"


def text_of(override: Override) -> str:
    assert override.end is not None  # noqa: S101 - only an override with an end ends
    return strict_yaml.dump(
        {
            "apiVersion": LEDGER_API_VERSION,
            "kind": "EndedOverride",
            "override": override.name,
            "expires": format_time(override.end),
        }
    )


def read(files: Mapping[str, str]) -> dict[str, str]:
    """Return a map from the name of each ended override to the end that its marker records. Files
    that are not valid markers are skipped; :func:`stale_markers` lists them for removal.
    """
    ended = {}
    for path, text in files.items():
        name = path.removeprefix(f"{MARKERS_ROOT}/").removesuffix(".yaml")
        try:
            marker = parse_file(_Marker, text, path)
            if marker.override == name and path == path_of(name):
                ended[name] = format_time(parse_time(marker.expires))
        except (InvalidInput, ValueError):
            continue
    return ended


def stale_markers(files: Mapping[str, str], overrides: Mapping[str, Override]) -> list[str]:
    """Return the paths of those markers in ``files`` that no longer apply, sorted."""
    # A marker is stale if it is not valid, its override is gone, or the override's end was changed
    ended = read(files)
    current = {
        path_of(name)
        for name, override in overrides.items()
        if override.end is not None and ended.get(name) == format_time(override.end)
    }
    return sorted({*files} - current)
