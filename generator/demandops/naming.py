"""Names of Kubernetes objects, files, branches and derived topics.

A name depends only on the ids that it is made from. If an id must be shortened or changed to fit, a
hash of the exact id is appended. The hash is short, because people read names. So two ids have the
same name only if somebody searched for them, and then the second is refused
(:mod:`demandops.plan.checks.name_clash`). Object names follow DNS-1123 and have at most 53
characters, Helm's limit for a release name. Topic names are made as the reference makes them, so
the ids ``a/b`` and ``a-b`` both give ``a_b`` in a topic name.
"""

from __future__ import annotations

import hashlib
import json
import re
from functools import lru_cache

MAX_NAME = 53
_HASH = 12

_LABEL = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")
_LOOKS_HASHED = re.compile(rf"(^|.*[-_])[0-9a-f]{{{_HASH}}}")
_TOPIC_TOKEN = re.compile(r"(?=_*[A-Za-z0-9])[A-Za-z_][A-Za-z0-9_]*")
_MAX_TOKEN = 120

# tests set it lower, so that ids that nobody crafted have the same hash
MOST_DIGITS = 64


def hash_of(exact: str, digits: int) -> str:
    """Return the first hexadecimal digits of the SHA-256 of a text."""
    # only a trailer of a forged commit may have half a character
    data = exact.encode(errors="surrogatepass")
    return hashlib.sha256(data).hexdigest()[: min(digits, MOST_DIGITS)]


def slug_with_hash(words: str, exact: str, digits: int) -> str:
    """Return up to 40 characters of ``words``, safe in a path or branch, and a hash of ``exact``.

    If ``words`` has no ASCII letter or digit, only the hash is returned.
    """
    slug = re.sub(r"[^a-z0-9]+", "-", words.lower()).strip("-")[:40].rstrip("-")
    return f"{slug}-{hash_of(exact, digits)}" if slug else hash_of(exact, digits)


def digest(*ids: str) -> str:
    """Return a hash of a list of ids; the lists ``a-b, c`` and ``a, b-c`` have different hashes."""
    return hash_of(json.dumps(ids, ensure_ascii=True), _HASH)


def object_name(prefix: str, *ids: str) -> str:
    """Return the name of a Kubernetes object for ``ids``.

    ``od``, ``edge``, ``vehicle00`` gives ``od-edge-vehicle00``. A hash is appended in each of these
    cases: an id is not a valid label; there are several ids and one has a dash, so that other ids
    could give the same name; the name ends like a hash; the name is too long.
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


@lru_cache(maxsize=65_536)
def topic_part(id: str, extra: str = "") -> str:
    """Return an id as part of a topic name: ``edge/lane-view`` gives ``edge_lane_view``.

    If an id gives no valid name in this way, or is long, a hash is appended. ``extra``
    distinguishes names that are made from the same id, for example for two point clouds of one
    source. With ``extra``, the name also contains a slug of ``extra`` and a hash. Results are
    cached, because each release asks for the names of all its inputs.
    """
    plain = re.sub("[-/]", "_", id)
    if not extra and len(id) <= _MAX_TOKEN and _TOPIC_TOKEN.fullmatch(plain):
        return plain
    words = re.sub(r"[^A-Za-z0-9]+", "_", f"{id}_{extra}" if extra else id).strip("_")[:80]
    words = words.rstrip("_")
    safe = words if words[:1].isalpha() else f"x_{words}" if words else "x"
    return f"{safe}_{digest(id, extra) if extra else digest(id)}"


def ros_name(release: str) -> str:
    """Return a ROS node name for a release. ROS forbids dashes in names."""
    return release.replace("-", "_")


def _slug(id: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", id.lower()).strip("-") or "x"
