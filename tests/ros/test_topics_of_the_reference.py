"""Who subscribes to the reference's topics hears what a program with the rendered values sends."""

from __future__ import annotations

from typing import Any

from std_msgs.msg import String

from tests.kit.goals import application, goal
from tests.kit.memory import MemoryRepo
from tests.kit.ros import Client

OF_THE_REFERENCE = {
    "/vehicle00_local_objectlist",
    "/vehicle01_local_objectlist",
    "/station00_local_objectlist",
    "/edge_object_detection_fusion_global_objectlist",
    "/edge_object_detection_fusion_global_trajectories",
}
"""As object_detection_fusion_app.py of application_manager names them, for the goal below."""

CLOUDS = [
    ("/vehicles/vehicle00/drivers/lidar/pointcloud", "vehicle00"),
    ("/any/points", "vehicle01"),
    ("/stations/station00/pointcloud", "station00"),
]
OUTPUTS = ("objectListTopic", "fusedObjectListsTopic", "fusedTrajectoriesTopic")


def rendered() -> list[dict[str, Any]]:
    """Return what each program's launch file is given."""
    repo = MemoryRepo()
    repo.send(goal([application("edge/object-detection_fusion", clouds=CLOUDS)]))
    values = [release["spec"]["values"] for release in repo.objects("HelmRelease").values()]
    return [one.get("detection") or one["fusion"] for one in values]


def test_a_subscriber_of_the_reference_hears_every_output(ros_domain: int) -> None:
    subscriber, programs = Client(ros_domain), Client(ros_domain)
    heard: dict[str, str] = {}
    for topic in OF_THE_REFERENCE:
        subscriber.node.create_subscription(
            String, topic, lambda message, topic=topic: heard.setdefault(topic, message.data), 10
        )
    senders = {
        topic: (programs.node.create_publisher(String, topic, 10), program["nodeName"])
        for program in rendered()
        for name, topic in program.items()
        if name in OUTPUTS
    }

    def all_heard() -> bool:
        for publisher, name in senders.values():
            publisher.publish(String(data=name))
        return heard.keys() >= OF_THE_REFERENCE

    try:
        subscriber.wait(all_heard)
    finally:
        programs.close()
        subscriber.close()
    assert senders.keys() == OF_THE_REFERENCE
    assert heard == {topic: name for topic, (_, name) in senders.items()}
