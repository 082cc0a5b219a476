"""Random requests of both actions.

A maker draws its random numbers from a plain seed or from Hypothesis's ``randoms()``, which lets
Hypothesis shrink a failed example. A maker uses few subjects, requesters and topics, so that
requests often concern the same ones.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from random import Random
from typing import Any, TypeVar

from tests.kit.goals import (
    CLOUD,
    EGO,
    STATION_CLOUD,
    Goal,
    Item,
    Topic,
    application,
    connection,
    goal,
    input_topic,
)
from tests.model.listed import World, requesters

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

REAR: Topic = ("/vehicles/vehicle00/drivers/rear/pointcloud", "vehicle00")
_SHARED = [("/shared/points", "vehicle01"), ("/shared/points", "vehicle02")]
CLOUDS = (STATION_CLOUD, CLOUD, REAR, *_SHARED)
"""Point clouds: the usual ones, a second one of vehicle00, and one name that two vehicles use."""

_LIDAR, _EGO_01 = "/stations/station00/drivers/lidar/pointcloud", "/vehicles/vehicle01/ego_data"
_TOPICS_00 = {EGO[0]: EGO[0], CLOUD[0]: CLOUD[0], REAR[0]: "/rear"}
CONNECTIONS: dict[str, tuple[str, str, str, dict[str, str]]] = {
    "vehicle00/edge": ("vehicle00", "edge", "edge", _TOPICS_00),
    "station00/edge": (STATION, "edge", "", {_LIDAR: STATION_CLOUD[0], "/status": "/status"}),
    "station00_edge": (STATION, "cloud", "cloud", {"/status": "/stations/status"}),
    "vehicle01/edge": ("vehicle01", "edge", "", {_EGO_01: _EGO_01}),
}
"""Source, target, broker and topics of each connection."""


def ego(vehicle: str) -> Topic:
    return f"/vehicles/{vehicle}/ego_data", vehicle


@dataclass(frozen=True)
class Words:
    """What demands of our own action are about; ``leases`` has None for a demand without one.

    ``inputs`` are those of any application, with their roles. The last input, and the last topic
    of a connection, is listed if no other is.
    """

    demands: tuple[str, ...]
    applications: dict[str, str]
    inputs: tuple[tuple[str, Topic], ...]
    connections: dict[str, tuple[str, str, str, dict[str, str]]]
    leases: tuple[int | None, ...] = (None,)


OWN = Words(
    demands=("d", "D/1", "again"),
    applications={id: APPLICATIONS[id] for id in ("cloud/fusion", "edge/object_detection_fusion")},
    inputs=(
        *(("point_cloud", cloud) for cloud in CLOUDS),
        *(("ego_data", ego(vehicle)) for vehicle in VEHICLES[:2]),
    ),
    connections={id: CONNECTIONS[id] for id in ("station00/edge", "vehicle00/edge")},
)

_ODD: dict[str, Sequence[Any]] = {
    "node_id": ("", "cloud", "edge", "nowhere"),
    "source_node_id": ("", "vehicle02", "vehicle03", "neverland"),
    "target_node_id": ("", "cloud", "edge", "vehicle03", "nowhere"),
    "broker_node_id": ("", "cloud", "edge", "vehicle00", "nowhere"),
    "type": (0, 2, 7),
    "topic_name": (lambda name: name.lstrip("/"),),
    "requester_ids": (lambda who: [],),
    "ego_data_topics": (lambda topics: topics[:1], lambda topics: []),
    "pointcloud_topics": (
        lambda topics: topics[:1],
        lambda topics: [],
        lambda topics: [*topics, input_topic(REAR)],
    ),
    "target_topics": (lambda topics: ["/elsewhere", *topics[1:]], lambda topics: topics[1:]),
}
"""What a goal may have in a field by mistake: values, and functions of the right value."""


def shutdown_of(joined: Goal) -> Goal:
    return {**deepcopy(joined), "shutdown": True}


class Maker:
    """Makes random requests; those of a ``calm`` maker never contradict each other."""

    def __init__(self, random: Random, *, calm: bool = False, both: bool = False) -> None:
        """With ``both``, requests are in the form of our own action as well."""
        self._random = random
        self.calm, self.both = calm, both
        self._demands = DemandMaker(random, OWN)
        self.joined: list[Goal] = []
        self.left: list[Goal] = []

    def sequence(self, length: int) -> list[Goal]:
        return [self.any() for _ in range(length)]

    def any(self) -> Goal:
        if self.both and self._odds(4):
            puts = self._demands.puts
            if puts and self._odds(4):
                return ended(self._pick(puts), "release")
            return self._demands.any(self._random.randrange(DemandMaker.KINDS))
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
        people = self._people() if who is None else list(who)
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
        for item in made["connections"]:
            keep = self._random.randrange(2) if self._odds(4) else None
            more = ["/never/asked"] * self._odds(10)
            for field in ("source_topics", "target_topics"):
                item[field] = item[field][:keep] + more
        for item in (*made["apps"], *made["connections"]):
            self._change(item, 16)
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
        for item in made["connections"]:
            if self._odds(40):
                item["source_topics"], item["target_topics"] = [], []
        for item in (*made["apps"], *made["connections"]):
            self._change(item, 30)
        if self._odds(16):  # all applications or all connections get other requesters
            self._name(self._pick(["apps", "connections"]), made, self._people())
        for kind in ("apps", "connections"):
            if self._odds(20):
                made[kind] += deepcopy(made[kind])
        if self._odds(60):
            made["apps"], made["connections"] = [], []

    def _ask_others(self, made: Goal) -> None:
        """Keep only the first requester, replace all, or add some."""
        people = self._people()
        for kind in ("apps", "connections"):
            named = [one for item in made[kind] for one in requesters(item)]
            who = [named[:1], people, list(dict.fromkeys((*named, *people)))]
            self._name(kind, made, self._pick(who))

    def _name(self, kind: str, made: Goal, who: Sequence[str]) -> None:
        for item in made[kind]:
            item.get("object_detection_fusion_app", item)["requester_ids"] = list(who)

    def _change(self, item: Item, against: int) -> None:
        """Put something odd in fields of an item, in each once in so many times."""
        for field, value in item.items():
            for part in value if isinstance(value, list) else [value]:
                if isinstance(part, dict):
                    self._change(part, against)
            if field in _ODD and self._odds(against):
                odd = self._pick(_ODD[field])
                item[field] = odd(value) if callable(odd) else odd

    # Chance

    def _repeated(self, items: list[T]) -> list[T]:
        shuffled = self._random.sample(items, len(items))
        return [*shuffled, *shuffled[:1]]

    def _pick(self, items: Sequence[T]) -> T:
        return items[self._random.randrange(len(items))]

    def _odds(self, against: int) -> bool:
        return self._random.randrange(against) == against - 1


class DemandMaker:
    """Makes random demands of our own action about few subjects, so that they often overlap."""

    PEOPLE = ("vehicle00", "vehicle01", "station00")
    KINDS = 16

    def __init__(self, random: Random, words: Words) -> None:
        self._random, self._words = random, words
        self.puts: list[Goal] = []

    def any(self, kind: int) -> Goal:
        """Return a known put or its renewal for the first kinds; else a put, renewal or release."""
        if self.puts and kind < 9:
            known = self._random.choice(self.puts[-2:])
            if kind < 3:
                return ended(known, "renew")
            others = self._words.leases[1:]
            return known | {"lease": self._random.choice(others)} if others and kind > 5 else known
        if kind < 14:
            self.puts.append(self.put())
            return self.puts[-1]
        return self._named("release" if kind == 14 else "renew")

    def put(self) -> Goal:
        made, words = self._named("put"), self._words
        lease = self._random.choice(words.leases)
        made |= {} if lease is None else {"lease": lease}
        made["applications"] = [self._application(id) for id in self.some(words.applications)]
        made["connections"] = [self._connection(id) for id in self.some(words.connections)]
        return made

    def _named(self, operation: str) -> Goal:
        people = self.some(self.PEOPLE) or [self._random.choice(self.PEOPLE)]
        demand = self._random.choice(self._words.demands)
        made = {"kind": "Demand", "operation": operation, "demand": demand}
        return made | {"requesters": people}

    def some(self, of: Iterable[T]) -> list[T]:
        return [one for one in of if self._random.randrange(2)]

    def _application(self, id: str) -> Item:
        *inputs, last = self._words.inputs
        listed: dict[str, list[dict[str, str]]] = {}
        for role, (topic, source) in self.some(inputs) or [last]:
            listed.setdefault(role, []).append({"topic": topic, "source": source})
        # mostly the same node, because otherwise most demands contradict each other
        node = self._random.choice([*[self._words.applications[id]] * 3, "cloud"])
        app = {"id": id, "type": "object-detection-fusion", "node": node, "connect": "none"}
        return app | {"inputs": listed}

    def _connection(self, id: str) -> Item:
        source, target, broker, targets = self._words.connections[id]
        *names, last = targets
        chosen = {name: targets[name] for name in self.some(names) or [last]}
        if not self._random.randrange(6):
            chosen = {names[0] if names else last: "/elsewhere"}
        source = "station00" if not self._random.randrange(6) else source
        routes = [{"source": name, "target": to} for name, to in chosen.items()]
        made = {"id": id, "source": source, "target": target, "topics": routes}
        return made | ({"broker": broker} if broker else {})


def ended(put: Goal, operation: str) -> Goal:
    return {name: put[name] for name in ("kind", "demand", "requesters")} | {"operation": operation}
