"""Applications as a requester demands them, with inputs of vehicles."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

EGO = "/vehicles/{}/ego_data"
CLOUD = "/vehicles/{}/drivers/lidar/pointcloud"
TYPE = "object-detection-fusion"


def application(
    id: str, *, ego_data: Collection[str] = (), point_cloud: Collection[str] = (), **more: Any
) -> dict[str, Any]:
    """Return an application at the edge that takes these topics of these vehicles."""
    ways = {"ego_data": (EGO, ego_data), "point_cloud": (CLOUD, point_cloud)}
    inputs = {
        name: [{"topic": topic.format(vehicle), "source": vehicle} for vehicle in vehicles]
        for name, (topic, vehicles) in ways.items()
        if vehicles
    }
    return {"id": id, "type": TYPE, "node": "edge", "inputs": inputs, **more}
