"""From a generated file that somebody edited by hand to the override that has the same effect.

Pure. What is generated is written anew, so an edit there is lost; an override, which people merge
in ``overrides/``, stays. The one suggested here is meant to be pasted as it is, with a reason.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

from demandops import strict_yaml
from demandops.config.config import Config
from demandops.config.registry import Image
from demandops.errors import InvalidInput
from demandops.plan.release import Bridge, Release, ServiceRelease
from demandops.render.changes.data_diff import ABSENT, leaves, merge_patch
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
_REASON = "Say here why; this stands for an edit of a generated file by hand"


@dataclass(frozen=True, slots=True)
class Suggestion:
    """An override instead of an edit of ``path``.

    ``left`` is what of the edit it does not do, ``also`` the other releases that it fits.
    """

    path: str
    name: str
    text: str
    left: tuple[str, ...] = ()
    also: tuple[str, ...] = ()


@dataclass(slots=True)
class _Effects:
    """What the override would do, and what of the edit is left over."""

    values: dict[str, Any] = field(default_factory=dict)
    version: str = ""
    images: dict[str, dict[str, str]] = field(default_factory=dict)
    replicas: int | None = None
    hold: bool = False
    deny: bool = False
    left: list[str] = field(default_factory=list)

    def data(self) -> dict[str, Any]:
        found = {
            "values": self.values,
            "version": self.version,
            "images": self.images,
            "hold": self.hold,
            "deny": self.deny,
        }
        given = {name: effect for name, effect in found.items() if effect}
        return given if self.replicas is None else given | {"replicas": self.replicas}


def suggest(
    path: str, texts: tuple[str, str | None], release: Release, config: Config, owner: str
) -> Suggestion | None:
    """Return the override for an edit, or nothing where none does any of it.

    Args:
        path: the generated file.
        texts: what it was, and what a person made of it (nothing: it was deleted).
        release: what it was rendered from.
        config: the configuration that it was rendered from.
        owner: who is to be named as the override's owner.
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
            _of_service(old, new, release, config, effects)
        else:
            _of_client(old, new, config, effects)
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
    return Suggestion(path, release.name, text, tuple(effects.left))


def fits_too(release: Release, other: Release) -> bool:
    """Tell whether the override for one release would fit another as well."""
    if not (isinstance(release, ServiceRelease) and isinstance(other, ServiceRelease)):
        return False
    same = (release.key.service, release.node.id) == (other.key.service, other.node.id)
    shared = set(release.applications) & set(other.applications)
    return release.name != other.name and same and bool(shared)


def _selector(release: Release, whole: bool) -> dict[str, list[str]]:
    """Return what selects a release; ``whole``: a connection with both its ends."""
    if isinstance(release, ServiceRelease):
        selected = {"applications": list(release.applications), "services": [release.key.service]}
        return selected if release.key.application else selected | {"nodes": [release.node.id]}
    ids = list(release.connections) if isinstance(release, Bridge) else [release.connection]
    return {"connections": ids} if whole else {"connections": ids, "nodes": [release.node.id]}


def _of_service(
    old: list[Any], new: list[Any], release: ServiceRelease, config: Config, effects: _Effects
) -> None:
    """Read the edit of a HelmRelease or an Application."""
    kind = old[0].get("kind")
    where = _VALUES.get(kind, ())
    done = set()
    was, now = _at(old[0], where), _at(new[0] if new else None, where)
    if isinstance(was, dict) and isinstance(now, dict):
        effects.values = merge_patch(was, now)
        done.add(".".join(where))
        _take_images(effects.values, was, release, config, effects)
        replicas = effects.values.get("replicas")
        if was.get("replicas") == release.replicas and type(replicas) is int and replicas >= 0:
            effects.replicas = effects.values.pop("replicas")
    for path, left, right in leaves(old, new):
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
        if not any(place == one or place.startswith((f"{one}.", f"{one}[")) for one in done):
            effects.left.append(place)
    if effects.hold:  # what is held stays as it is rendered, so nothing else goes with it
        effects.left += [name for name in effects.data() if name != "hold"]
        effects.values, effects.images = {}, {}
        effects.version, effects.replicas = "", None


def _at(document: Any, path: tuple[str, ...]) -> Any:  # noqa: ANN401
    for key in path:
        document = document.get(key) if isinstance(document, dict) else None
    return document


def _take_images(
    patch: dict[str, Any],
    values: dict[str, Any],
    release: ServiceRelease,
    config: Config,
    effects: _Effects,
) -> None:
    """Move what a patch says of the registry's images to the effect that is made for it."""
    names: dict[str, list[str]] = {}
    for name in release.service.images:
        names.setdefault(config.images[name].repository, []).append(name)
    for key in list(patch):
        inner, was = patch[key], values.get(key)
        if not isinstance(inner, dict) or not isinstance(was, dict):
            continue
        known = names.get(str(was.get("repository", "")), [])
        pin = {part: inner[part] for part in _IMAGE_KEYS if inner.get(part)}
        if len(known) == 1 and pin and set(inner) <= set(_IMAGE_KEYS):
            effects.images[known[0]] = {part: str(text) for part, text in pin.items()}
            del patch[key]
        else:
            _take_images(inner, was, release, config, effects)
            if not inner:
                del patch[key]


def _of_client(old: list[Any], new: list[Any], config: Config, effects: _Effects) -> None:
    """Read the edit of plain manifests: their image is all that an override changes there."""
    by_reference = {image.reference(): (name, image) for name, image in config.images.items()}
    for path, left, right in leaves(old, new):
        found = by_reference.get(left) if path.endswith(".image") else None
        pin = _pin(right, found[1]) if found else None
        if found and pin:
            effects.images[found[0]] = pin
        else:
            effects.left.append(_place(path, old))


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


def value_of(value: object) -> str:
    """Return a value of a manifest in few words, for a person."""
    return "nothing" if value is ABSENT else strict_yaml.short_repr(value)
