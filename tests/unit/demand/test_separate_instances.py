"""With ``versions: separate``, each version except the default runs in an instance of its own."""

from __future__ import annotations

from collections import Counter
from functools import lru_cache
from random import Random
from typing import Any

import pytest
import yaml
from demandops.base.errors import InvalidInput
from demandops.decide.state import rendered_files
from demandops.model.release import ServiceRelease
from hypothesis import given

from tests.appdefs.test_recorder import ADDITIONS
from tests.kit.chance import chances, examples
from tests.kit.config import edited, state_of
from tests.kit.memory import MemoryRepo, ledger_in
from tests.unit.demand.test_versions_on_demand import (
    CHANNELS,
    DEFAULT,
    LISTED,
    config,
    put,
    release,
)

SEPARATE = config("separate")
VERSIONS = ("", *LISTED, *CHANNELS)


@lru_cache(maxsize=1)
def empty() -> MemoryRepo:
    return MemoryRepo(SEPARATE)


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


def test_the_receipt_says_so_and_a_put_moves_it() -> None:
    repo = MemoryRepo(SEPARATE)
    repo.send(put("a"))
    assert repo.send(put("b", "testing")).warnings == (
        "application 'edge/a' in version 1.1.0 runs separately, as 'edge/a@1.1.0'",
    )
    assert {id for one in planned(repo) for id in one.applications} == {"edge/a", "edge/a@1.1.0"}
    assert repo.send(put("b", "testing")).outcome == "unchanged"
    moved = repo.send(put("b", "stable"))
    assert {change.change for change in moved.releases} == {"stop"}
    assert {id for one in planned(repo) for id in one.applications} == {"edge/a"}


def test_a_channel_moved_off_the_default_version_changes_nothing_that_runs() -> None:
    """At first, ``stable`` names the default version, so both demands share an application."""
    repo = MemoryRepo(SEPARATE)
    repo.send(put("a"))
    repo.send(put("b", "stable"))
    moved = config("separate", channels=CHANNELS | {"stable": "2.0.0"})
    state = state_of(MemoryRepo(moved).config, repo.state.ledger)
    assert rendered_files(state) == rendered_files(repo.state)
    again = MemoryRepo(moved)
    again.send(put("a"))
    again.send(put("b", "stable"))
    assert {id for one in planned(again) for id in one.applications} == {"edge/a", "edge/a@2.0.0"}


def test_outputs_of_both_are_delivered_by_topics_of_their_own() -> None:
    repo = MemoryRepo(SEPARATE)
    for name, version in (("a", ""), ("b", "1.1.0")):
        made = put(name, version)
        (app,) = made["applications"]
        app["inputs"]["point_cloud"][0] |= {"source": "vehicle00"}
        app["deliver"] = [{"output": "object-fusion.fused_objects", "node": "vehicle01"}]
        assert not [w for w in repo.send(made).warnings if "carries" in w]
    connections = repo.books()["connections"]
    assert {id: len(one["topics"]) for id, one in connections.items()} == {
        "derived/vehicle00/edge": 1,
        "derived/edge/vehicle01": 2,
    }
    repo.send(release("b"))
    assert [len(one["topics"]) for one in repo.books()["connections"].values()] == [1, 1]


def test_one_topic_for_both_is_refused() -> None:
    """Both deliveries name the same topic, and only one of the two instances can publish on it."""
    repo = MemoryRepo(SEPARATE)
    delivery = {"output": "object-fusion.fused_objects", "node": "vehicle01", "topic": "/it"}
    for name, version in (("a", ""), ("b", "1.1.0")):
        made = put(name, version)
        made["applications"][0]["deliver"] = [delivery]
        if name == "a":
            repo.send(made)
    assert repo.faults(made) == [
        "applications[0].deliver[0].topic: connection 'derived/edge/vehicle01' already "
        "brings /edge_a_global_objectlist to 'vehicle01' as /it; choose another topic for this "
        "delivery"
    ]


@pytest.mark.parametrize(
    ("id", "version", "problem"),
    [
        (
            "edge/a@1.1.0",
            "",
            "applications[0].id: 'edge/a@1.1.0' is the instance of version 1.1.0; demand "
            "'edge/a' with version '1.1.0' instead, or choose an id that does not end in '@1.1.0'",
        ),
    ],
)
def test_the_id_of_another_instance_is_refused(id: str, version: str, problem: str) -> None:
    assert MemoryRepo(SEPARATE).faults(put("a", version, id)) == [problem]


def test_its_own_id_may_be_asked_for() -> None:
    repo = MemoryRepo(SEPARATE)
    repo.send(put("a", "1.1.0"))
    assert repo.send(put("a", "1.1.0", "edge/a@1.1.0")).outcome == "unchanged"


def test_what_several_definitions_share_runs_once_so_another_version_of_it_is_refused() -> None:
    repo = MemoryRepo(shared("separate"))
    repo.send(record("a", ""))
    assert repo.faults(record("b", "1.1.0")) == [
        "applications[0].version: driver for /points of 'vehicle00' would run in version 1.1.0, "
        "but is shared with 'edge/record' in version 1.0.0; request version 1.0.0"
    ]
    assert repo.send(record("b", "1.0.1")).outcome == "booked"
    services = repo.books()["services"]
    assert sorted((one["service"], one["applications"]) for one in services.values()) == [
        ("driver", ["edge/record", "edge/record@1.0.1"]),
        ("recorder", ["edge/record"]),
        ("recorder", ["edge/record@1.0.1"]),
    ]


def shared(policy: str) -> dict[str, str]:
    """Return a configuration with three versions of the recorder and one shared driver.

    Version 1.0.1 pins an image of the recorder, and version 1.1.0 an image of the driver.
    """
    appdef = yaml.safe_load(ADDITIONS["appdefs/recorder/appdef.yaml"])
    versions = {
        "1.0.0": {},
        "1.0.1": {"images": {"recorder": {"tag": "v2"}}},
        "1.1.0": {"images": {"driver": {"tag": "v2"}}},
    }
    entry = {"default": "1.0.0", "versions": versions}
    head = {"apiVersion": "demandops/v1", "kind": "Versions"}
    return ADDITIONS | {
        "appdefs/recorder/appdef.yaml": yaml.safe_dump(appdef | {"versions": policy}),
        "registry/versions.yaml": yaml.safe_dump(head | {"applications": {"recorder": entry}}),
    }


def record(demand: str, version: str) -> dict[str, Any]:
    made = put(demand, version, "edge/record")
    inputs = {"point_cloud": [{"topic": "/points", "source": "vehicle00"}]}
    made["applications"][0] |= {"type": "recorder", "inputs": inputs, "connect": "none"}
    return made


def test_a_shared_topic_service_must_not_use_the_output_of_a_separate_service() -> None:
    follower = """
apiVersion: demandops/v1
kind: ServiceDefinition
name: follower
scope: topic
prefix: fol
inputs: {lists: {}}
each: lists
chart: object-fusion
images: [object-fusion]
values: values/follower.yaml.j2
"""
    changed = {
        **SEPARATE,
        **edited(
            "appdefs/object-detection-fusion/appdef.yaml",
            "inputs:\n",
            "versions: separate\n"
            "uses: {follower: {lists: object-detection.object_list}}\ninputs:\n",
        ),
        "appdefs/follower/service.yaml": follower,
        "appdefs/follower/values/follower.yaml.j2": "{}",
    }
    with pytest.raises(InvalidInput) as raised:
        MemoryRepo(changed)
    assert [str(fault) for fault in raised.value.faults] == [
        "appdefs/object-detection-fusion/appdef.yaml: uses.follower.lists: the "
        "shared service 'follower' reads 'object-detection.object_list' and runs once for all "
        "versions, but 'object-detection' runs once for each version (versions: separate); make "
        "'object-detection' a shared service too, or define 'follower' in this appdef"
    ]
