"""Random requests in the form of the reference's action.

A maker draws its random numbers from a plain seed or from Hypothesis's ``randoms()``, which lets
Hypothesis shrink a failed example. A maker uses few subjects, requesters and topics, so that
requests often concern the same ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from random import Random
from typing import Any, TypeVar

from tests.kit.goals import (
    CLOUD,
    STATION_CLOUD,
    Goal,
    Item,
    Topic,
    application,
    connection,
    goal,
    input_topic,
)
from tests.model.books import World, requesters

T = TypeVar("T")

STATION = "station00"
VEHICLES = ("vehicle00", "vehicle01", "vehicle02", "vehicle03")
PARTIES = (*VEHICLES, STATION)

SKELETON = World(nodes=frozenset({*PARTIES, "edge", "cloud"}), brokers=frozenset({"edge", "cloud"}))

REQUESTS = ("station00/collective-perception-intersection", "again", "")

APPLICATIONS = {
    "edge/object_detection_fusion": "edge",
    "edge/object.detection_fusion": "edge",
    "cloud/fusion": "cloud",
}
"""The node of each application; the first two share detections and have nearly the same name."""

CLOUDS = (
    STATION_CLOUD,
    CLOUD,
    ("/vehicles/vehicle00/drivers/rear/pointcloud", "vehicle00"),
    ("/shared/points", "vehicle01"),
    ("/shared/points", "vehicle02"),
)
"""Point clouds: the usual ones, a second one of vehicle00, and one name that two vehicles use."""

CONNECTIONS: dict[str, tuple[str, str, str, dict[str, str]]] = {
    "vehicle00/edge": (
        "vehicle00",
        "edge",
        "edge",
        {
            "/vehicles/vehicle00/ego_data": "/vehicles/vehicle00/ego_data",
            CLOUD[0]: CLOUD[0],
            "/vehicles/vehicle00/drivers/rear/pointcloud": "/rear",
        },
    ),
    "station00/edge": (
        STATION,
        "edge",
        "",
        {"/stations/station00/drivers/lidar/pointcloud": STATION_CLOUD[0], "/status": "/status"},
    ),
    "station00_edge": (STATION, "cloud", "cloud", {"/status": "/stations/status"}),
    "vehicle01/edge": (
        "vehicle01",
        "edge",
        "",
        {"/vehicles/vehicle01/ego_data": "/vehicles/vehicle01/ego_data"},
    ),
}


def ego(vehicle: str) -> Topic:
    return f"/vehicles/{vehicle}/ego_data", vehicle


def shutdown_of(joined: Goal) -> Goal:
    return {**deepcopy(joined), "shutdown": True}


class Maker:
    """Makes random requests; those of a ``calm`` maker never contradict each other."""

    def __init__(self, random: Random, *, calm: bool = False) -> None:
        self._random = random
        self.calm = calm
        self.joined: list[Goal] = []
        self.left: list[Goal] = []

    def sequence(self, length: int) -> list[Goal]:
        return [self.any() for _ in range(length)]

    def any(self) -> Goal:
        if not self.joined or self._random.randrange(2) == 0:
            return self.join()
        if self._odds(6):
            return self.again(self._pick(self.joined))
        if self._odds(30):
            return goal(id=self._pick(REQUESTS), shutdown=True)
        if self.left and self._odds(4):  # the last shutdown, or an older one
            made = self.left[-1] if self._odds(2) else self._pick(self.left)
            return self.again(made) if self._odds(3) else made
        self.left.append(self.leave())
        return self.left[-1]

    def join(self, request: str | None = None, who: Sequence[str] | None = None) -> Goal:
        random = self._random
        people = list(who) if who is not None else self._people()
        apps = [self._application(people) for _ in range(random.randrange(3))]
        connections = [
            self._connection(people) for _ in range(random.randrange(0 if apps else 1, 3))
        ]
        id_ = self._pick(REQUESTS) if request is None else request
        made = goal(apps, connections, id=id_)
        if not self.calm:
            self._disturb(made)
        self.joined.append(made)
        return made

    def again(self, joined: Goal) -> Goal:
        """Return the same goal; each list is in another order and has one entry twice."""
        made = deepcopy(joined)
        for item in made["apps"]:
            body = item["object_detection_fusion_app"]
            for field in ("requester_ids", "ego_data_topics", "pointcloud_topics"):
                body[field] = self._repeated(body[field])
        for item in made["connections"]:
            item["requester_ids"] = self._repeated(item["requester_ids"])
            pairs = list(zip(item["source_topics"], item["target_topics"], strict=False))
            if len(item["source_topics"]) == len(item["target_topics"]):
                pairs = self._repeated(pairs)
                item["source_topics"] = [source for source, _ in pairs]
                item["target_topics"] = [target for _, target in pairs]
        return made

    def leave(self) -> Goal:
        """Return a shutdown of an earlier join: of all of it, of a part, or with mistakes."""
        place = self._random.randrange(len(self.joined))
        made = shutdown_of(self.joined[place])
        if not self._odds(3):  # otherwise the same join may be shut down again
            del self.joined[place]
        for kind in ("apps", "connections"):
            if len(made["apps"]) + len(made["connections"]) > 1 and self._odds(3):
                made[kind] = made[kind][:1]
        if self._odds(4):
            made["id"] = self._pick(REQUESTS)
        if self._odds(4):
            self._ask_others(made)
        for app in made["apps"]:
            self._leave_application(app)
        for item in made["connections"]:
            self._leave_connection(item)
        if self.joined and self._odds(8):
            more = self._pick(self.joined)
            made["apps"] += deepcopy(more["apps"])
            made["connections"] += deepcopy(more["connections"])
        return made

    # Parts

    def _application(self, who: Sequence[str]) -> Item:
        id_ = self._pick(sorted(APPLICATIONS))
        vehicles = [name for name in who if name in VEHICLES]
        topics = [ego(name) for name in vehicles if not self._odds(5)]
        clouds = [cloud for cloud in CLOUDS if self._odds(3)]
        clouds = clouds if topics or clouds else [STATION_CLOUD]
        return application(id_, node=APPLICATIONS[id_], who=who, ego=topics, clouds=clouds)

    def _connection(self, who: Sequence[str]) -> Item:
        id_ = self._pick(sorted(CONNECTIONS))
        source, target, broker, targets = CONNECTIONS[id_]
        names = [name for name in targets if self._odds(2)] or list(targets)[:1]
        return connection(
            id_,
            who=who,
            ends=(source, target),
            topics=names,
            targets=[targets[name] for name in names],
            broker=broker,
        )

    def _people(self) -> list[str]:
        first = self._pick(PARTIES)
        if self._odds(4):
            return [first]
        if self._odds(4):
            return self._random.sample(PARTIES, 3)
        return [first, STATION if first != STATION else self._pick(VEHICLES)]

    def _disturb(self, made: Goal) -> None:
        for app in made["apps"]:
            self._disturb_application(app)
        for item in made["connections"]:
            self._disturb_connection(item)
        if self._odds(16):  # all applications or all connections get other requesters
            self._name(self._pick(["apps", "connections"]), made, self._people())
        if self._odds(20):
            made["apps"] += deepcopy(made["apps"])
        if self._odds(20):
            made["connections"] += deepcopy(made["connections"])
        if self._odds(60):
            made["apps"], made["connections"] = [], []

    def _disturb_application(self, app: Item) -> None:
        body = app["object_detection_fusion_app"]
        if self._odds(16):
            app["header"]["node_id"] = self._pick(["cloud", "edge", "nowhere"])
        if self._odds(40):
            body["requester_ids"] = []
        if self._odds(40):
            app["type"] = 2
        if self._odds(40):
            body["ego_data_topics"], body["pointcloud_topics"] = [], []
        for topic in (*body["ego_data_topics"], *body["pointcloud_topics"]):
            if self._odds(15):
                topic["topic_name"] = topic["topic_name"].lstrip("/")
            if self._odds(60):
                topic["source_node_id"] = self._pick(["vehicle03", "nowhere"])

    def _disturb_connection(self, item: Item) -> None:
        self._disturb_ends(item)
        if self._odds(20):
            item["target_topics"][0] = "/elsewhere"
        if self._odds(48):
            item["requester_ids"] = []
        if self._odds(40):
            item["target_topics"] = item["target_topics"][1:]
        if self._odds(40):
            item["source_topics"], item["target_topics"] = [], []

    def _disturb_ends(self, item: Item) -> None:
        if self._odds(12):
            item["broker_node_id"] = self._pick(["", "cloud", "edge", "vehicle00"])
        if self._odds(24):
            item["target_node_id"] = self._pick(["cloud", "edge", "vehicle03", "nowhere"])
        if self._odds(24):
            item["source_node_id"] = self._pick(["vehicle02", "neverland"])
        if self._odds(40):
            item["type"] = self._pick([0, 2, 7])

    def _ask_others(self, made: Goal) -> None:
        people = self._people()
        for kind in ("apps", "connections"):
            named = [one for item in made[kind] for one in requesters(item)]
            who = [named[:1], people, list(dict.fromkeys((*named, *people)))]
            self._name(kind, made, self._pick(who))

    def _name(self, kind: str, made: Goal, who: Sequence[str]) -> None:
        for item in made[kind]:
            item.get("object_detection_fusion_app", item)["requester_ids"] = list(who)

    def _leave_application(self, app: Item) -> None:
        body = app["object_detection_fusion_app"]
        for field in ("ego_data_topics", "pointcloud_topics"):
            if self._odds(4):
                body[field] = body[field][:1]
            elif self._odds(4):
                body[field] = []
        if self._odds(8):
            body["pointcloud_topics"] = [
                *body["pointcloud_topics"],
                input_topic(self._pick(CLOUDS)),
            ]
        if self._odds(10):
            app["header"]["node_id"] = self._pick(["", "cloud", "edge", "nowhere"])
        if self._odds(20):
            app["type"] = self._pick([0, 2])

    def _leave_connection(self, item: Item) -> None:
        if self._odds(4):
            keep = self._random.randrange(2)
            item["source_topics"] = item["source_topics"][:keep]
            item["target_topics"] = item["target_topics"][:keep]
        if self._odds(10):
            item["target_node_id"] = self._pick(["", "cloud", "vehicle03", "nowhere"])
        if self._odds(10):
            item["source_node_id"] = self._pick(["", "vehicle02", "neverland"])
        if self._odds(10):
            item["broker_node_id"] = self._pick(["", "cloud", "nowhere"])
        if self._odds(10):
            item["type"] = self._pick([0, 2, 7])
        if self._odds(10) and item["target_topics"]:
            item["target_topics"][0] = "/elsewhere"
        if self._odds(10):
            item["source_topics"] = [*item["source_topics"], "/never/asked"]
            item["target_topics"] = [*item["target_topics"], "/never/asked"]

    # Chance

    def _repeated(self, items: list[T]) -> list[T]:
        shuffled = self._random.sample(items, len(items))
        return [*shuffled, *shuffled[:1]]

    def _pick(self, items: Sequence[T]) -> T:
        return items[self._random.randrange(len(items))]

    def _odds(self, against: int) -> bool:
        return self._random.randrange(against) == against - 1


def summary(made: Goal) -> dict[str, Any]:
    return {key: value for key, value in made.items() if value not in ([], False)}
