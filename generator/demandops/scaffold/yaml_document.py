"""The text of YAML files that people edit. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from demandops import strict_yaml
from demandops.settings import API_VERSION, modeline


def document(path: str, schema: str, kind: str, fields: Mapping[str, Any], note: str = "") -> str:
    """Return the text of a file for people to edit.

    Args:
        path: the path of the file in the state repo.
        schema: the name of the JSON Schema with which editors check the file.
        kind: the value of the field ``kind``.
        fields: the other fields.
        note: lines of a comment at the start of the file.
    """
    head = {"apiVersion": API_VERSION, "kind": kind}
    text = strict_yaml.dump({**head, **fields})
    comment = "".join(f"# {line}\n" for line in note.splitlines())
    return modeline(path, schema) + comment + text
