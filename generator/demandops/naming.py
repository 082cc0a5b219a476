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

MAX_NAME = 53  # Helm's limit for a release name
# 48 bits: a longer hash would only raise the price of a search, and people read names
_HASH = 12

# a name that ends like a hash gets a hash of its own, or another id could be shortened to it
_LOOKS_HASHED = re.compile(rf"(^|.*[-_])[0-9a-f]{{{_HASH}}}")
_LABEL = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")
_TOPIC_TOKEN = re.compile(r"(?=_*[A-Za-z0-9])[A-Za-z_][A-Za-z0-9_]*")
_MAX_TOKEN = 120  # ROS 2 takes 247 characters for a whole topic name, which has further parts

# tests set it lower, so that ids that nobody crafted have the same hash
MOST_DIGITS = 64


def hash_of(exact: str, digits: int) -> str:
    # only a trailer of a forged commit may have half a character
    data = exact.encode(errors="surrogatepass")
    return hashlib.sha256(data).hexdigest()[: min(digits, MOST_DIGITS)]


def slug_with_hash(words: str, exact: str, digits: int) -> str:
    """Return up to 40 characters of ``words``, safe in a path or branch, and a hash."""
    slug = re.sub(r"[^a-z0-9]+", "-", words.lower()).strip("-")[:40].rstrip("-")
    return f"{slug}-{hash_of(exact, digits)}" if slug else hash_of(exact, digits)


def digest(*ids: str) -> str:
    # JSON keeps the ids apart: the lists `a-b, c` and `a, b-c` have different hashes
    return hash_of(json.dumps(ids, ensure_ascii=True), _HASH)


def object_name(prefix: str, *ids: str) -> str:
    """Return the name of a Kubernetes object: ``od``, ``edge``, ``v0`` gives ``od-edge-v0``."""
    head = (prefix,) if prefix else ()
    plain = "-".join((*head, *ids))
    exact = all(_LABEL.fullmatch(part) for part in ids)
    if len(ids) > 1:  # with a dash in an id, other ids could give the same name
        exact = exact and not any("-" in part for part in ids)
    if exact and len(plain) <= MAX_NAME and not _LOOKS_HASHED.fullmatch(plain):
        return plain
    slugs = [re.sub(r"[^a-z0-9]+", "-", part.lower()).strip("-") or "x" for part in ids]
    readable = re.sub(r"-{2,}", "-", "-".join((*head, *slugs))).strip("-")
    readable = readable[: MAX_NAME - _HASH - 1].rstrip("-")
    return f"{readable}-{digest(prefix, *ids)}" if readable else digest(prefix, *ids)


@lru_cache(maxsize=65_536)  # each release asks for the names of all its inputs
def topic_part(id: str, extra: str = "") -> str:
    """Return an id as part of a topic name: ``edge/lane-view`` gives ``edge_lane_view``.

    ``extra`` distinguishes names that are made from the same id, for example for two point clouds
    of one source; such a name has a hash.
    """
    plain = re.sub("[-/]", "_", id)
    # exactly the reference's name, so that subscribers of a fleet that moves over still hear it
    if not extra and len(id) <= _MAX_TOKEN and _TOPIC_TOKEN.fullmatch(plain):
        return plain
    words = re.sub(r"[^A-Za-z0-9]+", "_", f"{id}_{extra}" if extra else id).strip("_")[:80]
    words = words.rstrip("_")
    safe = words if words[:1].isalpha() else f"x_{words}" if words else "x"
    return f"{safe}_{digest(id, extra) if extra else digest(id)}"


def ros_name(release: str) -> str:
    return release.replace("-", "_")  # ROS forbids dashes in the names of nodes
