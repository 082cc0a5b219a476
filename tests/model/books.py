"""A second bookkeeping, written only from docs/demand.md and decision 23.

It takes goals as the plain dicts that YAML gives. It imports nothing of the program and shares no
idea with the program, so a mistake stays unnoticed only if both make it. Where the design leaves
something open, a comment says what this model does.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, Literal

Goal = dict[str, Any]
Item = dict[str, Any]
Demand = tuple[str, tuple[str, ...]]
"""A request id, and the sorted, distinct requesters of its joins."""

Subject = tuple[str, str]
"""A subject: its kind (``application`` or ``connection``) and its id."""

Topic = tuple[str, ...]
"""A topic: a connection's source topic, or an application's role, topic and source."""

Claim = dict[str, Any]
Claims = dict[Subject, dict[Demand, Claim]]
Outcome = Literal["booked", "released", "unchanged", "refused"]

REPEATS_WITHIN_S = 15 * 60
DETECTION_FUSION = 1
MQTT = 1
_CONNECTION_TYPES = (0, 1, 2)
_BODY = "object_detection_fusion_app"


@dataclass(frozen=True)
class World:
    nodes: frozenset[str]
    brokers: frozenset[str]


@dataclass(frozen=True)
class Result:
    """What became of a request.

    ``not_held`` has what a shutdown lists in vain, with None for no topic; ``touched`` has the
    claims that the request adds, changes or removes.
    """

    outcome: Outcome
    reason: str = ""
    not_held: tuple[tuple[str, Topic | None, str], ...] = ()
    touched: frozenset[tuple[Subject, Demand]] = frozenset()

    @property
    def effective(self) -> bool:
        return self.outcome in ("booked", "released")


class _Refused(Exception):
    pass


def absolute(topic: str) -> str:
    """Return the absolute name of a topic, as ROS resolves it in the root namespace."""
    return topic if topic.startswith("/") else f"/{topic}"


def requesters(item: Item) -> list[str]:
    body = item.get(_BODY, {}) if "header" in item else item
    return list(body.get("requester_ids", []))


def demand_of(goal: Goal, item: Item) -> Demand:
    return goal.get("id", ""), tuple(sorted(set(requesters(item))))


class Books:
    def __init__(self, world: World) -> None:
        self.world = world
        self.claims: Claims = {}
        self.now = 0
        self._shutdowns: dict[Any, int] = {}

    def take(self, goal: Goal, pause: int = 1) -> Result:
        """Book or release a request as a whole, or refuse it as a whole.

        ``pause`` is at least a second, so claims differ in age: a shutdown takes from the
        oldest first.
        """
        self.now += pause
        problem = next(self._inadmissible(goal), None)
        if problem:
            return Result("refused", problem)
        before = deepcopy(self.claims)
        try:
            if goal.get("shutdown", False):
                return self._shut_down(goal, before)
            self._join(goal)
        except _Refused as refusal:
            self.claims = before
            return Result("refused", str(refusal))
        touched = self._touched(before)
        if touched:
            who = _people(goal)
            self._shutdowns = {one: at for one, at in self._shutdowns.items() if not one[0] & who}
        return Result("booked" if touched else "unchanged", touched=touched)

    def _touched(self, before: Claims) -> frozenset[tuple[Subject, Demand]]:
        was, now = _flat(before), _flat(self.claims)
        return frozenset(key for key in {*was, *now} if was.get(key) != now.get(key))

    # Requests that are refused whatever is booked

    def _inadmissible(self, goal: Goal) -> Iterator[str]:
        joining = not goal.get("shutdown", False)
        if not _items(goal):
            yield "nothing is listed"
        for item in _items(goal):
            if not requesters(item) or "" in requesters(item):
                yield "nobody asks"
        for app in goal.get("apps", []):
            yield from self._inadmissible_application(app, joining)
        for connection in goal.get("connections", []):
            yield from self._inadmissible_connection(connection, joining)

    def _inadmissible_application(self, app: Item, joining: bool) -> Iterator[str]:
        if not app["header"].get("id"):
            yield "an application has no id"
        if app.get("type", 0) != DETECTION_FUSION:
            yield "no such type of application"
        if not joining:
            return
        topics = _inputs(app)
        sources = {source for role in topics.values() for source, _ in role}
        if not sources:
            yield "an application without topics"
        if not {app["header"].get("node_id", ""), *sources} <= self.world.nodes:
            yield "an unknown node"

    def _inadmissible_connection(self, connection: Item, joining: bool) -> Iterator[str]:
        sources = connection.get("source_topics", [])
        targets = connection.get("target_topics", [])
        if not connection.get("id"):
            yield "a connection has no id"
        if len(sources) != len(targets):
            yield "source and target topics do not pair"
        if connection.get("type", 0) not in _CONNECTION_TYPES:
            yield "no such type of connection"
        if len(dict(_pairs(connection))) < len(set(_pairs(connection))):
            yield "one source topic with two targets"
        if not joining:
            return
        if connection.get("type", 0) != MQTT:
            yield "the inventory allows only MQTT connections"  # the inventory has no bridges
        if not sources:
            yield "a connection without topics"
        ends = connection.get("source_node_id", ""), connection.get("target_node_id", "")
        if not set(ends) <= self.world.nodes:
            yield "an unknown node"
        asked, brokers = connection.get("broker_node_id", ""), self.world.brokers
        if not {asked, *ends} & brokers and len(brokers) != 1:
            yield "no broker"

    def _broker(self, item: Item) -> str:
        """Return the broker of an item; "" if it names none."""
        asked, brokers = item.get("broker_node_id", ""), self.world.brokers
        ends = (item.get("target_node_id", ""), item.get("source_node_id", ""))
        found = [*brokers][:1] if len(brokers) == 1 else [n for n in (asked, *ends) if n in brokers]
        return found[0] if asked and found else ""

    # Joining: a join adds to a claim, and is refused if it contradicts a claim on the subject

    def _join(self, goal: Goal) -> None:
        for item in _items(goal):
            claims = self.claims.setdefault(_subject(item), {})
            fixed, broker, routes = _fixed(item), self._broker(item), dict(_pairs(item))
            for other in claims.values():
                if other["fixed"] != fixed:
                    raise _Refused("another node, type or end")
                # brokers are "explicitly different" only if both connections name one
                if broker and other["broker"] and other["broker"] != broker:
                    raise _Refused("another broker")
                if any(other["routes"].get(one, two) != two for one, two in routes.items()):
                    raise _Refused("the source topic has another target")
            demand = demand_of(goal, item)
            was = claims.get(demand, {"broker": "", "routes": {}, "holds": {}, "booked": self.now})
            claim = deepcopy(was) | {"fixed": fixed, "broker": was["broker"] or broker}
            claim["routes"] |= routes
            for topic in _topics(item):
                claim["holds"].setdefault(topic, set()).update(demand[1])
            # the design leaves this open; here, a join that changes a claim sets its booking time
            claims[demand] = claim if claim == was else claim | {"booked": self.now}

    # Leaving: a shutdown takes one hold of each named requester on each listed topic

    def _shut_down(self, goal: Goal, found: Claims) -> Result:
        """Take the holds that a shutdown lists from the claims ``found`` before it, each once.

        The design leaves open a shutdown with several requesters and no topics: here, each
        gives up its holds on one claim, which may be another for each.
        """
        # a shutdown repeats another one if it lists the same, in any order and any number of times
        said = frozenset(_said(item) for item in _items(goal))
        this = _people(goal), goal.get("id", ""), said
        if this in self._shutdowns and self.now - self._shutdowns[this] <= REPEATS_WITHIN_S:
            return Result("unchanged", "a repeat")
        in_vain, released = list[tuple[str, Topic | None, str]](), False
        for item in _items(goal):
            subject, demand = _subject(item), demand_of(goal, item)
            claims = {d: c for d, c in found.get(subject, {}).items() if _is_meant(c, item)}
            ranked = [(d != demand, d[0] != demand[0], c["booked"], d) for d, c in claims.items()]
            for one in demand[1]:
                theirs = [d for *_, d in sorted(ranked) if one in requesters_of(claims[d])]
                for topic in sorted(_topics(item)) or [None]:
                    holding = (d for d in theirs if one in claims[d]["holds"].get(topic, ()))
                    giver = next(holding if topic else iter(theirs), None)
                    if giver is None:
                        in_vain.append((subject[1], topic, one))
                    else:
                        self._take(subject, giver, one, topic)
                        released = True
        if not released:
            raise _Refused("nothing listed is held")
        self._shutdowns[this] = self.now
        return Result("released", "", tuple(in_vain), self._touched(found))

    def _take(self, subject: Subject, demand: Demand, one: str, topic: Topic | None) -> None:
        claims = self.claims.get(subject, {})
        if demand not in claims:
            return  # an earlier item of this request dropped the claim
        holds = claims[demand]["holds"]
        for each in list(holds) if topic is None else [topic]:
            holds.get(each, set()).discard(one)
            if not holds.get(each, True):
                del holds[each]
                claims[demand]["routes"].pop(each[0], None)
        if not holds:
            del claims[demand]
        if not claims:
            del self.claims[subject]

    # The view

    def services(self) -> dict[tuple[str, str, str], dict[str, Any]]:
        """Return who requests each service: (service, node, point cloud or application)."""
        found: dict[tuple[str, str, str], dict[str, Any]] = {}

        def read(key: tuple[str, str, str], app: str, role: str, topic: str, who: set[str]) -> None:
            new: dict[str, Any] = {"applications": set(), "inputs": {}, "requesters": set()}
            entry = found.setdefault(key, new)
            entry["applications"].add(app)
            entry["requesters"] |= who
            entry["inputs"].setdefault(role, {}).setdefault(topic, set()).update(who)

        for id_, claim in self._on("application"):
            node = claim["fixed"]["node"]
            for (role, topic, source), who in claim["holds"].items():
                if role == "ego_data":
                    read(("object-fusion", node, id_), id_, role, topic, who)
                    continue
                cloud = f"{source} {topic}"
                read(("object-fusion", node, id_), id_, "object_list", cloud, who)
                read(("object-detection", node, cloud), id_, "point_cloud", topic, who)
        return _sorted(found)

    def connection_view(self) -> dict[str, dict[str, Any]]:
        found: dict[str, dict[str, Any]] = {}
        for id_, claim in self._on("connection"):
            ends = {end: claim["fixed"][end] for end in ("source", "target")}
            entry = found.setdefault(id_, {**ends, "topics": {}, "requesters": set()})
            for (topic,), who in claim["holds"].items():
                entry["topics"].setdefault(topic, set()).update(who)
                entry["requesters"] |= who
        return _sorted(found)

    def _on(self, kind: str) -> Iterator[tuple[str, Claim]]:
        return ((id_, claim) for ((of, id_), _), claim in _flat(self.claims).items() if of == kind)

    def view(self) -> dict[str, Any]:
        return {"services": self.services(), "connections": self.connection_view()}

    def holds(self) -> dict[tuple[Subject, Demand], dict[Topic, set[str]]]:
        return {key: claim["holds"] for key, claim in _flat(self.claims).items()}


def _flat(claims: Claims) -> dict[tuple[Subject, Demand], Claim]:
    return {(subject, d): claim for subject, held in claims.items() for d, claim in held.items()}


def requesters_of(claim: Claim) -> set[str]:
    return {one for who in claim["holds"].values() for one in who}


def _items(goal: Goal) -> list[Item]:
    return [*goal.get("apps", []), *goal.get("connections", [])]


def _people(goal: Goal) -> frozenset[str]:
    return frozenset(one for item in _items(goal) for one in requesters(item))


def _subject(item: Item) -> Subject:
    return ("application", item["header"]["id"]) if "header" in item else ("connection", item["id"])


def _fixed(item: Item) -> dict[str, Any]:
    """Return the fields that all claims on a subject share; "" if a shutdown leaves one out."""
    if "header" in item:
        return {"node": item["header"].get("node_id", ""), "type": item.get("type", 0)}
    ends = {end: item.get(f"{end}_node_id", "") for end in ("source", "target")}
    return {**ends, "type": item.get("type", 0)}


def _is_meant(claim: Claim, item: Item) -> bool:
    # the broker of a shutdown does not matter
    return all(value in ("", claim["fixed"][name]) for name, value in _fixed(item).items())


def _topics(item: Item) -> set[Topic]:
    if "header" not in item:
        return {(source,) for source, _ in _pairs(item)}
    return {(role, topic, of) for role, topics in _inputs(item).items() for of, topic in topics}


def _said(item: Item) -> tuple[Any, ...]:
    people = frozenset(requesters(item))
    return _subject(item), people, tuple(_fixed(item).values()), frozenset(_topics(item))


def _inputs(app: Item) -> dict[str, set[tuple[str, str]]]:
    body = app.get(_BODY, {})
    return {
        role: {
            (topic.get("source_node_id", ""), absolute(topic["topic_name"]))
            for topic in body.get(field, [])
        }
        for role, field in (("ego_data", "ego_data_topics"), ("point_cloud", "pointcloud_topics"))
    }


def _pairs(item: Item) -> list[tuple[str, str]]:
    sources, targets = item.get("source_topics", []), item.get("target_topics", [])
    pairs = zip(sources, targets, strict=False)  # a request whose topics do not pair is refused
    return [(absolute(source), absolute(target)) for source, target in pairs]


def _sorted(value: Any) -> Any:
    """Return plain data in which sets have become sorted lists."""
    if isinstance(value, dict):
        return {key: _sorted(inner) for key, inner in value.items()}
    return sorted(value) if isinstance(value, set) else value


def in_model_words(
    data: Mapping[str, Any], object_lists: Mapping[tuple[str, str], str]
) -> dict[str, Any]:
    """Return the program's bookkeeping as :meth:`Books.view` gives it."""
    services = {}
    for entry in data["services"].values():
        node = entry["node"]
        if entry["source"] is None:
            (subject,) = entry["applications"]
        else:
            subject = f"{entry['source']} {entry['source_topic']}"
        key = (entry["service"], node, subject)
        assert key not in services, f"{key} appears twice"
        for topics in entry["inputs"].values():
            assert list(topics) == sorted(topics), topics
        inputs = {role: topics for role, topics in entry["inputs"].items() if topics}
        if "object_list" in inputs:
            inputs["object_list"] = {
                object_lists.get((node, topic), f"published by nobody: {topic}"): who
                for topic, who in inputs["object_list"].items()
            }
        services[key] = {name: entry[name] for name in ("applications", "requesters")} | {
            "inputs": inputs
        }
    told = ("source", "target", "topics", "requesters")
    connections = {
        id: {name: entry[name] for name in told} for id, entry in data["connections"].items()
    }
    return {"services": services, "connections": connections}


def object_lists(manifests: Iterable[str]) -> dict[tuple[str, str], str]:
    """Map (node, topic of an object list) to the point cloud that releases make it from."""
    found: dict[tuple[str, str], str] = {}
    for text in manifests:
        published = re.search(r"objectListTopic: (\S+)", text)
        if not published:
            continue
        node, source, topic = (
            _only(rf'demandops/{name}: "(.*)"', text) for name in ("node", "source", "source-topic")
        )
        assert topic == _only("pointCloudTopic: (.*)", text)
        assert (node, published[1]) not in found, f"two detections on {node}: {published[1]}"
        found[node, published[1]] = f"{source} {topic}"
    return found


def _only(pattern: str, text: str) -> str:
    (found,) = set(re.findall(pattern, text))
    return str(found)
