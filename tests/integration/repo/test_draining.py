"""After a person drains a node, one commit moves its placed applications and gives the reason."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.kit import rig
from tests.kit.repo import read as file_of
from tests.kit.rig import Person

NODES = "inventory/nodes.yaml"
SOON_S = 0.1


def _nodes(bare: Path, **more: str) -> dict[str, str | None]:
    text = file_of(bare, NODES)
    for id, fields in more.items():
        text = text.replace(f"  - id: {id}\n", f"  - id: {id}\n    {fields}\n")
    return {NODES: text}


def _demand(name: str, **where: Any) -> dict[str, Any]:
    inputs = {"ego_data": [{"topic": "/ego", "source": "vehicle00"}]}
    app = {"id": name, "type": "object-detection-fusion", "inputs": inputs, "connect": "mqtt"}
    return {
        "kind": "Demand", "demand": name, "requesters": ["vehicle00"], "applications": [app | where]
    }  # fmt: skip


def test_draining_moves_placed_applications_in_one_commit_with_the_reason(
    bare: Path, person: Person, tmp_path: Path
) -> None:
    person.change(_nodes(bare, edge="capabilities: [gpu]", cloud="capabilities: [gpu]"), "GPUs")
    options: dict[str, Any] = {"fetch_interval": SOON_S}
    with (
        rig.running(bare.as_uri(), **options) as first,
        rig.running(bare.as_uri(), data=tmp_path / "other", **options),
    ):
        rig.book(first, _demand("placed", place={"labels": ["node_id=edge"]}))
        rig.book(first, _demand("free", place={"capabilities": ["gpu"]}))
        rig.book(first, _demand("named", node="cloud"))
        made = person.change(_nodes(bare, cloud="drained: true"), "Service the cloud")
        rig.wait_until(
            lambda: any(c.one("Operation") == "drain" for c in rig.commits(bare, f"{made}..main")),
            "the node is drained",
        )
        rig.book(first, _demand("later", place={"capabilities": ["gpu"]}))
    (commit,) = [c for c in rig.commits(bare, f"{made}..main") if c.one("Operation") == "drain"]
    assert commit.one("Caused-By") == f"{made} Petra Platform <petra@example.org>"
    assert commit.one("Node") == "cloud"
    text = rig.git(bare, "log", "-1", "--format=%an%n%B", commit.id)
    assert text.startswith("Petra Platform\nDrain cloud\n")
    assert "Application 'free' is placed on 'edge', the only node that fits." in text
    assert "application 'named' stays, because demand 'named' names the node" in text
    nodes = {name: entry["node"] for name, entry in rig.books(bare)["services"].items()}
    assert nodes == {
        "of-free": "edge",
        "of-placed": "edge",
        "of-later": "edge",
        "of-named": "cloud",
    }
    rig.assert_sound(bare)
