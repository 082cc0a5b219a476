"""Mistakes that people make in the configuration of a state repo.

``config-mistakes.yaml`` lists them, and ``tests/unit/messages`` has the message for each.
``test_mistakes_anywhere`` tries every mistake that a JSON schema can find.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from demandops.base.errors import Fault, InvalidInput
from demandops.model.config.load import load

from tests.kit import plain_yaml
from tests.kit.config import configuration, skeleton

ROOT, NODES = "demandops.yaml", "inventory/nodes.yaml"
APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
Files = Mapping[str, str | None]

_LISTED = plain_yaml.beside(__file__, "config-mistakes")
_EXAMPLES = Path(__file__).parents[3] / "examples"
_OF_A_CLUSTER = {
    "appdefs/map-server/service.yaml": (_EXAMPLES / "map-server" / "service.yaml").read_text()
}
_BASES: Mapping[str, Mapping[str, Any]] = {
    **_LISTED["bases"],
    "a service for a cluster": _OF_A_CLUSTER | _LISTED["bases"]["a service for a cluster"],
    "Argo CD": {ROOT: skeleton("argocd")[ROOT]},
    "a second definition": {
        path.replace("object-detection-fusion/", "copy/", 1): text
        for path, text in skeleton().items()
        if path.startswith("appdefs/object-detection-fusion/") and "/charts/" not in path
    },
}


def changed(mistake: Mapping[str, Any]) -> dict[str, str | None]:
    """Return the files that differ from the skeleton."""
    files: dict[str, str | None] = {}
    for layer in (_BASES.get(mistake.get("base", ""), {}), mistake):
        for path, change in layer.items():
            if path == "scaling":
                scaling = {"prefix: of": f"…\n    scaling: {json.dumps(change)}"}
                files[APPDEF] = _edited(files.get(APPDEF) or skeleton()[APPDEF], scaling)
            elif isinstance(change, dict):
                files[path] = _edited(files.get(path) or skeleton()[path], change)
            elif path != "base":
                files[path] = change
    return files


def _edited(text: str, edits: Mapping[str, str]) -> str:
    for old, new in edits.items():
        assert old in text
        text = text.replace(old, new.replace("…", old), 1)
    return text


MISTAKES: Mapping[str, Files] = {
    name: changed(mistake) for name, mistake in _LISTED["mistakes"].items()
}


def refused(changed: Files) -> tuple[Fault, ...]:
    """Return the faults of a configuration that must be refused."""
    with pytest.raises(InvalidInput) as invalid:
        load(configuration(changed))
    return invalid.value.faults


NEEDED = [
    *(ROOT, NODES, "policy/access-domains.yaml", "registry/charts.yaml", "registry/images.yaml"),
    *("inventory/clusters.yaml", "inventory/brokers.yaml"),
]


@pytest.mark.parametrize("content", [None, "", "- a\n", "a: [\n"])
def test_a_file_of_no_use_is_one_fault(content: str | None) -> None:
    for path in NEEDED:
        (found,) = refused({path: content})
        assert found.file == path


@pytest.mark.parametrize("name", _LISTED["valid"])
def test_an_odd_but_valid_configuration_loads(name: str) -> None:
    load(configuration(changed(_LISTED["valid"][name])))
