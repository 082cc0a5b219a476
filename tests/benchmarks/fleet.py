"""State repos with a fleet of any size for the benchmarks; one commit contains the whole fleet.

A region is a cluster of ten edges with ten vehicles each. Each vehicle has a connection (two
releases) and a detection on its edge, and each edge has a fusion. The code of the generator itself
makes the claims and the rendered files.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pygit2
from demandops.base import strict_yaml
from demandops.decide.booking import apply
from demandops.decide.decision import admit
from demandops.decide.state import State, rendered_files
from demandops.model.config.load import load
from demandops.model.demand.goals import read_goal
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger.ledger import Ledger
from demandops.repo.history import commit_message

from tests.kit import goals
from tests.kit.config import configuration, state_of
from tests.kit.repo import write_tree

BUILD = Path("build")
EDGES_PER_CLUSTER = VEHICLES_PER_EDGE = 10
RELEASES_PER_EDGE = 3 * VEHICLES_PER_EDGE + 1


def edges_for(releases: int) -> int:
    return max(1, round(releases / RELEASES_PER_EDGE))


def edge_id(number: int) -> str:
    return f"edge{number:05d}"


def vehicle_id(edge: int, number: int) -> str:
    return f"v{edge:05d}x{number}"


def spare_id(edge: int) -> str:
    """Return the id of an edge's spare vehicle: it is in the inventory and demands nothing yet."""
    return f"newcomer{edge:05d}"


def goal(
    edge: str, vehicle: str, *, ego: Sequence[str] = (), shutdown: bool = False
) -> dict[str, Any]:
    """Return a vehicle's goal for the fusion of an edge; ``ego`` lists the vehicle's ego topics."""
    ego, points = ego or [f"/{vehicle}/ego_data"], f"/{vehicle}/points"
    app = goals.application(
        f"{edge}/fusion",
        node=edge,
        who=[vehicle],
        ego=[(topic, vehicle) for topic in ego],
        clouds=[(points, vehicle)],
    )
    ends = vehicle, edge
    link = goals.connection(
        f"{vehicle}/{edge}", who=[vehicle], ends=ends, topics=[*ego, points], broker=""
    )
    return goals.goal([app], [link], id="bench", shutdown=shutdown)


def _region(number: int) -> str:
    return f"region{number // EDGES_PER_CLUSTER:04d}"


def _file(kind: str, **lists: object) -> str:
    return strict_yaml.dump({"apiVersion": "demandops/v1", "kind": kind} | lists)


def _inventory(edges: int, vehicles: int) -> dict[str, str]:
    nodes = [{"id": "cloud", "type": "cloud", "cluster": _region(0)}]
    for number in range(edges):
        region, places = _region(number), range(vehicles)
        nodes.append({"id": edge_id(number), "type": "edge", "cluster": region})
        names = [*(vehicle_id(number, place) for place in places), spare_id(number)]
        nodes += [{"id": name, "type": "vehicle", "cluster": region} for name in names]
    clusters = [{"name": region} for region in sorted({_region(number) for number in range(edges)})]
    broker = {"node": "cloud", "host": "broker", "port": 1883}
    return {
        "inventory/nodes.yaml": _file("Nodes", nodes=nodes),
        "inventory/clusters.yaml": _file("Clusters", clusters=clusters),
        "inventory/brokers.yaml": _file("Brokers", brokers=[broker]),
    }


def lay_down(path: Path, edges: int, vehicles: int = VEHICLES_PER_EDGE) -> Path:
    """Make a bare state repo of a fleet, in which each vehicle demands the fusion of its edge."""
    files = configuration() | _inventory(edges, vehicles)
    limits = {"demandItems": 100_000, "demandCharacters": 10_000_000, "fileBytes": 10_000_000}
    limits["decisionMilliseconds"] = 60_000
    files["demandops.yaml"] += strict_yaml.dump({"limits": limits})
    config = load(files)
    state, now = state_of(config), datetime.now(timezone.utc)
    ledger = Ledger()
    for number in range(edges):
        for place in range(vehicles):
            request = admit(state, read_goal(goal(edge_id(number), vehicle_id(number, place))))
            ledger, _ = apply(ledger, request, now)
    files |= {claim_files.path_of(claim.key): claim_files.text_of(claim) for claim in ledger}
    files |= rendered_files(State(config, ledger, state.evaluate))
    repo = pygit2.init_repository(str(path), bare=True, initial_head="main")
    with no_fsync():
        tree = write_tree(repo, None, files)
        who = commit_message.generator_signature(now)
        text = "A fleet\n\nOperation: init\nRender-Version: 3\n"
        repo.create_commit("refs/heads/main", who, who, text, tree, [])
    return path


@contextmanager
def no_fsync() -> Iterator[None]:
    pygit2.option(pygit2.enums.Option.ENABLE_FSYNC_GITDIR, 0)
    yield
    pygit2.option(pygit2.enums.Option.ENABLE_FSYNC_GITDIR, 1)


def workspace() -> TemporaryDirectory[str]:
    BUILD.mkdir(exist_ok=True)
    return TemporaryDirectory(prefix="bench-", dir=BUILD)


def report(name: str, **tables: Sequence[Mapping[str, object]]) -> None:
    """Print tables, with the keys of the first row as columns; write build/<name>.json."""
    for title, rows in tables.items():
        cells = [[*rows[0]], *([_cell(value) for value in row.values()] for row in rows)]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        print(title)
        for row in cells:
            print(*(cell.rjust(width) for cell, width in zip(row, widths, strict=True)), sep="  ")
    BUILD.mkdir(exist_ok=True)
    (BUILD / f"{name}.json").write_text(json.dumps(tables, indent=2) + "\n")


def _cell(value: object) -> str:
    return f"{value:,.2f}" if isinstance(value, float) else str(value)
