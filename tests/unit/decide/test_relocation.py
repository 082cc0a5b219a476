"""What is placed fits its node, stays there, and leaves a drained node with all that it reads."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from random import Random
from typing import Any

import pytest
from demandops.base.errors import Refused
from demandops.decide.booking import Drain
from demandops.decide.placement.relocation import with_moves
from demandops.decide.planning.planner import all_keys, plan
from demandops.model.config.config import Config
from demandops.model.demand.demand import Application, Requirement
from demandops.model.release import ServiceRelease
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.chance import chances, examples
from tests.kit.config import state_of
from tests.kit.memory import MemoryRepo, rebuilt
from tests.unit.decide.test_flows import NODES, Demands, Graphs, assert_follows

MOST = 2
PLACE = {"place": {"capabilities": ["gpu"]}, "requests": {"slot": 1}}


class NamingServices(Demands):
    """Demands that name the nodes of some services."""

    def _application(self, id: str) -> dict[str, Any]:
        app = super()._application(id)
        services = self.graphs.services[app["type"]].items()
        names = [name for name, one in services if one["scope"] == "application"]
        chosen = self.random.sample(names, self.random.randint(0, min(1, len(names))))
        return app | {"services": {name: self.random.choice(NODES) for name in chosen}}


class Placed(Demands):
    """Demands whose applications name no node, but have a ``place``."""

    def next(self) -> dict[str, Any]:
        goal = super().next()
        apps = [
            {key: value for key, value in app.items() if key != "node"} | {"place": PLACE["place"]}
            for app in goal.get("applications", ())
        ]
        return goal | ({"applications": apps} if apps else {})

    def note_nodes(self, repo: MemoryRepo) -> None:
        for app in (app for apps in self.held.values() for app in apps):
            app["node"] = applications(repo)[app["id"]].node


def with_gpus(config: Config, random: Random, drained: str = "") -> Config:
    """Return the configuration with GPUs on some nodes, which are in random order."""
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


def applications(repo: MemoryRepo) -> dict[str, Application]:
    return {one.subject.id: one.application for one in repo.state.ledger if one.is_on_application}


def places(repo: MemoryRepo) -> dict[str, Mapping[str, str]]:
    """Return the chosen nodes of each application: of its services and, under "", its own."""
    return {
        id: {**app.services} | ({"": app.node} if app.place else {})
        for id, app in applications(repo).items()
    }


def assert_sound(repo: MemoryRepo, demands: Demands) -> None:
    apps = [app for apps in demands.held.values() for app in apps]
    placed = places(repo)
    for app in apps:
        for name, definition in repo.config.services[app["type"]].items():
            assert name in placed[app["id"]] or not definition.place
        for name, node in app.get("services", {}).items():
            assert placed[app["id"]].get(name, app["node"]) == node
    releases = (plan(repo.state, key) for key in all_keys(repo.state))
    used = Counter(
        one.node.id for one in releases if isinstance(one, ServiceRelease) and one.service.requests
    )
    assert all(used[node] <= MOST for node in used), used
    assert {*used} <= {*NODES}
    assert_follows(repo, demands, placed)


@pytest.mark.parametrize("kind", [Demands, NamingServices, Placed])
@examples(5)
@given(chances, st.integers(1, 6))
def test_what_is_placed_fits_stays_and_leaves_drained_nodes(
    kind: type[Demands], random: Random, length: int
) -> None:
    graphs = Graphs(random, None if kind is Placed else PLACE, each=kind is NamingServices)
    demands, repo = kind(random, graphs), MemoryRepo(graphs.files)
    plain = repo.config
    for _ in range(length):
        configure(repo, with_gpus(plain, random))
        held, before = copy.deepcopy((demands.held, demands.where)), places(repo)
        goal = demands.next()
        twin = repo.copy()
        configure(twin, with_gpus(plain, random))
        taken, same = repo.take(goal), twin.take(goal)
        assert twin.files == repo.files, "another generator must decide the same"
        if isinstance(taken, Refused):
            assert kind is not Placed and str(same) == str(taken)
            assert {fault.code for fault in taken.faults} <= {"no-room", "capacity", "conflict"}
            demands.held, demands.where = held
        alone = {app["id"] for app in goal.get("applications", ())} - demands.others(goal)
        for id, nodes in places(repo).items():
            named = id in alone and kind is NamingServices
            assert named or nodes == before.get(id, nodes), "a demand must not move what runs"
        if isinstance(demands, Placed):
            demands.note_nodes(repo)
        assert_sound(repo, demands)
        node = random.choice(NODES)
        configure(repo, with_gpus(plain, random, node))
        left, claims = places(repo), list(repo.state.ledger)
        decision = repo.send(Drain(id=node))
        for id, nodes in places(repo).items():
            for name, now in nodes.items():
                told = f"service '{name}' of application '{id}'" if name else f"application '{id}'"
                moved = any(told in text for text in decision.placed)
                stays = any(told in text for text in decision.warnings)
                assert (now != left[id][name]) is moved
                assert (left[id][name] == node) is (moved or stays)
        for claim in (one for one in claims if one.is_on_application):
            moved_claim = repo.state.ledger.get(claim.key)
            assert moved_claim and replace(claim, held=moved_claim.held) == moved_claim
        if isinstance(demands, Placed):
            assert not decision.warnings
            demands.note_nodes(repo)
        assert_sound(repo, demands)


def on_cloud(count: int, *stuck: int) -> MemoryRepo:
    """Return a repo with applications on the drained node ``cloud``; the ``stuck`` must stay."""
    repo = MemoryRepo()
    for number in range(count):
        app = {
            "id": f"app{number}",
            "type": "object-detection-fusion",
            "place": {"labels": ["node_id=cloud"]},
            "inputs": {"ego_data": [{"topic": "/ego", "source": "cloud"}]},
        }
        goal = {"kind": "Demand", "demand": f"d{number}", "requesters": ["v"]}
        repo.send(goal | {"applications": [app]})
    gpu = Requirement(capabilities=("gpu",))
    ledger = rebuilt(
        one
        if one.subject.id in [f"app{number}" for number in stuck]
        else replace(one, held=replace(one.application, place=gpu))
        for one in repo.state.ledger
    )
    repo.state = state_of(with_gpus(repo.config, Random(0), "cloud"), ledger)
    return repo


def test_what_leaves_a_node_is_spread_over_the_others() -> None:
    moved = on_cloud(4).decide(Drain(id="cloud")).state.ledger
    assert dict(moved.applications_on) == {"edge": 2, "vehicle01": 2}


def test_a_drain_in_parts_moves_the_same_applications_and_skips_none() -> None:
    state = on_cloud(5, 0, 3).state
    whole = with_moves(Drain(id="cloud"), state, state.usage(), state.names())
    assert len(whole.moved) == 3 and len(whole.stays) == 2 and not whole.last
    parts = [with_moves(Drain(id="cloud"), state, state.usage(), state.names(), most=2)]
    while after := parts[-1].last:
        drain = Drain(id="cloud", after=after)
        parts.append(with_moves(drain, state, state.usage(), state.names(), most=2))
    assert len(parts) > 1
    stays = [text.split(",")[0] for part in parts for text in part.stays]
    assert stays == [text.split(",")[0] for text in whole.stays]
    assert sum(len(part.moved) for part in parts) == 3
