"""Overrides that do the same as manual edits of generated files, for values, replicas and images.

The generator's next commit undoes a manual edit, but an override lasts. So the check suggests one
where it can, and a person has to write only the reason into it.
"""

from __future__ import annotations

import re
from typing import Any

from demandops import strict_yaml
from demandops.config.config import Config
from demandops.config.override import OVERRIDES_ROOT
from demandops.errors import InvalidInput
from demandops.plan.release import Release, ServiceRelease
from demandops.render.changes.merge_preview import ABSENT, leaf_differences
from demandops.settings import API_VERSION, modeline

_VALUES = (("spec", "values"), ("spec", "source", "helm", "valuesObject"))  # Flux, Argo CD
_IMAGE_KEYS = {"repository", "tag", "digest"}
_REFERENCE = re.compile(
    r"(?P<repository>.+?)(?::(?P<tag>[^:/@]+))?(?:@(?P<digest>sha256:[0-9a-f]{64}))?"
)
_REASON = "Say here why you need this override; it replaces a manual edit of a generated file"


def override_text(effects: dict[str, Any], release: Release, owner: str) -> str:
    """Return an override with these effects on a release; ``owner`` may be any text."""
    who = owner.strip()[:100] if owner.isprintable() and owner.strip() else "unknown"
    head = {"apiVersion": API_VERSION, "kind": "Override", "reason": _REASON, "owner": who}
    if isinstance(release, ServiceRelease):
        select = {"applications": [*release.applications], "services": [release.key.service]}
    else:
        select = {"connections": [*release.connections]}
    if not (isinstance(release, ServiceRelease) and release.key.application):
        select["nodes"] = [release.node.id]
    text = strict_yaml.dump({**head, "select": [select], **effects})
    return modeline(f"{OVERRIDES_ROOT}/NAME.yaml", "override") + text


def also_applies(release: Release, other: Release) -> bool:
    """Return whether the override of :func:`override_text` also applies to another release."""
    if not (isinstance(release, ServiceRelease) and isinstance(other, ServiceRelease)):
        return False
    same = (release.key.service, release.node.id) == (other.key.service, other.node.id)
    shared = {*release.applications} & {*other.applications}
    return other.name != release.name and same and bool(shared)


def effects_of(
    before: str, after: str, release: Release, config: Config
) -> tuple[dict[str, Any], list[str]]:
    """Return the effects that replace an edit, and the edited fields that they leave out."""
    try:
        old, new = list(strict_yaml.load_all(before)), list(strict_yaml.load_all(after))
    except InvalidInput:
        return {}, []
    values, replicas, pins, left = dict[str, Any](), None, dict[str, dict[str, str]](), list[str]()
    is_service = isinstance(release, ServiceRelease)
    if isinstance(release, ServiceRelease):
        images = [(config.images[name].repository, name) for name in release.images]
        # a repository of two images does not tell which of them an edit means
        repositories = [repository for repository, _ in images]
        names = {repo: name for repo, name in images if repositories.count(repo) == 1}
        for path in _VALUES:
            was, now = _take(old, path), _take(new, path)
            if isinstance(was, dict) and isinstance(now, dict):
                values = _merge_patch(was, now, names, pins)
                count = values.get("replicas")
                if was.get("replicas") == release.replicas and type(count) is int and count >= 0:
                    replicas = values.pop("replicas")
            elif was != now:
                left.append(".".join(path))
    by_reference = {image.reference(): name for name, image in config.images.items()}
    for place, was, now in leaf_differences(old, new):
        index, _, field = place[1:].partition("].")
        is_image = field.endswith(".image") and not is_service and isinstance(now, str)
        name = by_reference.get(str(was)) if is_image else None
        match = _REFERENCE.fullmatch(now) if name else None
        if name and match and (match["tag"] or match["digest"]):
            same = (None, config.images[name].repository)
            pins[name] = {
                part: text for part, text in match.groupdict().items() if text not in same
            }
        elif not index.isdigit():
            left.append(place or "the number of documents")
        else:
            left.append(field if is_service else f"{old[int(index)].get('kind')} {field}")
    effects = {"values": values or None, "images": pins or None, "replicas": replicas}
    return {name: effect for name, effect in effects.items() if effect is not None}, left


def _take(documents: list[Any], path: tuple[str, ...]) -> Any:  # noqa: ANN401
    """Remove what is at a path of the first document, and return it."""
    part = documents[0] if documents else None
    for key in path[:-1]:
        part = part.get(key) if isinstance(part, dict) else None
    return part.pop(path[-1], None) if isinstance(part, dict) else None


def _merge_patch(
    old: dict[str, Any], new: dict[str, Any], names: dict[str, str], pins: dict[str, dict[str, str]]
) -> dict[str, Any]:
    """Return the JSON merge patch (RFC 7386) that turns ``old`` into ``new``.

    Changes of an image whose repository is in ``names`` go to ``pins`` instead.
    """
    patch: dict[str, Any] = {key: None for key in old if key not in new}  # None removes a key
    for key, value in new.items():
        was = old.get(key, ABSENT)
        if isinstance(was, dict) and isinstance(value, dict):
            inner = _merge_patch(was, value, names, pins)
            pin = {part: str(text) for part, text in inner.items() if text}
            name = names.get(str(was.get("repository")))
            if name and pin and inner.keys() <= _IMAGE_KEYS:
                pins[name] = pin
            elif inner:
                patch[key] = inner
        elif next(leaf_differences(was, value), None):
            patch[key] = value
    return patch
