"""The applications on a drained node move, and their inputs and deliveries move with them."""

from __future__ import annotations

from dataclasses import replace
from random import Random
from typing import Any

from demandops.decide.booking import Drain
from demandops.decide.placement.relocation import with_moves
from demandops.decide.planning.release_keys import all_keys
from demandops.decide.state import rendered_files
from demandops.model.config.config import Config
from demandops.model.demand.claim import Requirement
from demandops.model.release import ServiceKey
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.chance import chances, examples
from tests.kit.config import state_of
from tests.kit.memory import MemoryRepo, rebuilt
from tests.unit.decide.test_flows import (
    NODES,
    Demands,
    Graphs,
    assert_every_topic_comes_in_one_way,
    in_clusters,
    instances,
)


class Placed(Demands):
    """Demands whose applications name no node, but have a ``place``."""

    def _application(self, id: str) -> dict[str, Any]:
        app = super()._application(id)
        del app["node"]
        return app | {"place": {"capabilities": ["gpu"]}}

    def note_nodes(self, repo: MemoryRepo) -> None:
        """Write the booked node of each application into the demands."""
        for app in (app for apps in self.held.values() for app in apps):
            found = repo.state.ledger.application(app["id"])
            assert found is not None
            app["node"] = found.node


def with_nodes(config: Config, drained: str | None = None) -> Config:
    """Return the configuration with a GPU on some nodes, and with the node ``drained`` drained."""
    nodes = {
        id: node.model_copy(
            update={"capabilities": ("gpu",) * (id in NODES), "drained": id == drained}
        )
        for id, node in config.nodes.items()
    }
    return replace(config, nodes=nodes)


def configure(repo: MemoryRepo, config: Config) -> None:
    repo.state = state_of(config, repo.state.ledger)


@examples(12)
@given(chances, st.integers(1, 6))
def test_every_topic_still_comes_in_one_way_after_a_node_is_drained(
    random: Random, length: int
) -> None:
    graphs = Graphs(random)
    demands = Placed(random, graphs)
    repo = MemoryRepo(graphs.files)
    config = with_nodes(repo.config)
    configure(repo, config)
    for _ in range(length):
        goal = demands.next()
        for app in goal.get("applications", ()):
            app.pop("node", None)
        repo.send(goal)
        demands.note_nodes(repo)
        node = random.choice(NODES)
        before = {claim.key: claim for claim in repo.state.ledger if claim.is_on_application}
        configure(repo, with_nodes(config, node))
        decision = repo.send(Drain(node))
        configure(repo, config)
        assert decision.warnings == ()
        assert not repo.state.ledger.applications_on.get(node)
        for key, claim in before.items():
            moved = repo.state.ledger.get(key)
            assert moved is not None
            assert replace(claim, held=moved.held) == moved
            assert (moved.application == claim.application) is (claim.application.node != node)
        demands.note_nodes(repo)
        held = [app for apps in demands.held.values() for app in apps]
        running = {key for key in all_keys(repo.state) if isinstance(key, ServiceKey)}
        assert running == {key for app in held for key in instances(graphs, app)}
        assert_every_topic_comes_in_one_way(repo, demands)
        assert in_clusters(repo.files) == in_clusters(rendered_files(repo.state))


def test_what_leaves_a_node_is_spread_over_the_others() -> None:
    repo = MemoryRepo()
    config = with_nodes(repo.config)
    configure(repo, config)
    for number in range(4):
        app = {
            "id": f"app{number}",
            "type": "object-detection-fusion",
            "place": {"capabilities": ["gpu"], "labels": ["node_id=cloud"]},
            "inputs": {"ego_data": [{"topic": "/ego", "source": "cloud"}]},
        }
        goal = {"kind": "Demand", "demand": f"d{number}", "requesters": ["v"]}
        repo.send(goal | {"applications": [app]})
    claims = [
        replace(one, held=replace(one.application, place=Requirement(capabilities=("gpu",))))
        for one in repo.state.ledger
    ]
    ledger = rebuilt(claims)
    repo.state = state_of(with_nodes(config, "cloud"), ledger)
    moved = repo.decide(Drain("cloud")).state.ledger
    assert dict(moved.applications_on) == {"edge": 2, "vehicle01": 2}


def test_a_drain_in_parts_moves_the_same_applications_and_skips_none() -> None:
    repo = MemoryRepo()
    config = with_nodes(repo.config)
    configure(repo, config)
    for number in range(5):
        app = {
            "id": f"app{number}",
            "type": "object-detection-fusion",
            "place": {"labels": ["node_id=cloud"]},
            "inputs": {"ego_data": [{"topic": "/ego", "source": "cloud"}]},
        }
        goal = {"kind": "Demand", "demand": f"d{number}", "requesters": ["v"]}
        repo.send(goal | {"applications": [app]})
    stuck = ("app0", "app3")  # their demands ask for a label that no other node has
    ledger = rebuilt(
        one
        if one.subject.id in stuck
        else replace(one, held=replace(one.application, place=Requirement(role="edge")))
        for one in repo.state.ledger
    )
    repo.state = state = state_of(with_nodes(config, "cloud"), ledger)
    whole = with_moves(Drain("cloud"), state, state.usage(), state.names())
    assert len(whole.moved) == 3 and len(whole.stays) == 2 and not whole.last
    parts, after = [], ""
    while True:
        part = with_moves(Drain("cloud", after=after), state, state.usage(), state.names(), most=2)
        parts.append(part)
        after = part.last
        if not after:
            break
    assert len(parts) > 1
    stays = [text.split(",")[0] for part in parts for text in part.stays]
    assert stays == [text.split(",")[0] for text in whole.stays]
    assert sum(len(part.moved) for part in parts) == 3
