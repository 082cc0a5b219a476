"""The order of versions, and the check of all that are listed; ``tests/scenarios`` has the rest."""

from __future__ import annotations

import json

import pytest
from demandops.base.errors import InvalidInput
from demandops.decide.state import try_configuration
from demandops.model.config.registry import precedence

from tests.kit.config import skeleton
from tests.kit.memory import MemoryRepo


def test_the_order_of_versions_is_that_of_semantic_versioning() -> None:
    before = "1.0.0-1 1.0.0-2 1.0.0-10 1.0.0-a 1.0.0-a.1 1.0.0-a.b 1.0.0-b"
    listed = f"{before} 1.0.0 1.0.2 1.0.10 1.2.0 2.0.0".split()
    shuffled = sorted(listed)
    assert shuffled != listed
    assert sorted(shuffled, key=precedence) == listed


def test_each_listed_version_is_rendered_before_anybody_asks_for_it() -> None:
    folder = "appdefs/object-detection-fusion/charts/next"
    next = f"    channels: {{next: {{folder: {folder}, version: 9.0.0}}}}\n"
    chart = {
        f"{folder}/Chart.yaml": "apiVersion: v2\nname: object-fusion\nversion: 9.0.0\n",
        f"{folder}/values.schema.json": json.dumps({"required": ["missing"]}),
        "registry/charts.yaml": skeleton()["registry/charts.yaml"] + next,
    }
    pinned = {"1.0.0": {}, "3.0.0": {"charts": {"object-fusion": "9.0.0"}}}
    versions = {"apiVersion": "demandops/v1", "kind": "Versions"}
    versions |= {
        "applications": {"object-detection-fusion": {"default": "1.0.0", "versions": pinned}}
    }
    files = chart | {"registry/versions.yaml": json.dumps(versions)}
    with pytest.raises(InvalidInput) as invalid:
        try_configuration(MemoryRepo(files).state)
    (found,) = invalid.value.faults
    assert found.file == "appdefs/object-detection-fusion/values/object-fusion.yaml.j2"
    assert '"missing" is a required property' in found.message
