"""Placed services fit their nodes, stay on them, count as usage, and leave a drained node."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from random import Random
from typing import Any

import pytest
import yaml
from demandops.base.errors import Refused
from demandops.decide.booking import Drain
from demandops.decide.planning.planner import plan
from demandops.decide.planning.release_keys import all_keys
from demandops.decide.state import rendered_files
from demandops.model.config.config import Config
from demandops.model.config.load import load
from demandops.model.release import ServiceKey, ServiceRelease
from demandops.repo.history import commit_message
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.chance import chances, examples
from tests.kit.config import skeleton, state_of
from tests.kit.goals import application, goal
from tests.kit.memory import NOW, MemoryRepo, ledger_in
from tests.scenarios.running import configuration
from tests.unit.decide.test_flows import (
    NODES,
    Demands,
    Graphs,
    assert_every_topic_comes_in_one_way,
    in_clusters,
    instances,
)

MOST = 2
PLACE = {"place": {"capabilities": ["gpu"]}, "requests": {"slot": 1}}


class Naming(Demands):
    """Demands that name the nodes of some services."""

    def _application(self, id: str) -> dict[str, Any]:
        app = super()._application(id)
        services = self.graphs.services[app["type"]].items()
        names = [name for name, one in services if one["scope"] == "application"]
        chosen = self.random.sample(names, self.random.randint(0, min(1, len(names))))
        return app | {"services": {name: self.random.choice(NODES) for name in chosen}}


def with_gpus(config: Config, random: Random, drained: str = "") -> Config:
    """Return the configuration with GPUs and a capacity on some nodes.

    The nodes are in random order, and the node ``drained`` is drained.
    """
    nodes = [
        node.model_copy(
            update={
                "capabilities": ("gpu",) * (id in NODES),
                "capacity": {"slot": str(MOST)} if id in NODES else None,
                "drained": id == drained,
            }
        )
        for id, node in config.nodes.items()
    ]
    random.shuffle(nodes)
    return replace(config, nodes={node.id: node for node in nodes})


def configure(repo: MemoryRepo, config: Config) -> None:
    repo.state = state_of(config, repo.state.ledger)


def services(repo: MemoryRepo) -> dict[str, Mapping[str, str]]:
    return {c.subject.id: c.application.services for c in repo.state.ledger if c.is_on_application}


def assert_sound(repo: MemoryRepo, demands: Demands) -> None:
    apps = [app for apps in demands.held.values() for app in apps]
    placed = services(repo)
    for app in apps:
        for name, definition in repo.config.services[app["type"]].items():
            assert name in placed[app["id"]] or not definition.place
        for name, node in app.get("services", {}).items():
            assert placed[app["id"]].get(name, app["node"]) == node
    running = {key for key in all_keys(repo.state) if isinstance(key, ServiceKey)}
    wanted = {k for app in apps for k in instances(demands.graphs, app, placed[app["id"]])}
    assert running == wanted
    used = Counter(
        release.node.id
        for key in running
        for release in [plan(repo.state, key)]
        if isinstance(release, ServiceRelease) and release.service.requests
    )
    assert all(used[node] <= MOST for node in used), used
    assert {*used} <= {*NODES}
    assert_every_topic_comes_in_one_way(repo, demands)
    assert ledger_in(repo.files) == repo.state.ledger
    assert in_clusters(repo.files) == in_clusters(rendered_files(repo.state))


@examples(5)
@given(chances, st.integers(1, 6))
def test_services_that_are_placed_fit_stay_and_leave_drained_nodes(
    random: Random, length: int
) -> None:
    graphs = Graphs(random, PLACE, each=length > 4)
    demands = Naming(random, graphs) if length > 4 else Demands(random, graphs)
    repo = MemoryRepo(graphs.files)
    plain = repo.config
    for _ in range(length):
        configure(repo, with_gpus(plain, random))
        held, before = copy.deepcopy((demands.held, demands.where)), services(repo)
        goal = demands.next()
        twin = repo.copy()
        configure(twin, with_gpus(plain, random))
        taken, same = repo.take(goal), twin.take(goal)
        assert twin.files == repo.files, "another generator must decide the same"
        if isinstance(taken, Refused):
            assert isinstance(same, Refused) and str(same) == str(taken)
            assert {fault.code for fault in taken.faults} <= {"no-room", "capacity", "conflict"}
            demands.held, demands.where = held
        alone = {app["id"] for app in goal.get("applications", ())} - demands.others(goal)
        for id, nodes in services(repo).items():
            named = id in alone and isinstance(demands, Naming)
            assert named or nodes == before.get(id, nodes), (
                "a demand must not move a running service"
            )
        assert_sound(repo, demands)
        node = random.choice(NODES)
        configure(repo, with_gpus(plain, random, node))
        left = {id: dict(nodes) for id, nodes in services(repo).items()}
        decision = repo.send(Drain(node))
        for id, nodes in services(repo).items():
            for name, now in nodes.items():
                told = f"service '{name}' of application '{id}'"
                moved = any(told in text for text in decision.placed)
                stays = any(told in text for text in decision.warnings)
                assert (now != left[id][name]) is moved
                assert (left[id][name] == node) is (moved or stays)
        assert_sound(repo, demands)


class Extreme(Random):
    """A source of random numbers that draws the first or the last choice more often than others."""

    def __init__(self, seed: int) -> None:
        self._often = seed % 10 / 10
        super().__init__(seed)

    def random(self) -> float:
        drawn = super().random()
        return drawn if super().random() > self._often else (0.0 if drawn < 0.5 else 0.999)

    def getrandbits(self, k: int) -> int:
        drawn = super().getrandbits(k)
        return drawn if super().random() > self._often else 0

    def _randbelow(self, n: int) -> int:
        drawn = super().getrandbits(30) % n
        if super().random() > self._often:
            return drawn
        return 0 if super().random() < 0.7 else n - 1


@pytest.mark.parametrize(("seed", "length"), [(62, 3), (87, 4)])
def test_a_drain_brings_no_topic_to_a_node_from_two_nodes(seed: int, length: int) -> None:
    """Each seed gives services at several sources whose outputs have the same name.

    A drain must not bring a topic of that name from two sources to one node.
    """
    test_services_that_are_placed_fit_stay_and_leave_drained_nodes.hypothesis.inner_test(  # type: ignore[attr-defined]
        Extreme(seed), length
    )


def repo_with(domains: list[dict[str, Any]], **nodes: dict[str, Any]) -> MemoryRepo:
    """Return a repo whose fusion needs a GPU.

    ``domains`` are the access domains, and ``nodes`` has further fields of some nodes.
    """
    inventory = yaml.safe_load(skeleton()["inventory/nodes.yaml"])
    inventory["nodes"] = [node | nodes.get(node["id"], {}) for node in inventory["nodes"]]
    services = {"services": {"object-fusion": {"place": {"capabilities": ["gpu"]}}}}
    files = {"inventory/nodes.yaml": inventory, f"appdefs/{TYPE}/appdef.yaml": services}
    if domains:
        files["policy/access-domains.yaml"] = {"domains": domains}
    return MemoryRepo(state=state_of(load(configuration(config=files))))


TYPE = "object-detection-fusion"
APP = {
    "id": "app",
    "type": TYPE,
    "node": "edge",
    "inputs": {"ego_data": [{"topic": "/ego", "source": "vehicle00"}]},
}
DEMAND = {"kind": "Demand", "demand": "d", "requesters": ["v"], "applications": [APP]}
GPU = {"capabilities": ["gpu"]}
WHY = "service 'object-fusion' of application 'app' is placed on "


def test_the_node_of_the_application_comes_first_and_the_commit_says_why() -> None:
    def at(x: int) -> dict[str, Any]:
        return {"position": {"x": x, "y": 0}}

    nodes = {"cloud": GPU | at(0), "vehicle00": at(0), "edge": {"capabilities": ["gpu"]} | at(9)}
    decision = repo_with([], **nodes).send(DEMAND)
    told = f"{WHY}'edge', the node of its application among 2 nodes that fit"
    assert decision.placed == (told,)
    assert f" {told[0].upper()}{told[1:]}." in commit_message.of_decision(decision, "o", NOW)
    del nodes["edge"]
    repo = repo_with([], **nodes)
    assert repo.send(DEMAND).placed == (f"{WHY}'cloud', the only node that fits",)
    assert repo.send(DEMAND).placed == (f"{WHY}'cloud', where it is booked already",)
    releases = (plan(repo.state, key) for key in all_keys(repo.state))
    (fusion,) = (one for one in releases if isinstance(one, ServiceRelease))
    shapes = [entry for _, entry, _ in fusion.shaping_entries(repo.config)]
    assert "services.object-fusion.place" in shapes


def test_its_access_domain_must_permit_and_approve_it() -> None:
    def domains(**cloud: Any) -> list[dict[str, Any]]:
        open = {"name": "open", "namespace": "open", "nodes": ["edge", "vehicle*"]}
        return [open, {"name": "cloud", "namespace": "cloud", "nodes": ["cloud"]} | cloud]

    rule = {"name": "others", "requesters": ["w"]}
    refused = repo_with(domains(rules=[rule]), cloud=GPU).take(DEMAND)
    assert isinstance(refused, Refused)
    assert "'cloud' is in access domain 'cloud', which does not permit this demand" in str(refused)
    assert str(refused).endswith(
        "or ask for a change of inventory/nodes.yaml or policy/access-domains.yaml"
    )
    alone = DEMAND | {"applications": [APP | {"connect": "none"}]}
    decision = repo_with(domains(approval="required"), cloud=GPU).send(alone)
    assert decision.approval == ("access domain 'cloud'",)


def test_a_deployment_request_has_its_services_placed_and_is_told_what_is_not_carried() -> None:
    repo = repo_with([], cloud=GPU)
    decision = repo.send(goal(apps=[application("app", ego=[("/ego", "vehicle00")], clouds=[])]))
    assert decision.placed == (f"{WHY}'cloud', the only node that fits",)
    assert any("no connection carries" in text and "'cloud'" in text for text in decision.warnings)


def test_a_service_at_its_sources_has_no_node_that_a_demand_names() -> None:
    services = {"services": {"object-detection": {"placement": "source"}}}
    config = load(configuration(config={f"appdefs/{TYPE}/appdef.yaml": services}))
    repo, named = MemoryRepo(state=state_of(config)), {"object-detection": "edge"}
    refused = repo.take(DEMAND | {"applications": [APP | {"services": named}]})
    assert isinstance(refused, Refused)
    assert "services.object-detection: object-detection runs at its sources" in str(refused)


def test_another_demand_may_name_the_node_on_which_a_service_runs_with_its_application() -> None:
    repo = MemoryRepo(state=state_of(load(configuration())))
    repo.send(DEMAND)

    def naming(node: str) -> dict[str, Any]:
        app = APP | {"services": {"object-fusion": node}}
        return DEMAND | {"demand": "e", "requesters": ["w"], "applications": [app]}

    assert repo.send(naming(APP["node"])).outcome == "booked"
    assert services(repo) == {"app": {}}, "all claims on the application say the same"
    refused = repo.take(naming("cloud"))
    assert isinstance(refused, Refused)
    assert {fault.code for fault in refused.faults} == {"conflict"}
