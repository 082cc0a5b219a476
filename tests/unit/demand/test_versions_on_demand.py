"""The newest of the demanded versions runs, or each by itself; some updates need approval.

``tests/scenarios`` has stories of it.
"""

from __future__ import annotations

import json
from random import Random
from typing import Any

import pytest
from demandops.base.errors import InvalidInput, Refused
from demandops.decide.state import rendered_files, try_configuration
from demandops.model.config.registry import precedence
from demandops.model.release import ServiceRelease
from hypothesis import given

from tests.kit import plain_yaml
from tests.kit.chance import chances, examples
from tests.kit.config import edited, skeleton, state_of
from tests.kit.memory import MemoryRepo, ledger_in, rebuilt

APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
LISTED = ("0.9.0", "1.0.0", "1.1.0-rc.2", "1.1.0-rc.10", "1.1.0", "1.10.0", "2.0.0")
"""The versions in the registry, oldest first."""
CHANNELS = {"stable": "1.0.0", "testing": "1.1.0"}
DEFAULT = "1.0.0"


def config(policy: str, **more: Any) -> dict[str, str]:
    """Return a configuration in which each version pins the images of both services."""
    services = ("object-detection", "object-fusion")
    pins = {one: {"images": {name: {"tag": one} for name in services}} for one in LISTED}
    entry = {"default": DEFAULT, "channels": CHANNELS, "versions": pins} | more
    file = {"apiVersion": "demandops/v1", "kind": "Versions"}
    file |= {"applications": {"object-detection-fusion": entry}}
    made = {"registry/versions.yaml": json.dumps(file)}
    return made | edited(APPDEF, "inputs:\n", f"versions: {policy}\ninputs:\n")


def put(
    demand: str, version: str = "", id: str = "edge/a", cloud: str = "/points"
) -> dict[str, Any]:
    inputs = {"point_cloud": [{"topic": cloud, "source": "edge"}]}
    app = {"id": id, "type": "object-detection-fusion", "node": "edge", "inputs": inputs}
    app |= {"version": version} if version else {}
    head = {"kind": "Demand", "demand": demand, "requesters": [f"for-{demand}"]}
    return head | {"applications": [app]}


def release(demand: str) -> dict[str, Any]:
    return put(demand) | {"operation": "release", "applications": []}


ASKS = "application definition 'object-detection-fusion', for "
CASES = plain_yaml.beside(__file__)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_what_follows_from_another_version(case: dict[str, str]) -> None:
    repo, then = MemoryRepo(config(case["policy"])), case.get("then", "")
    first = repo.send(put("a", case.get("first", "")))
    assert first.approval == (), "the first demand contradicts nobody"
    before = repo.rendered()
    decision = repo.send(put("b", then))
    assert decision.outcome == "booked"
    assert decision.approval == ((ASKS + case["approval"],) if "approval" in case else ())
    assert [case["warns"] in text for text in decision.warnings] == [True] * ("warns" in case)
    again = repo.send(put("b", then, cloud="/more"))
    assert again.approval == (), "a booked demand needs no second approval"
    assert repo.send(release("b")).approval == ()
    assert repo.rendered() == before


def test_a_shared_service_follows_the_newest_of_its_applications() -> None:
    repo = MemoryRepo(config("update"))
    repo.send(put("a"))
    asks = repo.send(put("b", "2.0.0", id="edge/b"))
    what = "object-detection for /points of 'edge'"
    assert asks.approval == (f"{ASKS}the upgrade of {what} from version 1.0.0 to 2.0.0",)
    # a third demand shares the version that already runs
    assert repo.send(put("c", "2.0.0", id="edge/c")).approval == ()
    older = repo.send(put("d", "1.0.0", id="edge/d"))
    assert older.approval == (f"{ASKS}version 1.0.0 of {what}, which runs in version 2.0.0",)
    assert older.warnings == (f"{what} runs version 2.0.0, which others ask for, not 1.0.0",)


def test_the_order_of_versions_is_that_of_semantic_versioning() -> None:
    before = "1.0.0-1 1.0.0-2 1.0.0-10 1.0.0-a 1.0.0-a.1 1.0.0-a.b 1.0.0-b"
    listed = f"{before} 1.0.0 1.0.2 1.0.10 1.2.0 2.0.0".split()
    shuffled = sorted(listed)
    assert shuffled != listed
    assert sorted(shuffled, key=precedence) == listed


def assert_versions(repo: MemoryRepo, policy: str, asked: dict[str, tuple[str, str, str]]) -> None:
    """Check that each service runs the newest version of the applications that use it.

    The version of an application is the newest one that is demanded for it. With separate versions,
    each version except the default has an application of its own.
    """
    newest: dict[str, str] = {}
    for version, app, _ in asked.values():
        name = CHANNELS.get(version, version or DEFAULT)
        id = f"{app}@{name}" if policy == "separate" and name != DEFAULT else app
        newest[id] = max(name, newest.get(id, name), key=LISTED.index)
    services = [one for one in repo.state.plans.values() if isinstance(one, ServiceRelease)]
    assert {id for one in services for id in one.applications} == {*newest}
    for one in services:
        versions = {newest[id] for id in one.applications}
        assert one.version.name == max(versions, key=LISTED.index)
        assert policy != "separate" or len(versions) == 1
        if one.key.service == "object-fusion":
            assert {topic.topic for topic in one.inputs["object_list"]} == {
                topic
                for other in services
                if other.key.service == "object-detection"
                and {*one.applications} <= {*other.applications}
                for topic in other.outputs.values()
            }
    made = [topic for one in services for topic in one.outputs.values()]
    assert len({*made}) == len(made), "no topic is published twice"


@pytest.mark.parametrize("policy", ["refuse", "update", "upgrade", "separate"])
@examples(15)
@given(random=chances)
def test_what_runs_follows_from_the_claims_whatever_their_order(
    random: Random, policy: str
) -> None:
    repo, asked = MemoryRepo(config(policy)), dict[str, tuple[str, str, str]]()
    empty = dict(repo.files)
    for _ in range(12):
        demand = random.choice("abcde")
        if demand in asked and random.random() < 0.4:
            del asked[demand]
            repo.send(release(demand))
        else:
            version = random.choice(["", *LISTED, *CHANNELS])
            wanted = (version, random.choice(["edge/a", "edge/b"]), random.choice(["/p", "/q"]))
            taken = repo.take(put(demand, *wanted))
            if isinstance(taken, Refused):
                assert policy == "refuse"
                assert {one.code for one in taken.faults} == {"conflict"}
            else:
                asked[demand] = wanted
        assert_versions(repo, policy, asked)
    claims = sorted(repo.state.ledger, key=lambda claim: str(claim.key))
    random.shuffle(claims)
    for ledger in (rebuilt(claims), ledger_in(repo.files)):
        files = rendered_files(state_of(repo.config, ledger))
        assert files == repo.below("clusters", "bootstrap")
    for demand in asked:
        repo.send(release(demand))
    assert repo.files == empty


def test_each_listed_version_is_rendered_before_anybody_asks_for_it() -> None:
    folder = "appdefs/object-detection-fusion/charts/next"
    next = f"    channels: {{next: {{folder: {folder}, version: 9.0.0}}}}\n"
    chart = {
        f"{folder}/Chart.yaml": "apiVersion: v2\nname: object-fusion\nversion: 9.0.0\n",
        f"{folder}/values.schema.json": json.dumps({"required": ["missing"]}),
        "registry/charts.yaml": skeleton()["registry/charts.yaml"] + next,
    }
    newest = {"1.0.0": {}, "3.0.0": {"charts": {"object-fusion": "9.0.0"}}}
    with pytest.raises(InvalidInput) as invalid:
        try_configuration(MemoryRepo(config("update", versions=newest, channels={}) | chart).state)
    (found,) = invalid.value.faults
    assert found.file == "appdefs/object-detection-fusion/values/object-fusion.yaml.j2"
    assert '"missing" is a required property' in found.message
