"""Ids, and the names that are made of them: of objects, files, branches, topics and subjects."""

from __future__ import annotations

import hashlib
import json
import re
import unicodedata
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import TypeAlias

from demandops.base.quoting import is_visible, quoted

# ---- names of Kubernetes objects, files, branches and derived topics ----
#
# A name depends only on the ids that it is made from. If an id must be shortened or changed to fit,
# a hash of the exact id is appended. The hash is short, because people read names. So two ids have
# the same name only if somebody searched for them, and then the second is refused
# (:mod:`.collisions`). Object names follow DNS-1123 and have at most 53 characters, Helm's limit
# for a release name. Topic names are made as the reference makes them, so the ids ``a/b`` and
# ``a-b`` both give ``a_b`` in a topic name.

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

    ``extra`` distinguishes names that are made from the same id; such a name has a hash.
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


# ---- rules for ids, topic names and message types ----

# The maximum length of an id, in characters. A file or an object that is named after a long id has
# a shortened name with a hash.
MAX_ID = 1024

# The maximum length of a topic name, in characters: ROS 2's `RMW_TOPIC_MAX_NAME_LENGTH`
MAX_TOPIC = 247

_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_MESSAGE_TYPE = re.compile(r"[A-Za-z][A-Za-z0-9_]*/msg/[A-Za-z][A-Za-z0-9_]*")
# Unicode's categories of control characters, of halves of characters, and of line separators
_UNSEEN = frozenset({"Cc", "Cs", "Zl", "Zp"})
# characters that change the direction of the text after them
_BIDI = frozenset("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")


def absolute_topic(topic: str) -> str:
    # an empty or private name (`~…`) stays as it is, so that `topic_problem` refuses it
    return topic if topic.startswith(("/", "~")) or not topic else f"/{topic}"


def one_form(text: str) -> str:
    """Return the composed form (Unicode NFC), so that two ways to write ``é`` are one id."""
    return text if text.isascii() else unicodedata.normalize("NFC", text)


def control_character(text: str) -> str:  # the first one, like `U+202E`
    if text.isprintable():  # Python calls no such character printable
        return ""
    for char in text:
        if unicodedata.category(char) in _UNSEEN or char in _BIDI:
            return f"U+{ord(char):04X}"
    return ""


def id_problem(value: str) -> str:
    if not value:
        return "is empty; give an id"
    if len(value) > MAX_ID:
        return f"has {len(value)} characters; at most {MAX_ID} are allowed"
    if ".." in value:
        return f"{quoted(value)} contains '..'; choose an id without it"
    if value != value.strip():
        return f"{quoted(value)} starts or ends with white space; remove it"
    if not is_visible(value):
        char = next(char for char in value if not is_visible(char))
        return (
            f"{quoted(value)} has the invisible character U+{ord(char):04X}; "
            "choose an id without it"
        )
    return ""


def topic_problem(name: str) -> str:
    if not name:
        return "is empty; give a topic name"
    if name.startswith("~"):
        return f"{quoted(name)} is private to a node; give the full name, starting with '/'"
    if not _TOPIC.fullmatch(name):
        return (
            f"{quoted(name)} is not a topic name that ROS 2 allows; begin each part with a single "
            "'/', and write letters, digits and '_' after it, with no digit first"
        )
    if len(name) > MAX_TOPIC:
        return f"has {len(name)} characters; ROS 2 takes at most {MAX_TOPIC}; shorten it"
    return ""


def message_type_problem(name: str) -> str:
    if _MESSAGE_TYPE.fullmatch(name):
        return ""
    return f"{quoted(name)} is not a message type; write it like std_msgs/msg/String"


_LOWER = "lower-case letters, digits"
_ANY = "letters, digits"

# For each regular expression of a field: the texts that match it, in words for messages
PATTERN_WORDS = {
    r"^[a-z0-9]([-a-z0-9]*[a-z0-9])?$": f"{_LOWER} and '-' between them, such as c-its",
    r"^[a-z][a-z0-9_-]*$": f"{_LOWER}, '_' and '-', with a letter first, for example road-station",
    r"^[a-z][a-z0-9]{0,9}$": "up to ten small letters and digits, a letter first, for example od",
    r"^[a-z][a-z0-9_]*$": f"{_LOWER} and '_', with a letter first, for example sensor_msgs",
    r"^[a-z][A-Za-z0-9_]*$": f"{_ANY} and '_', with a small letter first, for example memoryGiB",
    r"^([a-z0-9.-]+/)?[a-z][a-z0-9_.-]*$": "the name of a resource, such as cpu or nvidia.com/gpu",
    r"^[A-Za-z_][A-Za-z0-9_]*$": f"{_ANY} and '_', with no digit first, for example ROS_DOMAIN_ID",
    r"^[A-Za-z0-9_.-]+$": f"{_ANY}, '_', '.' and '-', such as start.launch.py",
    r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$": (
        f"{_ANY}, '_', '.' and '-', but no '.' or '-' first, such as ca.crt"
    ),
    r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,127}$": "the tag of an image, such as v1.2.0",
    r"^[A-Za-z0-9_][A-Za-z0-9_./-]*$": "a frame of /tf, such as map or vehicle01/odom",
    r"^[A-Z]+:[0-9]+$": "the code of a map's coordinates, such as EPSG:25832",
    r"^[A-Z][A-Za-z0-9]*$": "a kind of Kubernetes object, such as ConfigMap",
    r"^([a-z0-9]([a-z0-9.-]*[a-z0-9])?)?$": "the group of an API, such as batch, or nothing",
    r"^[^<>\s][^<>\n]* <[^<>\s]+@[^<>\s]+>$": "a name and an address, like Ann <ann@example.org>",
    r"^values/[A-Za-z0-9_.-]+$": "a file of the folder values/, such as values/service.yaml.j2",
    r"^[A-Za-z0-9_-]+(/[A-Za-z0-9_-]+)*$": (
        f"one or more parts with '/' between them (fleet/one), each of {_ANY}, '_' and '-'"
    ),
    r"^[0-9]+\.[0-9]+\.[0-9]+(-[0-9A-Za-z.-]+)?$": "a version of three numbers, such as 1.2.0",
    r"^[A-Za-z0-9][A-Za-z0-9_./-]*$": "a folder in appdefs/, such as appdefs/mine/charts/one",
    r"^sha256:[0-9a-f]{64}$": "a digest, which is 'sha256:' and 64 digits (0 to 9, a to f)",
    r"^([0-9]+h)?([0-9]+m)?([0-9]+s)?$": "a duration, such as 30s, 1m or 1h30m",
    r"^[^\s,][^\n\r,]*$": "a label on one line, with no comma, and no white space at its start",
    r"^([a-z0-9.-]+/)?[A-Za-z0-9]([A-Za-z0-9_.-]{0,61}[A-Za-z0-9])?$": (
        "the key of a label, such as node_id or example.org/host"
    ),
    r"^([A-Za-z0-9]([A-Za-z0-9_.-]{0,61}[A-Za-z0-9])?)?$": (
        f"the value of a label: up to 63 {_ANY}, '_', '.' and '-', with a letter or digit at both "
        "ends, or nothing"
    ),
    r"^(/([A-Za-z_][A-Za-z0-9_]*|([A-Za-z_][A-Za-z0-9_]*)?\{instance\}[A-Za-z0-9_]*))+$": (
        f"a topic such as /{{instance}}_objects, with '/' before each part; a part has only {_ANY} "
        "and '_', no digit first, and at most one {instance}"
    ),
}


# ---- subjects of claims: an application or a connection, by its exact id ----

# The identity of a topic within its subject. In an application, that is role, topic and source; an
# application without inputs has one empty key. In a connection, that is the topic's name on the
# source node.
TopicKey: TypeAlias = "tuple[str, ...]"


class SubjectKind(Enum):
    # the values are the names of folders in ledger/
    APPLICATION = "applications"
    CONNECTION = "connections"


@dataclass(frozen=True, slots=True)
class Subject:
    kind: SubjectKind
    id: str

    def __str__(self) -> str:
        return f"{self.kind.value[:-1]} '{self.id}'"
