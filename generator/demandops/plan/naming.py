"""Names of Kubernetes objects and of derived topics.

A name is a function of its own subject only, and two different ids never give one name: where
making an id fit loses something, a hash of the exact id is appended (DNS-1123, at most 53
characters, Helm's limit for a release name).
"""

from __future__ import annotations

import hashlib
import json
import re

MAX_NAME = 53
_HASH = 12

_LABEL = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")
_LOOKS_HASHED = re.compile(rf"(^|.*[-_])[0-9a-f]{{{_HASH}}}")
_TOPIC_PATH = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
_MAX_TOKEN = 120


def digest(*ids: str) -> str:
    """Return the hash that tells ids apart; a list of ids is not the same as their joined text."""
    exact = json.dumps(ids, ensure_ascii=True)
    return hashlib.sha256(exact.encode()).hexdigest()[:_HASH]


def object_name(prefix: str, *ids: str) -> str:
    """Return the name of a Kubernetes object for ``ids``.

    ``od``, ``edge``, ``vehicle00`` gives ``od-edge-vehicle00``. An id is lossy when it is no label,
    or holds a dash beside other ids (``a-b``, ``c`` must not meet ``a``, ``b-c``), or ends like a
    hash of ours; then, as when the name grows too long, the hash is appended.
    """
    plain = "-".join((prefix, *ids)) if prefix else "-".join(ids)
    exact = all(_LABEL.fullmatch(part) for part in ids)
    if len(ids) > 1:
        exact = exact and not any("-" in part for part in ids)
    if exact and len(plain) <= MAX_NAME and not _LOOKS_HASHED.fullmatch(plain):
        return plain
    readable = "-".join(
        (prefix, *(_slug(part) for part in ids)) if prefix else (_slug(part) for part in ids)
    )
    readable = re.sub(r"-{2,}", "-", readable).strip("-")[: MAX_NAME - _HASH - 1].rstrip("-")
    return f"{readable}-{digest(prefix, *ids)}" if readable else digest(prefix, *ids)


def topic_part(id: str, extra: str = "") -> str:
    """Return an id as part of a topic name (``vehicle00``, ``edge/fusion``).

    ``extra`` tells further instances of the same id apart, such as a source's second point cloud;
    it appears as a slug with a hash.
    """
    exact = not extra and len(id) <= _MAX_TOKEN and _TOPIC_PATH.fullmatch(id)
    if exact and not _LOOKS_HASHED.fullmatch(id):
        return id
    words = re.sub(r"[^A-Za-z0-9]+", "_", f"{id}_{extra}" if extra else id).strip("_")[:80]
    words = words.rstrip("_")
    safe = words if words[:1].isalpha() else f"x_{words}" if words else "x"
    return f"{safe}_{digest(id, extra) if extra else digest(id)}"


def ros_name(release: str) -> str:
    """Return a ROS node name for a release: names allow no dash, and ours hold no underscore."""
    return release.replace("-", "_")


def _slug(id: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", id.lower()).strip("-") or "x"
