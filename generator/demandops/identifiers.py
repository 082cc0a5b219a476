"""What ids and topic names may be, wherever they come from: requests, inventory, ledger."""

from __future__ import annotations

import re
import unicodedata

from demandops.errors import quoted

MAX_ID = 1024
"""Characters that an id may have; file and object names are shortened and hashed anyway."""

MAX_TOPIC = 247
"""Characters of a topic name, ``RMW_TOPIC_MAX_NAME_LENGTH`` of ROS 2's rmw."""

_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_MESSAGE_TYPE = re.compile(r"[A-Za-z][A-Za-z0-9_]*/msg/[A-Za-z][A-Za-z0-9_]*")
_UNSEEN = frozenset({"Cc", "Cs", "Zl", "Zp"})
_BIDI = frozenset("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")


def absolute_topic(topic: str) -> str:
    """Return a topic name as ROS resolves it in the root namespace: ``scan`` is ``/scan``."""
    return topic if topic.startswith(("/", "~")) or not topic else f"/{topic}"


def id_problem(value: str) -> str:
    """Return what is wrong with an id, or nothing.

    Ids name entities of the field, so nearly all text is taken; what could hide from a reader or
    climb out of a folder is not.
    """
    if not value:
        return "is empty; give an id"
    if len(value) > MAX_ID:
        return f"has {len(value)} characters; at most {MAX_ID} are taken"
    if ".." in value:
        return f"{quoted(value)} holds '..'; choose an id without it"
    if value != value.strip():
        return f"{quoted(value)} starts or ends with white space; take it away"
    for char in value:
        if unicodedata.category(char) in _UNSEEN or char in _BIDI:
            return (
                f"{quoted(value)} holds the control character U+{ord(char):04X}; "
                "choose an id without it"
            )
    return ""


def topic_problem(name: str) -> str:
    """Return what ROS 2 forbids in a fully qualified topic name (rmw's validation), or nothing."""
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
    """Return why a name is no ROS 2 message type with its package, or nothing."""
    if _MESSAGE_TYPE.fullmatch(name):
        return ""
    return f"{quoted(name)} is no message type; write it like std_msgs/msg/String"
