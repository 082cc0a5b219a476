"""Manual edits to generated files, and overrides that would have the same effect.

They are refused because the generator's next commit would silently undo them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

from demandops.config.override import OVERRIDES_ROOT
from demandops.errors import Fault, fault
from demandops.ledger import claim_file
from demandops.plan.release import Release
from demandops.render.changes.override_suggestion import (
    Suggestion,
    same_override_fits,
    suggest_override,
)
from demandops.render.gitops.paths import BOOTSTRAP_ROOT, path_of
from demandops.settings import GENERATED_ROOTS, NOTES_ROOT
from demandops.staterepo.git import tree as trees
from demandops.staterepo.pull_request.worktree import Base

_LOST = "is generated, so a manual edit is lost; revert it"
_MOST_LEFT = 5


def is_written_by_generator(path: str) -> bool:
    """Return whether only the generator may write a file."""
    root = path.split("/", maxsplit=1)[0]
    if trees.is_readme(path):
        return False
    if root == claim_file.LEDGER_ROOT:  # people may edit claims
        return claim_file.kind_of(path) is None
    return root in (*GENERATED_ROOTS, NOTES_ROOT)


def faults_and_suggestions(
    files: Mapping[str, str], base: Base, paths: Collection[str], owner: str
) -> tuple[list[Fault], tuple[Suggestion, ...]]:
    """Return a fault for each manual edit, and an override with the same effect if there is one.

    Args:
        files: the files after the edit.
        base: the files before it.
        paths: the generated files that were edited.
        owner: who edited them.
    """
    releases = {path_of(release): release for release in base.releases().values()}
    used = {path for path in files if path.startswith(f"{OVERRIDES_ROOT}/")}
    faults, suggestions = list[Fault](), list[Suggestion]()
    for path in paths:
        before, after = base.files.get(path), files.get(path)
        release, suggestion = releases.get(path), None
        if release is not None and before is not None and base.state is not None:
            who = owner if owner.isprintable() and owner.strip() else "unknown"
            texts = (before, after)
            suggestion = suggest_override(
                path, texts, release, base.state.config, who.strip()[:100]
            )
        if suggestion is not None:
            also = sorted(one.name for one in releases.values() if _fits(release, one))
            suggestion = replace(
                suggestion, file=_unused_path(suggestion.file, used), other_releases=tuple(also)
            )
            suggestions.append(suggestion)
        message = _message(path, before is None, after is None, suggestion)
        faults.append(fault("", message).within(path))
    return faults, tuple(suggestions)


def _fits(release: Release | None, other: Release) -> bool:
    return release is not None and same_override_fits(release, other)


def _unused_path(name: str, used: set[str]) -> str:
    """Return an unused path for a new override."""
    for number in range(1, len(used) + 2):
        path = f"{OVERRIDES_ROOT}/{name}{f'-{number}' if number > 1 else ''}.yaml"
        if path not in used:
            break
    used.add(path)
    return path


def _message(path: str, added: bool, deleted: bool, suggestion: Suggestion | None) -> str:
    if suggestion is not None and deleted:
        return (
            f"{_LOST}; to stop the release, merge {suggestion.file} as shown, or delete its "
            "claims in ledger/"
        )
    if suggestion is not None:
        unchanged = ""
        if suggestion.not_covered:
            more = ", …" if len(suggestion.not_covered) > _MOST_LEFT else ""
            unchanged = (
                f" (no override changes {', '.join(suggestion.not_covered[:_MOST_LEFT])}{more})"
            )
        return f"{_LOST}, and merge {suggestion.file} as shown{unchanged}"
    if path.startswith(f"{NOTES_ROOT}/"):
        return "is written by the generator, which undoes the edit; revert it"
    if path.startswith(f"{claim_file.LEDGER_ROOT}/") and added:
        return "is not the path of a claim, so the generator removes it; delete it"
    if added:
        return (
            "is in a generated folder, where files without a demand are removed; delete it and use "
            "`demandops request`"
        )
    return f"{_LOST}, and change {_source_of(path)} instead"


def _source_of(path: str) -> str:
    """Return the files to edit instead of a generated file that is not a release."""
    if path.startswith(f"{BOOTSTRAP_ROOT}/"):
        return "demandops.yaml, inventory/ or policy/access-domains.yaml"
    if "/_charts/" in path:
        return "registry/charts.yaml"
    if path.endswith("/_domain.yaml"):
        return "policy/access-domains.yaml"
    return "the configuration"
