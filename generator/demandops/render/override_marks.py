"""The comment lines that say which overrides shaped a file, and files that an override holds.

A held file keeps its body byte for byte; only the comment above it may change. What shaped the body
when it was frozen stays named there.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from demandops.config.config import Config
from demandops.config.override import Override, format_time
from demandops.plan.release import Release
from demandops.render.engine import Engine
from demandops.render.gitops import controller
from demandops.render.gitops.paths import CLUSTERS_ROOT

_START = "# override overrides/"
_OF_NOW = frozenset({"hold", "keep"})
"""Effects that are not in a file's body, and so are told as they are even where it is held."""
_TOLD_ANEW = re.compile(rf"{_START}[^:]+: (\w+, )*(hold|keep)(, \w+)*; ")
_CHART = re.compile(rf"{CLUSTERS_ROOT}/[^/]+/[^/]+/_charts/[^/]+\.yaml")


def text_of(release: Release, config: Config, engine: Engine, standing: str | None) -> str:
    """Return the file of a release: rendered, or as it stands where an override holds it.

    Args:
        standing: the file as it is in the state repo, or nothing.

    Raises:
        Refused, InvalidInput: where it cannot be rendered.
    """
    shaping = release.shaping
    if not shaping.held:
        body = controller.render(release, config, engine)
        return _commented([line(one, effects) for one, effects in shaping.by], body)
    now = [line(one, effects) for one, effects in shaping.by if _OF_NOW & {*effects}]
    if standing is None:
        then = [line(one, effects) for one, effects in shaping.by if not _OF_NOW & {*effects}]
        return _commented([*now, *then], controller.render(release, config, engine))
    then, body = split(standing)
    return _commented([*now, *(one for one in then if not _TOLD_ANEW.match(one))], body)


def _commented(lines: list[str], body: str) -> str:
    return "".join(f"{one}\n" for one in lines) + body


def line(override: Override, effects: tuple[str, ...]) -> str:
    """Return the comment line for an override."""
    until = f"until {format_time(override.end)}; " if override.end else ""
    return (
        f"# override {override.path}: {', '.join(effects)}; priority {override.priority}; {until}"
        f"owner {override.owner}; reason: {override.reason}"
    )


def split(text: str) -> tuple[list[str], str]:
    """Return the comment lines above a file's body, and the body."""
    lines = text.splitlines(keepends=True)
    count = 0
    while count < len(lines) and lines[count].startswith(_START):
        count += 1
    return [one.rstrip("\n") for one in lines[:count]], "".join(lines[count:])


def charts_kept(
    files: Mapping[str, str], standing: Mapping[str, str], config: Config
) -> dict[str, str]:
    """Return the chart sources that would go although a held release may still be from them.

    Not those from a folder of this repo: under their old name they would fetch the new chart.
    """
    if not any(override.hold for override in config.active_overrides):
        return {}
    return {
        path: text
        for path, text in standing.items()
        if _CHART.fullmatch(path) and path not in files and "kind: GitRepository" not in text
    }
