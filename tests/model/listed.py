"""What goals of both actions list, as claims, and which goals are refused whatever is booked.

Like :mod:`.books`, it is written from docs/demand.md and imports nothing of the program.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from tests.kit.goals import Goal, Item

Subject = tuple[str, str]
"""A subject: its kind (``application`` or ``connection``) and its id."""

Topic = tuple[str, ...]
"""A topic: a connection's source topic, or an application's role, topic and source."""

Route = tuple[str, str, str, str]
"""Source node, topic there, target node, topic there."""

DETECTION_FUSION = 1
FUSION = "object-detection-fusion"
"""The type whose number in goals of the reference's action is ``DETECTION_FUSION``."""
MQTT = 1
_CONNECTION_TYPES = (0, 1, 2)
_BODY = "object_detection_fusion_app"


@dataclass(frozen=True)
class World:
    nodes: frozenset[str]
    brokers: frozenset[str]


@dataclass
class Claim:
    """``fixed`` has type and nodes; ``topics`` has the target of each topic of a connection.

    ``listed`` has the id that the demand lists for a topic of a connection, and None if no goal
    lists the topic, but an application needs it. ``promised`` is when the last granted lease ends.
    """

    fixed: dict[str, Any]
    broker: str
    topics: dict[Topic, str]
    who: tuple[str, ...]
    listed: dict[Topic, str | None] = field(default_factory=dict)
    version: str = ""
    lease: int | None = None
    promised: float | None = field(default=None, compare=False)

    def grant(self, lease: int | None, now: float, before: Claim | None) -> None:
        self.lease = lease
        self.promised = None if lease is None else now + lease
        if self.promised and before and before.promised:
            # a shorter lease does not take back what was promised before
            self.promised = max(self.promised, before.promised)

    def content(self) -> dict[str, Any]:
        """Return all but the requesters and the lease."""
        # all connections that are booked have this type
        fixed = {name: what for name, what in self.fixed.items() if (name, what) != ("type", MQTT)}
        return fixed | {"topics": dict(self.topics), "version": self.version}

    def contradicts(self, other: Claim) -> bool:
        # a connection keeps its type and broker, whatever is demanded
        mine, theirs = ({**claim.fixed} for claim in (self, other))
        if "source" in mine:
            mine["type"] = theirs["type"]
        return mine != theirs or any(
            other.topics.get(one, to) != to for one, to in self.topics.items()
        )

    def means(self, claim: Claim) -> bool:
        # of a shutdown, which may leave nodes out; a connection's type and broker do not matter
        if "source" in self.fixed:
            mine, ends = ({c.fixed["source"], c.fixed["target"]} for c in (self, claim))
            return mine - {""} <= ends
        return all(value in ("", claim.fixed[name]) for name, value in self.fixed.items())

    def routes(self) -> dict[Route, Topic]:
        ends = self.fixed.get("source", ""), self.fixed.get("target", "")
        return {(ends[0], one[0], ends[1], to): one for one, to in self.topics.items()}


def absolute(topic: str) -> str:
    return topic if topic.startswith("/") else f"/{topic}"


def requesters(item: Item) -> list[str]:
    body = item.get(_BODY, {}) if "header" in item else item
    return list(body.get("requester_ids", []))


def items(goal: Goal, world: World) -> Iterator[tuple[Subject, Claim]]:
    if goal.get("kind") == "Demand":
        yield from _own_items(goal)
        return
    for app in goal.get("apps", []):
        fixed = {"type": FUSION, "node": app["header"].get("node_id", "")}
        topics = dict.fromkeys(_inputs(app), "")
        who = tuple(sorted({*requesters(app)}))
        yield ("application", app["header"]["id"]), Claim(fixed, "", topics, who)
    for item in goal.get("connections", []):
        fixed = {"type": item.get("type", 0)}
        fixed |= {end: item.get(f"{end}_node_id", "") for end in ("source", "target")}
        routes = {(source,): target for source, target in _pairs(item)}
        who = tuple(sorted({*requesters(item)}))
        yield ("connection", item["id"]), Claim(fixed, _broker(item, world), routes, who)


def _broker(item: Item, world: World) -> str:
    # "" if it names none
    asked, brokers = item.get("broker_node_id", ""), world.brokers
    ends = (item.get("target_node_id", ""), item.get("source_node_id", ""))
    found = [*brokers][:1] if len(brokers) == 1 else [n for n in (asked, *ends) if n in brokers]
    return found[0] if asked and found else ""


def _own_items(goal: Goal) -> Iterator[tuple[Subject, Claim]]:
    who = tuple(sorted({*goal["requesters"]}))
    for app in goal.get("applications", []):
        inputs = {
            (role, absolute(topic["topic"]), topic["source"]): ""
            for role, topics in app["inputs"].items()
            for topic in topics
        }
        fixed = {"type": app["type"], "node": app["node"]}
        version = app.get("version", "")
        yield ("application", app["id"]), Claim(fixed, "", inputs, who, version=version)
    for item in goal.get("connections", []):
        fixed = {"type": MQTT, "source": item["source"], "target": item["target"]}
        routes: dict[Topic, str] = {
            (absolute(one["source"]),): absolute(one.get("target", one["source"]))
            for one in item["topics"]
        }
        yield ("connection", item["id"]), Claim(fixed, item.get("broker", ""), routes, who)


def inadmissible(goal: Goal, world: World) -> Iterator[str]:
    if goal.get("kind") == "Demand":  # those that the tests make have no other faults
        is_put = goal.get("operation", "put") == "put"
        if is_put and not (goal.get("applications") or goal.get("connections")):
            yield "nothing is listed"
        return
    joining = not goal.get("shutdown", False)
    listed = [*goal.get("apps", []), *goal.get("connections", [])]
    if not listed:
        yield "nothing is listed"
    for item in listed:
        if not requesters(item) or "" in requesters(item):
            yield "nobody asks"
    for app in goal.get("apps", []):
        yield from _inadmissible_application(app, joining, world)
    for connection in goal.get("connections", []):
        yield from _inadmissible_connection(connection, joining, world)


def _inadmissible_application(app: Item, joining: bool, world: World) -> Iterator[str]:
    if not app["header"].get("id"):
        yield "an application has no id"
    if app.get("type", 0) != DETECTION_FUSION:
        yield "no such type of application"
    if not joining:
        return
    sources = {source for _, _, source in _inputs(app)}
    if not sources:
        yield "an application without topics"
    if not {app["header"].get("node_id", ""), *sources} <= world.nodes:
        yield "an unknown node"


def _inadmissible_connection(connection: Item, joining: bool, world: World) -> Iterator[str]:
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
    if not sources:
        yield "a connection without topics"
    ends = connection.get("source_node_id", ""), connection.get("target_node_id", "")
    if not set(ends) <= world.nodes:
        yield "an unknown node"


def cannot_carry(claim: Claim, world: World) -> str:
    """Return why a connection cannot carry what is new on it."""
    if claim.fixed["type"] != MQTT:
        return "the inventory allows only MQTT connections"  # the inventory has no bridges
    ends = {claim.broker, claim.fixed["source"], claim.fixed["target"]}
    return "" if ends & world.brokers or len(world.brokers) == 1 else "no broker"


def _inputs(app: Item) -> Iterator[Topic]:
    for role, name in (("ego_data", "ego_data_topics"), ("point_cloud", "pointcloud_topics")):
        for topic in app.get(_BODY, {}).get(name, []):
            yield role, absolute(topic["topic_name"]), topic.get("source_node_id", "")


def _pairs(item: Item) -> list[tuple[str, str]]:
    sources, targets = item.get("source_topics", []), item.get("target_topics", [])
    pairs = zip(sources, targets, strict=False)  # a request whose topics do not pair is refused
    return [(absolute(source), absolute(target)) for source, target in pairs]
