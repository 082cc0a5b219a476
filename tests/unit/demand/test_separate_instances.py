"""With ``versions: separate``, each version except the default runs in an instance of its own.

``tests/scenarios`` has stories of it.
"""

from __future__ import annotations

from collections import Counter
from functools import lru_cache
from random import Random
from typing import Any

from demandops.decide.state import rendered_files
from demandops.model.release import ServiceRelease
from hypothesis import given

from tests.kit.chance import chances, examples
from tests.kit.memory import MemoryRepo, ledger_in
from tests.unit.demand.test_versions_on_demand import (
    CHANNELS,
    DEFAULT,
    LISTED,
    config,
    put,
    release,
)

VERSIONS = ("", *LISTED, *CHANNELS)


@lru_cache(maxsize=1)
def empty() -> MemoryRepo:
    return MemoryRepo(config("separate"))


def separate_version(version: str) -> str:
    """Return the version of the separate instance that serves a demand for ``version``.

    The result is empty if the application's default version serves the demand.
    """
    version = CHANNELS.get(version, version or DEFAULT)
    return "" if version == DEFAULT else version


def planned(repo: MemoryRepo) -> list[ServiceRelease]:
    return [one for one in repo.state.plans.values() if isinstance(one, ServiceRelease)]


@given(chances)
@examples(20)
def test_each_version_has_its_services_topics_and_end(random: Random) -> None:
    repo, held = empty().copy(), dict[str, dict[str, Any]]()
    for _ in range(8):
        name = random.choice("abcd")
        if name in held and random.random() < 0.4:
            repo.send(release(name))
            del held[name]
        else:
            id, cloud = random.choice(("edge/a", "edge/b")), random.choice(("/p", "/q"))
            held[name] = put(name, random.choice(VERSIONS), id, cloud)
            repo.send(held[name])
        assert ledger_in(repo.files) == repo.state.ledger
        again = rendered_files(repo.state)
        assert {path: repo.files[path] for path in again} == again
        wanted = Counter[tuple[str, str]]()
        for made in held.values():
            (app,) = made["applications"]
            version = separate_version(app.get("version", ""))
            wanted[app["id"] + (f"@{version}" if version else ""), version or DEFAULT] += 1
        assert {(id, one.version.name) for one in planned(repo) for id in one.applications} == {
            *wanted
        }
        made_topics = Counter(topic for one in planned(repo) for topic in one.outputs.values())
        assert set(made_topics.values()) <= {1}, "no topic is published twice"
        for one in planned(repo):
            if one.key.service == "object-fusion":
                read = {topic.topic for topic in one.inputs["object_list"]}
                detections = [
                    other
                    for other in planned(repo)
                    if other.key.service == "object-detection"
                    and {*one.applications} <= {*other.applications}
                ]
                assert read == {topic for other in detections for topic in other.outputs.values()}
                assert {other.version.name for other in detections} == {one.version.name}
    other = empty().copy()
    for made in random.sample([*held.values()], len(held)):
        other.send(made)
    assert {p for p in repo.rendered() if p.startswith("clusters/")} == {
        p for p in other.rendered() if p.startswith("clusters/")
    }
    for name in held:
        repo.send(release(name))
    assert repo.files == empty().files
