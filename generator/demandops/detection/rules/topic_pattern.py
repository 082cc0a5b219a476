"""Patterns of topics, such as ``/vehicles/{entity}/pose``: ``{entity}`` stands for any entity."""

from __future__ import annotations

import re

from demandops.identifiers import topic_problem
from demandops.quoting import quoted

ENTITY = "{entity}"
_PART = r"(?P<entity>[A-Za-z0-9_]+)"


def topic_pattern_problem(pattern: str) -> str:
    if pattern.count(ENTITY) > 1:
        return "has {entity} twice; name the entity once"
    example = pattern.replace(ENTITY, "entity")
    return topic_problem(example).replace(quoted(example), quoted(pattern), 1)


def entity_in(pattern: str, topic: str) -> str | None:
    """Return the entity that ``topic`` names; ``None`` if ``topic`` does not match ``pattern``.

    If the topic matches and the pattern has no ``{entity}``, the result is an empty text.
    """
    before, entity, after = pattern.partition(ENTITY)
    if not entity:
        return "" if topic == pattern else None
    matched = re.fullmatch(f"{re.escape(before)}{_PART}{re.escape(after)}", topic)
    return matched["entity"] if matched else None
