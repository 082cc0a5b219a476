"""The file of a release: comment lines that name the overrides, then the rendered body.

A ``hold`` override keeps the body of a file byte for byte. Only the comments above the body may
change. These comments still name the overrides that shaped the body when the hold started.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import dropwhile

from demandops.model.config.config import Config
from demandops.model.config.override import Override, format_time
from demandops.model.ledger.ledger import World
from demandops.model.release import Release
from demandops.render import manifests
from demandops.render.gitops import CLUSTERS_ROOT
from demandops.templating.values import Evaluate

_START = "# override overrides/"
# these effects change only a release's comments, which are updated even in a held file
_OUTSIDE_BODY = frozenset({"hold", "keep"})
_UPDATED_COMMENT = re.compile(rf"{_START}[^:]+: (\w+, )*(hold|keep)(, \w+)*; ")
_CHART = re.compile(rf"{CLUSTERS_ROOT}/[^/]+/[^/]+/_charts/[^/]+\.yaml")


def release_text(release: Release, config: Config, evaluate: Evaluate, current: str | None) -> str:
    shaping = release.shaping
    if not shaping.held:
        comments = [override_comment(override, effects) for override, effects in shaping.by]
        return _join(comments, manifests.render(release, config, evaluate))
    outside, of_body = list[str](), list[str]()
    for override, effects in shaping.by:
        comments = outside if _OUTSIDE_BODY & {*effects} else of_body
        comments.append(override_comment(override, effects))
    if current is None:
        return _join([*outside, *of_body], manifests.render(release, config, evaluate))
    lines = current.splitlines(keepends=True)
    body = list(dropwhile(lambda line: line.startswith(_START), lines))
    # overrides that shaped the body when the hold started may have ended, so their comments stay
    above = (line.rstrip("\n") for line in lines[: len(lines) - len(body)])
    frozen = [comment for comment in above if not _UPDATED_COMMENT.match(comment)]
    return _join([*outside, *frozen], "".join(body))


def _join(comments: list[str], body: str) -> str:
    return "".join(f"{comment}\n" for comment in comments) + body


def override_comment(override: Override, effects: tuple[str, ...]) -> str:
    until = f"until {format_time(override.end)}; " if override.end else ""
    return (
        f"# override {override.path}: {', '.join(effects)}; priority {override.priority}; {until}"
        f"owner {override.owner}; reason: {override.reason}"
    )


def kept_charts(
    files: Mapping[str, str], current: Mapping[str, str], world: World
) -> dict[str, str]:
    """Return the chart sources in ``current`` that stay for releases that are held."""
    if not any(override.hold for override in world.overrides):
        return {}
    # not that of a chart in a folder of the state repo: it would fetch the folder's newest version
    return {
        path: text
        for path, text in current.items()
        if _CHART.fullmatch(path) and path not in files and "kind: GitRepository" not in text
    }
