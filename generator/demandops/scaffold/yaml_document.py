"""Files that people edit: how they begin, and their YAML. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from demandops import strict_yaml
from demandops.settings import API_VERSION, modeline


def document(path: str, schema: str, kind: str, fields: Mapping[str, Any], note: str = "") -> str:
    """Return the text of a file with its schema, an optional comment, kind and fields."""
    head = {"apiVersion": API_VERSION, "kind": kind}
    text = strict_yaml.dump({**head, **fields})
    comment = "".join(f"# {line}\n" for line in note.splitlines())
    return modeline(path, schema) + comment + text
