"""Manual edits to generated files, and overrides that would have the same effect.

The check refuses manual edits, because the generator's next commit would silently undo them. An
override has a lasting effect, so the check suggests one where it can. A person then has to write
only the reason into the suggested override.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from demandops import strict_yaml
from demandops.config.config import Config
from demandops.config.override import OVERRIDES_ROOT
from demandops.config.registry import Image
from demandops.errors import Fault, InvalidInput, fault
from demandops.ledger import claim_file, waiting
from demandops.plan.release import Release, ServiceRelease
from demandops.render.changes.merge_preview import ABSENT, leaf_differences
from demandops.render.gitops.flux import chart_object
from demandops.render.gitops.paths import BOOTSTRAP_ROOT, path_of
from demandops.settings import API_VERSION, GENERATED_ROOTS, NOTES_ROOT, modeline
from demandops.staterepo.git import tree as trees
from demandops.staterepo.pull_request.edited_checkout import Base

_LOST = "is generated, so a manual edit is lost; revert it"
_MOST_LEFT = 5
_VALUES = {
    "HelmRelease": ("spec", "values"),
    "Application": ("spec", "source", "helm", "valuesObject"),
}
_EFFECTS = ("values", "version", "images", "hold", "deny", "replicas")
_IMAGE_KEYS = ("repository", "tag", "digest")
_REFERENCE = re.compile(
    r"(?P<repository>.+?)(?::(?P<tag>[^:/@]+))?(?:@(?P<digest>sha256:[0-9a-f]{64}))?"
)
_REASON = "Say here why you need this override; it replaces a manual edit of a generated file"


@dataclass(frozen=True, slots=True)
class Suggestion:
    """A suggested override that replaces the manual edit of a generated file.

    ``instead_of`` is the path of the edited file. ``file`` is the path of the override, ``text``
    its content. ``not_covered`` lists the parts of the edit that the override leaves out.
    ``other_releases`` lists the other releases to which the override also applies.
    """

    instead_of: str
    file: str
    text: str
    not_covered: tuple[str, ...] = ()
    other_releases: tuple[str, ...] = ()


def is_written_by_generator(path: str) -> bool:
    """Return whether only the generator may write a file."""
    root = path.split("/", maxsplit=1)[0]
    if trees.is_readme(path):
        return False
    if root == claim_file.LEDGER_ROOT:  # people may edit claims and waiting demands
        is_waiting = path.startswith(f"{waiting.WAITING_ROOT}/")
        return claim_file.kind_of(path) is None and not is_waiting
    return root in (*GENERATED_ROOTS, NOTES_ROOT)


def faults_and_suggestions(
    files: Mapping[str, str], base: Base, paths: Collection[str], owner: str
) -> tuple[list[Fault], tuple[Suggestion, ...]]:
    """Return a fault for each edited path, and the suggested overrides.

    An override is suggested where it has the effect of the edit, or of a part of the edit.

    Args:
        files: path → text of the edited checkout.
        base: the commit that the edit started from.
        paths: the paths of the generated files that were edited.
        owner: the person to name as the owner of the overrides; if empty, it is "unknown".
    """
    releases = {path_of(release): release for release in base.releases().values()}
    used = {path for path in files if path.startswith(f"{OVERRIDES_ROOT}/")}
    who = owner.strip()[:100] if owner.isprintable() and owner.strip() else "unknown"
    faults, suggestions = list[Fault](), list[Suggestion]()
    for path in paths:
        before, after = base.files.get(path), files.get(path)
        release, suggestion = releases.get(path), None
        if release is not None and before is not None and base.state is not None:
            effects, not_covered = _effects(before, after, release, base.state.config)
            if effects:
                whole = "deny" in effects
                others = [one.name for one in releases.values() if _fits(release, one, whole=whole)]
                text = _override_text(effects, release, who)
                file = _unused_path(release.name, used)
                suggestion = Suggestion(path, file, text, tuple(not_covered), tuple(sorted(others)))
                suggestions.append(suggestion)
        message = _message(path, before is None, after is None, suggestion)
        faults.append(fault("", message).within(path))
    return faults, tuple(suggestions)


def _unused_path(name: str, used: set[str]) -> str:
    endings = ("", *(f"-{number}" for number in range(2, len(used) + 2)))
    paths = (f"{OVERRIDES_ROOT}/{name}{ending}.yaml" for ending in endings)
    path = next(path for path in paths if path not in used)
    used.add(path)
    return path


def _message(path: str, added: bool, deleted: bool, suggestion: Suggestion | None) -> str:
    if suggestion is not None and deleted:
        return (
            f"{_LOST}; to stop the release, merge {suggestion.file} as shown, or delete its "
            "claims in ledger/"
        )
    if suggestion is not None:
        left = suggestion.not_covered
        listed = ", ".join(left[:_MOST_LEFT]) + (", …" if len(left) > _MOST_LEFT else "")
        unchanged = f" (this override does not change {listed})" if left else ""
        return f"{_LOST}, and merge {suggestion.file} as shown{unchanged}"
    if path.startswith(f"{NOTES_ROOT}/"):
        return "is written by the generator, which would undo the edit; revert the edit"
    if path.startswith(f"{claim_file.LEDGER_ROOT}/"):
        if added:
            return (
                "is not the path of a claim, and people may add only claims and waiting demands to "
                "ledger/; remove the file"
            )
        return "is written only by the generator; revert the edit"
    if path.startswith(f"{BOOTSTRAP_ROOT}/") and added:
        return "is in a generated folder, from which the generator removes other files; delete it"
    if added:
        return (
            "is in a generated folder, from which the generator removes what no demand needs; "
            "delete it, and demand what you need with `demandops request`"
        )
    return f"{_LOST}, and change {_source_of(path)} instead"


def _source_of(path: str) -> str:
    """Return, in words, what to edit instead of a generated file that no override can change."""
    if path.startswith(f"{BOOTSTRAP_ROOT}/"):
        return "demandops.yaml, inventory/ or policy/"
    if "/_charts/" in path:
        return "registry/"
    if path.endswith("/_domain.yaml"):
        return "policy/"
    return "the configuration"


def _effects(
    before: str, after: str | None, release: Release, config: Config
) -> tuple[dict[str, Any], list[str]]:
    """Return the override effects that replace an edit.

    The second value lists the edited fields that these effects do not change.
    """
    if after is None:
        return {"deny": True}, []
    try:
        old, new = list(strict_yaml.load_all(before)), list(strict_yaml.load_all(after))
    except InvalidInput:
        return {}, []
    if isinstance(release, ServiceRelease):
        return _service_effects(old, new, release, config)
    return _client_effects(old, new, config)


def _override_text(effects: dict[str, Any], release: Release, owner: str) -> str:
    head = {"apiVersion": API_VERSION, "kind": "Override", "reason": _REASON, "owner": owner}
    select = {"select": [_selector(release, whole="deny" in effects)]}
    text = strict_yaml.dump(head | select | {name: effects[name] for name in _used(effects)})
    return modeline(f"{OVERRIDES_ROOT}/NAME.yaml", "override") + text


def _fits(release: Release, other: Release, *, whole: bool) -> bool:
    """Return whether the override suggested for ``release`` also applies to ``other``.

    ``whole`` says whether it selects both ends of a connection (:func:`_selector`).
    """
    if not isinstance(release, ServiceRelease) and not isinstance(other, ServiceRelease):
        shared = set(release.connections) & set(other.connections)
        return whole and release.name != other.name and bool(shared)
    if not (isinstance(release, ServiceRelease) and isinstance(other, ServiceRelease)):
        return False
    same = (release.key.service, release.node.id) == (other.key.service, other.node.id)
    shared = set(release.applications) & set(other.applications)
    return release.name != other.name and same and bool(shared)


def _used(effects: dict[str, Any]) -> list[str]:
    return [name for name in _EFFECTS if name in effects]


def _selector(release: Release, whole: bool) -> dict[str, list[str]]:
    """Return the selector of an override for a release.

    If the release is one end of a connection, ``whole`` makes the override select both ends.
    """
    if isinstance(release, ServiceRelease):
        selected = {"applications": list(release.applications), "services": [release.key.service]}
        return selected if release.key.application else selected | {"nodes": [release.node.id]}
    ids = list(release.connections)
    return {"connections": ids} if whole else {"connections": ids, "nodes": [release.node.id]}


def _service_effects(
    old: list[Any], new: list[Any], release: ServiceRelease, config: Config
) -> tuple[dict[str, Any], list[str]]:
    """Return what :func:`_effects` returns for an edit of a service's file.

    The file has a HelmRelease (Flux) or an Application (Argo CD).
    """
    effects, not_covered = dict[str, Any](), list[str]()
    place_of_values = _VALUES.get(old[0].get("kind"), ())
    before, after = (
        _value_at(old[0], place_of_values),
        _value_at(new[0] if new else None, place_of_values),
    )
    patched: tuple[str, ...] = ()
    if isinstance(before, dict) and isinstance(after, dict):
        values = _merge_patch(before, after)
        images = dict[str, dict[str, str]]()
        _move_images(values, before, release, config, images)
        replicas = values.get("replicas")
        if before.get("replicas") == release.replicas and type(replicas) is int and replicas >= 0:
            effects["replicas"] = values.pop("replicas")
        effects |= {
            name: found for name, found in (("values", values), ("images", images)) if found
        }
        path = ".".join(place_of_values)
        patched = (path, f"{path}.", f"{path}[")
    for path, left, right in leaf_differences(old, new):
        place, chart = path.removeprefix("[0]."), release.service.chart
        is_version = str(right).startswith(f"{chart}-") and left == chart_object(
            chart, release.chart
        )
        if place == "spec.chartRef.name" and is_version:
            effects["version"] = str(right).removeprefix(f"{chart}-")
        elif place == "spec.source.targetRevision" and not release.chart.folder:
            effects["version"] = str(right)
        elif place == "spec.suspend" and right is True:
            effects["hold"] = True
        elif not (patched and (place == patched[0] or place.startswith(patched[1:]))):
            not_covered.append(place)
    if "hold" in effects:  # a held file stays as it is, so no other effect applies
        not_covered += [name for name in _used(effects) if name != "hold"]
        effects = {"hold": True}
    return effects, not_covered


def _value_at(document: Any, path: tuple[str, ...]) -> Any:  # noqa: ANN401
    for key in path:
        document = document.get(key) if isinstance(document, dict) else None
    return document


def _move_images(
    patch: dict[str, Any],
    values: dict[str, Any],
    release: ServiceRelease,
    config: Config,
    moved: dict[str, dict[str, str]],
) -> None:
    """Move changes from ``patch`` to ``moved`` if they change an image that the registry lists.

    ``patch`` is a merge patch of ``values``. ``moved`` maps an image's name to the new tag, digest
    or repository.
    """
    names: dict[str, list[str]] = {}
    for name in release.service.images:
        names.setdefault(config.images[name].repository, []).append(name)
    for key in list(patch):
        inner, old = patch[key], values.get(key)
        if not isinstance(inner, dict) or not isinstance(old, dict):
            continue
        images = names.get(str(old.get("repository", "")), [])
        pin = {part: inner[part] for part in _IMAGE_KEYS if inner.get(part)}
        if len(images) == 1 and pin and set(inner) <= set(_IMAGE_KEYS):
            moved[images[0]] = {part: str(text) for part, text in pin.items()}
            del patch[key]
        else:
            _move_images(inner, old, release, config, moved)
            if not inner:
                del patch[key]


def _client_effects(
    old: list[Any], new: list[Any], config: Config
) -> tuple[dict[str, Any], list[str]]:
    """Return what :func:`_effects` returns for an edit of a communication client's file.

    The file has plain manifests. Of the edited fields, only images become effects.
    """
    images, not_covered = dict[str, dict[str, str]](), list[str]()
    by_reference = {image.reference(): (name, image) for name, image in config.images.items()}
    for path, left, right in leaf_differences(old, new):
        known = by_reference.get(left) if path.endswith(".image") else None
        pin = _pin(right, known[1]) if known else None
        place = re.fullmatch(r"\[(\d+)\]\.(.*)", path, re.DOTALL)
        if known and pin:
            images[known[0]] = pin
        elif place is None:
            not_covered.append(path or "the number of documents")
        else:
            not_covered.append(f"{old[int(place[1])].get('kind')} {place[2]}")
    return {"images": images} if images else {}, not_covered


def _pin(reference: object, image: Image) -> dict[str, str] | None:
    match = _REFERENCE.fullmatch(reference) if isinstance(reference, str) else None
    if match is None:
        return None
    pin = {part: match[part] for part in ("tag", "digest") if match[part]}
    if match["repository"] != image.repository:
        pin["repository"] = match["repository"]
    return pin if pin.keys() & {"tag", "digest"} else None


def _merge_patch(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    """Return the JSON merge patch (RFC 7386) that turns ``old`` into ``new``.

    In a patch, None removes a key.
    """
    patch: dict[str, Any] = {key: None for key in old if key not in new}
    for key, value in new.items():
        old_value = old.get(key, ABSENT)
        if isinstance(old_value, dict) and isinstance(value, dict):
            inner = _merge_patch(old_value, value)
            if inner:
                patch[key] = inner
        elif next(leaf_differences(old_value, value), None) is not None:
            patch[key] = value
    return patch
