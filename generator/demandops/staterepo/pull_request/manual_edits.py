"""Edits by hand of what the generator writes: which they are, and what would do the same.

What is refused here would be lost with the next commit of the generator, in silence.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

from demandops.config.override import OVERRIDES_ROOT
from demandops.errors import Fault, fault
from demandops.ledger import claim_file as ledger_format
from demandops.plan.release import Release
from demandops.render.changes import merge_preview
from demandops.render.changes.override_suggestion import Suggestion, fits_too, suggest
from demandops.render.gitops.paths import BOOTSTRAP_ROOT, path_of
from demandops.settings import GENERATED_ROOTS, NOTES_ROOT
from demandops.staterepo.git import tree as trees
from demandops.staterepo.pull_request.worktree import Base

_LOST = "is generated, and an edit by hand is lost; take it back"
_MOST_LEFT = 5


def changed_paths(files: Mapping[str, str], before: Mapping[str, str]) -> list[str]:
    """Return the generator's own files that differ from what they were, sorted."""
    return [
        path
        for path in sorted({*files, *before})
        if files.get(path) != before.get(path) and _is_generators(path)
    ]


def _is_generators(path: str) -> bool:
    root = path.split("/", maxsplit=1)[0]
    if trees.is_readme(path):
        return False
    if root == ledger_format.LEDGER_ROOT:  # claims are judged as such
        return ledger_format.kind_of(path) is None
    return root in (*GENERATED_ROOTS, NOTES_ROOT)


def faults_and_suggestions(
    files: Mapping[str, str], base: Base, paths: Collection[str], owner: str
) -> tuple[list[Fault], tuple[Suggestion, ...]]:
    """Return a fault for each edit by hand, and the override that would do what it was to do.

    Args:
        files: the files as edited.
        base: what they were before.
        paths: the generator's files among those that differ.
        owner: who edited them.
    """
    releases = _by_path(base)
    taken = {path for path in files if path.startswith(f"{OVERRIDES_ROOT}/")}
    faults, suggestions = list[Fault](), list[Suggestion]()
    for path in paths:
        before, after = base.files.get(path), files.get(path)
        release, found = releases.get(path), None
        if release is not None and before is not None and base.state is not None:
            who = owner if owner.isprintable() and owner.strip() else "unknown"
            texts = (before, after)
            found = suggest(path, texts, release, base.state.config, who.strip()[:100])
        if found is not None:
            also = sorted(one.name for one in releases.values() if _fits(release, one))
            found = replace(found, name=_free(found.name, taken), also=tuple(also))
            suggestions.append(found)
        message = _message(path, before is None, after is None, found)
        faults.append(fault("", message).within(path))
    return faults, tuple(suggestions)


def _fits(release: Release | None, other: Release) -> bool:
    return release is not None and fits_too(release, other)


def _by_path(base: Base) -> dict[str, Release]:
    if base.state is None:
        return {}
    known = merge_preview.releases_of(base.state.ledger, base.state.config)
    return {path_of(release): release for release in known.values()}


def _free(name: str, taken: set[str]) -> str:
    """Return the path of an override that is not there yet."""
    for number in range(1, len(taken) + 2):
        path = f"{OVERRIDES_ROOT}/{name}{f'-{number}' if number > 1 else ''}.yaml"
        if path not in taken:
            break
    taken.add(path)
    return path


def _message(path: str, added: bool, deleted: bool, found: Suggestion | None) -> str:
    if found is not None and deleted:
        return (
            f"{_LOST}; to have it stopped, merge {found.name} as shown, or delete the claims in "
            "ledger/ that it follows from"
        )
    if found is not None:
        rest = ""
        if found.left:
            more = ", …" if len(found.left) > _MOST_LEFT else ""
            rest = f" (no override changes {', '.join(found.left[:_MOST_LEFT])}{more})"
        return f"{_LOST}, and merge {found.name} as shown{rest}"
    if path.startswith(f"{NOTES_ROOT}/"):
        return "is the generator's own, and written anew by it; take the edit back"
    if path.startswith(f"{ledger_format.LEDGER_ROOT}/") and added:
        return "is no claim's place, and the generator removes it; take it away"
    if added:
        return (
            "is generated, and what no demand asks for is removed; take it away, and demand it: "
            "demandops request"
        )
    return f"{_LOST}, and change {_source_of(path)} that it follows from"


def _source_of(path: str) -> str:
    """Return what a person edits instead of a file that is no release."""
    if path.startswith(f"{BOOTSTRAP_ROOT}/"):
        return "demandops.yaml, inventory/ or policy/access-domains.yaml"
    if "/_charts/" in path:
        return "registry/charts.yaml"
    if path.endswith("/_domain.yaml"):
        return "policy/access-domains.yaml"
    return "the configuration"
