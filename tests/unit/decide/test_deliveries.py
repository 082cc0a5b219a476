"""A delivery ends when nothing makes the delivered output any longer."""

from __future__ import annotations

from demandops.model.demand.demand import Decommission

from tests.kit.goals import put
from tests.kit.memory import MemoryRepo


def test_a_decommissioned_node_ends_the_deliveries_of_what_was_made_from_its_topics() -> None:
    repo = MemoryRepo()
    made = put("d", "operator")
    (app,) = made["applications"]
    app["inputs"] = {
        "point_cloud": [
            {"topic": f"/{id}/points", "source": id} for id in ("vehicle03", "vehicle01")
        ]
    }
    outputs = ("object-detection.object_list", "object-fusion.fused_objects")
    app["deliver"] = [{"output": output, "node": "station00"} for output in outputs]
    repo.send(made)

    def carried() -> dict[str, list[str]]:
        return {id: [*one["topics"]] for id, one in repo.books()["connections"].items()}

    def decommission(node: str) -> None:
        repo.send(Decommission(id=node, kinds=frozenset({"node"}), by="petra <p@example.org>"))

    delivered = {f"derived/edge/station00/vehicle0{n}_local_objectlist" for n in (1, 3)}
    assert delivered < {*carried()}
    decommission("vehicle01")
    assert {*carried()} == {
        "derived/vehicle03/edge/vehicle03/points",
        "derived/edge/station00/edge_d_global_objectlist",
        "derived/edge/station00/vehicle03_local_objectlist",
    }
    decommission("station00")
    assert [*carried()] == ["derived/vehicle03/edge/vehicle03/points"]
    (claim,) = [claim for claim in repo.state.ledger if claim.is_on_application]
    assert claim.application.deliver == ()
