"""The text of YAML files that people edit. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from demandops import strict_yaml
from demandops.settings import API_VERSION, modeline


def document(path: str, schema: str, kind: str, fields: Mapping[str, Any], note: str = "") -> str:
    """Return the text of a file for people to edit.

    ``schema`` names the JSON Schema with which editors check the file; ``note`` becomes a comment
    at its start.
    """
    text = strict_yaml.dump({"apiVersion": API_VERSION, "kind": kind, **fields})
    comment = "".join(f"# {line}\n" for line in note.splitlines())
    return modeline(path, schema) + comment + text
