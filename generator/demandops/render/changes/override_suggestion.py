"""The override that has the same effect as a manual edit to a generated file. Pure.

The generator overwrites manual edits to generated files, but an override in ``overrides/`` stays.
A person can use the suggested override unchanged, except for its reason.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

from demandops import strict_yaml
from demandops.config.config import Config
from demandops.config.registry import Image
from demandops.errors import InvalidInput
from demandops.plan.release import Release, ServiceRelease
from demandops.render.changes.data_diff import leaf_differences, merge_patch
from demandops.render.gitops.flux import chart_object
from demandops.settings import API_VERSION

_VALUES = {
    "HelmRelease": ("spec", "values"),
    "Application": ("spec", "source", "helm", "valuesObject"),
}
_IMAGE_KEYS = ("repository", "tag", "digest")
_REFERENCE = re.compile(
    r"(?P<repository>.+?)(?::(?P<tag>[^:/@]+))?(?:@(?P<digest>sha256:[0-9a-f]{64}))?"
)
_REASON = "Say here why; this replaces a manual edit of a generated file"


@dataclass(frozen=True, slots=True)
class Suggestion:
    """An override, to be merged as ``file``, that replaces a manual edit of ``instead_of``.

    ``not_covered`` lists the parts of the edit that the override does not make.
    ``other_releases`` lists other releases that need the same override.
    """

    instead_of: str
    file: str
    text: str
    not_covered: tuple[str, ...] = ()
    other_releases: tuple[str, ...] = ()


@dataclass(slots=True)
class _Effects:
    """The effects of the override, and the parts of the edit that it does not cover."""

    values: dict[str, Any] = field(default_factory=dict)
    version: str = ""
    images: dict[str, dict[str, str]] = field(default_factory=dict)
    replicas: int | None = None
    hold: bool = False
    deny: bool = False
    not_covered: list[str] = field(default_factory=list)

    def data(self) -> dict[str, Any]:
        effects = {
            "values": self.values,
            "version": self.version,
            "images": self.images,
            "hold": self.hold,
            "deny": self.deny,
        }
        used = {name: effect for name, effect in effects.items() if effect}
        return used if self.replicas is None else used | {"replicas": self.replicas}


def suggest_override(
    path: str, texts: tuple[str, str | None], release: Release, config: Config, owner: str
) -> Suggestion | None:
    """Return the override for a manual edit, or ``None`` if no override has a part of its effect.

    Args:
        path: the generated file.
        texts: the file before and after the edit; ``None`` after: it was deleted.
        release: the release that the file was rendered from.
        config: the configuration that the file was rendered from.
        owner: the owner that the override names.
    """
    before, after = texts
    effects = _Effects()
    if after is None:
        effects.deny = True
    else:
        try:
            old, new = list(strict_yaml.load_all(before)), list(strict_yaml.load_all(after))
        except InvalidInput:
            return None
        if isinstance(release, ServiceRelease):
            _read_service_edit(old, new, release, config, effects)
        else:
            _read_client_edit(old, new, config, effects)
    if not effects.data():
        return None
    text = strict_yaml.dump(
        {
            "apiVersion": API_VERSION,
            "kind": "Override",
            "reason": _REASON,
            "owner": owner,
            "select": [_selector(release, whole=effects.deny)],
            **effects.data(),
        }
    )
    return Suggestion(path, release.name, text, tuple(effects.not_covered))


def same_override_fits(release: Release, other: Release) -> bool:
    """Report whether a suggested override for one release fits another release too."""
    if not (isinstance(release, ServiceRelease) and isinstance(other, ServiceRelease)):
        return False
    same = (release.key.service, release.node.id) == (other.key.service, other.node.id)
    shared = set(release.applications) & set(other.applications)
    return release.name != other.name and same and bool(shared)


def _selector(release: Release, whole: bool) -> dict[str, list[str]]:
    """Return the selector of a release; with ``whole``, of both ends of its connection."""
    if isinstance(release, ServiceRelease):
        selected = {"applications": list(release.applications), "services": [release.key.service]}
        return selected if release.key.application else selected | {"nodes": [release.node.id]}
    ids = list(release.connections)
    return {"connections": ids} if whole else {"connections": ids, "nodes": [release.node.id]}


def _read_service_edit(
    old: list[Any], new: list[Any], release: ServiceRelease, config: Config, effects: _Effects
) -> None:
    """Find the effects of an edit of a HelmRelease or an Application."""
    kind = old[0].get("kind")
    values_path = _VALUES.get(kind, ())
    done = set()
    before, after = _at(old[0], values_path), _at(new[0] if new else None, values_path)
    if isinstance(before, dict) and isinstance(after, dict):
        effects.values = merge_patch(before, after)
        done.add(".".join(values_path))
        _move_images(effects.values, before, release, config, effects)
        replicas = effects.values.get("replicas")
        if before.get("replicas") == release.replicas and type(replicas) is int and replicas >= 0:
            effects.replicas = effects.values.pop("replicas")
    for path, left, right in leaf_differences(old, new):
        place = path.removeprefix("[0].")
        if place == "spec.chartRef.name":
            chart = release.service.chart
            if left == chart_object(chart, release.chart) and str(right).startswith(f"{chart}-"):
                effects.version = str(right).removeprefix(f"{chart}-")
                continue
        if place == "spec.source.targetRevision" and not release.chart.folder:
            effects.version = str(right)
            continue
        if place == "spec.suspend" and right is True:
            effects.hold = True
            continue
        if not any(place == path or place.startswith((f"{path}.", f"{path}[")) for path in done):
            effects.not_covered.append(place)
    if effects.hold:  # a hold keeps the file as it was rendered, so it excludes other effects
        effects.not_covered += [name for name in effects.data() if name != "hold"]
        effects.values, effects.images = {}, {}
        effects.version, effects.replicas = "", None


def _at(document: Any, path: tuple[str, ...]) -> Any:  # noqa: ANN401
    for key in path:
        document = document.get(key) if isinstance(document, dict) else None
    return document


def _move_images(
    patch: dict[str, Any],
    values: dict[str, Any],
    release: ServiceRelease,
    config: Config,
    effects: _Effects,
) -> None:
    """Move the changes of registry images from a patch of values to the ``images`` effect."""
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
            effects.images[images[0]] = {part: str(text) for part, text in pin.items()}
            del patch[key]
        else:
            _move_images(inner, old, release, config, effects)
            if not inner:
                del patch[key]


def _read_client_edit(old: list[Any], new: list[Any], config: Config, effects: _Effects) -> None:
    """Find the effects of an edit of plain manifests; an override changes only their image."""
    by_reference = {image.reference(): (name, image) for name, image in config.images.items()}
    for path, left, right in leaf_differences(old, new):
        known = by_reference.get(left) if path.endswith(".image") else None
        pin = _pin(right, known[1]) if known else None
        if known and pin:
            effects.images[known[0]] = pin
        else:
            effects.not_covered.append(_place(path, old))


def _place(path: str, documents: list[Any]) -> str:
    """Return ``Deployment spec.replicas`` for ``[1].spec.replicas``."""
    match = re.fullmatch(r"\[(\d+)\]\.(.*)", path, re.DOTALL)
    if match is None:
        return path or "the number of documents"
    return f"{documents[int(match[1])].get('kind')} {match[2]}"


def _pin(reference: object, image: Image) -> dict[str, str] | None:
    match = _REFERENCE.fullmatch(reference) if isinstance(reference, str) else None
    if match is None:
        return None
    pin = {part: match[part] for part in ("tag", "digest") if match[part]}
    if match["repository"] != image.repository:
        pin["repository"] = match["repository"]
    return pin if pin.keys() & {"tag", "digest"} else None
