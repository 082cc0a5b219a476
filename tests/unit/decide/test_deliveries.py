"""A delivery ends when nothing makes the delivered output any longer.

The output may have lost its inputs because a node was decommissioned.
"""

from __future__ import annotations

from demandops.model.demand.demand_request import Decommission

from tests.kit.memory import MemoryRepo


def test_a_decommissioned_node_ends_the_deliveries_of_what_was_made_from_its_topics() -> None:
    repo = MemoryRepo()
    clouds = [{"topic": f"/{name}/points", "source": name} for name in ("vehicle03", "vehicle01")]
    app = {"id": "edge/a", "type": "object-detection-fusion", "node": "edge"}
    deliver = [
        {"output": "object-detection.object_list", "node": "station00"},
        {"output": "object-fusion.fused_objects", "node": "station00"},
    ]
    head = {"kind": "Demand", "demand": "d", "requesters": ["operator"]}
    item = app | {"inputs": {"point_cloud": clouds}, "deliver": deliver}
    repo.send(head | {"applications": [item]})
    delivered = "derived/edge/station00"
    assert {*repo.books()["connections"][delivered]["topics"]} == {
        "/vehicle03_local_objectlist",
        "/vehicle01_local_objectlist",
        "/edge_a_global_objectlist",
    }
    leave = Decommission(id="vehicle01", kinds=frozenset({"node"}), by="petra <p@example.org>")
    repo.send(leave)
    assert {id: [*one["topics"]] for id, one in repo.books()["connections"].items()} == {
        "derived/vehicle03/edge": ["/vehicle03/points"],
        delivered: ["/edge_a_global_objectlist", "/vehicle03_local_objectlist"],
    }
    repo.send(Decommission(id="station00", kinds=frozenset({"node"}), by=leave.by))
    assert [*repo.books()["connections"]] == ["derived/vehicle03/edge"]
    (claim,) = [claim for claim in repo.state.ledger if claim.is_on_application]
    assert claim.application.deliver == ()
