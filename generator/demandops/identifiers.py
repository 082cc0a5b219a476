"""Rules for ids, topic names and message types, and how messages explain a field's pattern."""

from __future__ import annotations

import re
import unicodedata

from demandops.quoting import is_visible, quoted

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
    """Return a topic name as ROS resolves it in the root namespace: ``scan`` gives ``/scan``."""
    # an empty or private name (`~…`) stays as it is, so that `topic_problem` refuses it
    return topic if topic.startswith(("/", "~")) or not topic else f"/{topic}"


def control_character(text: str) -> str:
    """Return the name of a text's first control character, like ``U+202E``, or an empty text."""
    if text.isprintable():  # Python calls no such character printable
        return ""
    for char in text:
        if unicodedata.category(char) in _UNSEEN or char in _BIDI:
            return f"U+{ord(char):04X}"
    return ""


def id_problem(value: str) -> str:
    """Return what is wrong with an id, or an empty string."""
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
    """Return why ROS 2 (rmw) rejects a fully qualified topic name, or an empty string."""
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
    """Return what is wrong with the name of a ROS 2 message type, or an empty string."""
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
    r"^[a-z0-9./-]+$": f"{_LOWER}, '.', '/' and '-', such as cpu or nvidia.com/gpu",
    r"^([a-z0-9.-]+/)?[a-z][a-z0-9_.-]*$": "the name of a resource, such as cpu or nvidia.com/gpu",
    r"^[A-Za-z_][A-Za-z0-9_]*$": f"{_ANY} and '_', with no digit first, for example ROS_DOMAIN_ID",
    r"^[A-Za-z0-9_.-]+$": f"{_ANY}, '_', '.' and '-', such as start.launch.py",
    r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$": (
        f"{_ANY}, '_', '.' and '-', but no '.' or '-' first, such as ca.crt"
    ),
    r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,127}$": "the tag of an image, such as v1.2.0",
    r"^[A-Z][A-Za-z0-9]*$": "a kind of Kubernetes object, such as ConfigMap",
    r"^([a-z0-9]([a-z0-9.-]*[a-z0-9])?)?$": "the group of an API, such as batch, or nothing",
    r"^https?://\S+$": "a URL that begins with https:// or http://",
    r"^https?://[^\s]+$": "a URL that begins with https:// or http://",
    r"^oci://[^\s]+$": "a URL that begins with oci://",
    r"^values/[A-Za-z0-9_.-]+$": "a file of the folder values/, such as values/service.yaml.j2",
    r"^[A-Za-z0-9]([A-Za-z0-9.:-]*[A-Za-z0-9])?$": "a host name or address, such as 10.0.0.1",
    r"^[A-Za-z0-9_-]+(/[A-Za-z0-9_-]+)*$": (
        f"one or more parts with '/' between them (fleet/one), each of {_ANY}, '_' and '-'"
    ),
    r"^\d+\.\d+\.\d+(-[0-9A-Za-z.-]+)?$": "a version of three numbers, such as 1.2.0",
    r"^[A-Za-z0-9][A-Za-z0-9_./-]*$": "a folder in appdefs/, such as appdefs/mine/charts/one",
    r"^[a-z0-9][a-z0-9._/:-]*$": (
        "the name of an image or a registry in lower case, without a tag, such as "
        "registry.example/detection"
    ),
    r"^sha256:[0-9a-f]{64}$": "a digest, which is 'sha256:' and 64 digits (0 to 9, a to f)",
    r"^\d+(\.\d+)?(m|k|Ki|M|Mi|G|Gi)?$": "a quantity, such as 500m, 2 or 1Gi",
    r"^(tcp|udp|ws)/[^\s/#?]+:\d{1,5}$": "an endpoint of Zenoh, such as tcp/router.example:7447",
    r"^(\d+h)?(\d+m)?(\d+s)?$": "a duration, such as 30s, 1m or 1h30m",
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
