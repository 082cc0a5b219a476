"""The model has the requesters of the paper's table after each step of the experiment."""

from __future__ import annotations

from typing import Any

from tests.kit.goals import experiment
from tests.model.books import Books
from tests.model.goals import SKELETON

STATION_CLOUD = "station00 /stations/station00/pointcloud"
VEHICLE_CLOUD = "vehicle00 /vehicles/vehicle00/drivers/lidar/pointcloud"

STEPS = (
    ("1-vehicle00-joins", "S 0", "S 0", ""),
    ("2-vehicle01-joins", "S 0 1", "S 0", "1"),
    ("3-vehicle03-joins", "S 0 1 3", "S 0", "1 3"),
    ("4-vehicle02-joins", "S 0 1 2 3", "S 0", "1 2 3"),
    ("5-vehicle00-leaves", "S 1 2 3", "", "1 2 3"),
    ("6-vehicle01-leaves", "S 2 3", "", "2 3"),
    ("7-vehicle02-leaves", "S 3", "", "3"),
    ("8-vehicle03-leaves", "", "", ""),
)
"""Each step, who reads the station's and vehicle 0's data, and who else has a connection."""


def people(text: str) -> list[str]:
    return ["station00" if one == "S" else f"vehicle0{one}" for one in text.split()]


def requesters(entry: dict[str, Any] | None) -> list[str]:
    return entry["requesters"] if entry else []


def test_the_model_gives_the_papers_table() -> None:
    books = Books(SKELETON)
    for step, (name, by_station, by_vehicle, others) in enumerate(STEPS, 1):
        result = books.take(experiment(step))
        assert result.outcome == ("booked" if "joins" in name else "released")
        services, connections = books.services(), books.connection_view()

        station = services.get(("object-detection", "edge", STATION_CLOUD))
        vehicle = services.get(("object-detection", "edge", VEHICLE_CLOUD))
        fusion = services.get(("object-fusion", "edge", "edge/object_detection_fusion"))
        assert requesters(station) == requesters(fusion) == people(by_station)
        assert requesters(connections.get("station00/edge")) == people(by_station)
        assert requesters(vehicle) == requesters(connections.get("vehicle00/edge"))
        assert requesters(vehicle) == people(by_vehicle)
        for one in "123":
            expected = people(f"S {one}") if one in others else []
            assert requesters(connections.get(f"vehicle0{one}/edge")) == expected
        if fusion:
            present = ["0"] * bool(by_vehicle) + others.split()
            inputs = fusion["inputs"]
            assert [*inputs["ego_data"]] == [f"/vehicles/vehicle0{one}/ego_data" for one in present]
            clouds = [STATION_CLOUD] + [VEHICLE_CLOUD] * bool(by_vehicle)
            assert [*inputs["object_list"]] == clouds
    assert not books.claims
