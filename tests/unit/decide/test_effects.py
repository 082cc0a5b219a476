"""What an override does to the pods of a release; a scenario shows what a demand does."""

from __future__ import annotations

from typing import Any

import pytest
from demandops.decide.state import describe_change, planned_releases

from tests.kit.config import override
from tests.kit.goals import put
from tests.kit.memory import MemoryRepo

FUSION = "of-edge-fusion-c9b035cdedb8"


@pytest.mark.parametrize(
    ("changed", "effect"),
    [
        ({"values": {"inputs": {"egoData": ["/other"]}}}, "reconfigures"),
        ({"replicas": 0}, "stops"),
        ({"values": {"inputs": {"egoData": ["/other"]}, "fusion": {"nodeName": "x"}}}, "restarts"),
        ({"images": {"object-fusion": {"tag": "2"}}}, "restarts"),
        ({"hold": True}, ""),
    ],
)
def test_an_override_has_the_effect_of_what_it_changes(
    changed: dict[str, Any], effect: str
) -> None:
    text = override({"services": ["object-fusion"]}, **changed)
    sides = list[tuple[Any, str]]()
    for repo in (MemoryRepo(), MemoryRepo({"overrides/test.yaml": text})):
        repo.send(put("fusion"))
        by_name = {release.name: release for release in planned_releases(repo.state).values()}
        (path,) = (path for path in repo.files if path.endswith(f"/{FUSION}.yaml"))
        sides.append((by_name[FUSION], repo.files[path]))
    (was, current), (now, written) = sides
    assert describe_change(was, now, current, written).effect == effect
