"""The rules for ids, topic names and message types in requests, inventory and ledger."""

from __future__ import annotations

import re
import unicodedata

from demandops.quoting import is_visible, quoted

MAX_ID = 1024
"""The longest id, in characters; file and object names are shortened and hashed."""

MAX_TOPIC = 247
"""The longest topic name, in characters: ``RMW_TOPIC_MAX_NAME_LENGTH`` of ROS 2's rmw."""

_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_MESSAGE_TYPE = re.compile(r"[A-Za-z][A-Za-z0-9_]*/msg/[A-Za-z][A-Za-z0-9_]*")
_UNSEEN = frozenset({"Cc", "Cs", "Zl", "Zp"})
_BIDI = frozenset("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")


def absolute_topic(topic: str) -> str:
    """Return a topic name as ROS resolves it in the root namespace: ``scan`` gives ``/scan``."""
    return topic if topic.startswith(("/", "~")) or not topic else f"/{topic}"


def control_character(text: str) -> str:
    """Return the first invisible or bidirectional control character as ``U+202E``, or ""."""
    for char in text:
        if unicodedata.category(char) in _UNSEEN or char in _BIDI:
            return f"U+{ord(char):04X}"
    return ""


def id_problem(value: str) -> str:
    """Return the problem of an id, or an empty string.

    Nearly all text is valid. Invisible characters and paths out of a folder are not.
    """
    if not value:
        return "is empty; give an id"
    if len(value) > MAX_ID:
        return f"has {len(value)} characters; at most {MAX_ID} are allowed"
    if ".." in value:
        return f"{quoted(value)} holds '..'; choose an id without it"
    if value != value.strip():
        return f"{quoted(value)} starts or ends with white space; remove it"
    if not is_visible(value):
        char = next(char for char in value if not is_visible(char))
        return (
            f"{quoted(value)} holds U+{ord(char):04X}, which nobody sees; choose an id without it"
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
            f"{quoted(name)} is not a topic name that ROS 2 allows; use letters, digits and '_' "
            "between single '/', no part starting with a digit"
        )
    if len(name) > MAX_TOPIC:
        return f"has {len(name)} characters; ROS 2 takes at most {MAX_TOPIC}"
    return ""


def message_type_problem(name: str) -> str:
    """Return why a name is not a ROS 2 message type with its package, or an empty string."""
    if _MESSAGE_TYPE.fullmatch(name):
        return ""
    return f"{quoted(name)} is not a message type; write it like std_msgs/msg/String"
