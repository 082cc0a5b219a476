"""The bookkeeping once more, from the sentences of the design alone (§4, §5 and §7).

Plain dicts and sets over goals as they come in YAML. It imports nothing of the program and shares
no idea with it, so that a mistake would have to be made twice. Where the design leaves something
open, a comment says what is taken here.
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
"""The request id and the sorted, de-duplicated requesters: what makes two claims differ."""

Claim = dict[str, Any]
Claims = dict[str, dict[Demand, Claim]]
Outcome = Literal["booked", "released", "unchanged", "refused"]

DETECTION_FUSION = 1
MQTT = 1
_CONNECTION_TYPES = (0, 1, 2)
_BODY = "object_detection_fusion_app"


@dataclass(frozen=True)
class World:
    """What the state repo's inventory lists, as far as booking asks for it."""

    nodes: frozenset[str]
    brokers: frozenset[str]


@dataclass(frozen=True)
class Result:
    """What became of one request.

    ``not_held`` names (subject, topic) of what a shutdown listed in vain; ``touched`` the claims
    that are other than before, as (kind, subject, demand).
    """

    outcome: Outcome
    reason: str = ""
    not_held: tuple[tuple[str, str | None], ...] = ()
    touched: frozenset[tuple[str, str, Demand]] = frozenset()

    @property
    def effective(self) -> bool:
        """Whether a commit must come of it."""
        return self.outcome in ("booked", "released")


class _Refused(Exception):
    pass


def absolute(topic: str) -> str:
    """Return a topic as the root namespace resolves it."""
    return topic if topic.startswith("/") else f"/{topic}"


def requesters(item: Item) -> list[str]:
    """Return for whom an application or a connection is asked."""
    body = item.get(_BODY, {}) if "header" in item else item
    return list(body.get("requester_ids", []))


def demand_of(goal: Goal, item: Item) -> Demand:
    """Return what tells a claim from others on the same subject."""
    return goal.get("id", ""), tuple(sorted(set(requesters(item))))


class Books:
    """Who holds what. :meth:`take` a request, then look at :meth:`services`."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.applications: Claims = {}
        self.connections: Claims = {}

    def take(self, goal: Goal) -> Result:
        """Book or release a request as a whole, or refuse it as a whole."""
        problem = next(self._inadmissible(goal), None)
        if problem:
            return Result("refused", problem)
        before = deepcopy((self.applications, self.connections))
        try:
            if goal.get("shutdown", False):
                not_held = self._shut_down(goal)
                return Result("released", "", not_held, self._touched(before))
            self._join(goal)
        except _Refused as refusal:
            self.applications, self.connections = before
            return Result("refused", str(refusal))
        touched = self._touched(before)
        return Result("booked" if touched else "unchanged", touched=touched)

    def _touched(self, before: tuple[Claims, Claims]) -> frozenset[tuple[str, str, Demand]]:
        found = set()
        pairs = zip(("application", "connection"), before, self._both(), strict=True)
        for kind, old, new in pairs:
            for subject in {*old, *new}:
                was, now = old.get(subject, {}), new.get(subject, {})
                found |= {
                    (kind, subject, demand)
                    for demand in {*was, *now}
                    if was.get(demand) != now.get(demand)
                }
        return frozenset(found)

    def _both(self) -> tuple[Claims, Claims]:
        return self.applications, self.connections

    # What cannot be asked at all

    def _inadmissible(self, goal: Goal) -> Iterator[str]:
        joining = not goal.get("shutdown", False)
        items = [*goal.get("apps", []), *goal.get("connections", [])]
        if not items:
            yield "nothing is listed"
        for item in items:
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
        if _two_targets(connection):
            yield "one source topic with two targets"
        if not joining:
            return
        if connection.get("type", 0) != MQTT:
            yield "the inventory lets nothing but MQTT be carried"  # no bridges, no addresses
        if not sources:
            yield "a connection without topics"
        ends = connection.get("source_node_id", ""), connection.get("target_node_id", "")
        if not set(ends) <= self.world.nodes:
            yield "an unknown node"
        asked = connection.get("broker_node_id", "")
        brokers = self.world.brokers
        if asked and asked not in brokers:
            yield "no broker on the node that is asked for"
        if not asked and not set(ends) & brokers and len(brokers) != 1:
            yield "no broker"

    # Joining: additive for each claim; what contradicts a standing claim is refused

    def _join(self, goal: Goal) -> None:
        for app in goal.get("apps", []):
            self._join_application(demand_of(goal, app), app)
        for connection in goal.get("connections", []):
            self._join_connection(demand_of(goal, connection), connection)

    def _join_application(self, demand: Demand, app: Item) -> None:
        claims = self.applications.setdefault(app["header"]["id"], {})
        node, type_ = app["header"]["node_id"], app["type"]
        for other in claims.values():
            if other["node"] != node:
                raise _Refused("the application is on another node")
            if other["type"] != type_:
                raise _Refused("the application is of another type")
        claim = claims.setdefault(
            demand, {"node": node, "type": type_, "ego_data": set(), "point_cloud": set()}
        )
        for role, topics in _inputs(app).items():
            claim[role] |= topics

    def _join_connection(self, demand: Demand, connection: Item) -> None:
        claims = self.connections.setdefault(connection["id"], {})
        fixed = {
            "type": connection.get("type", 0),
            "source": connection["source_node_id"],
            "target": connection["target_node_id"],
        }
        broker = connection.get("broker_node_id", "")
        for other in claims.values():
            for name, value in fixed.items():
                if other[name] != value:
                    raise _Refused(f"the connection has another {name}")
            # "explicitly different": only where both say which
            if broker and other["broker"] and other["broker"] != broker:
                raise _Refused("the connection has another broker")
            for source, target in _pairs(connection).items():
                if other["topics"].get(source, target) != target:
                    raise _Refused("the source topic has another target")
        claim = claims.setdefault(demand, {**fixed, "broker": "", "topics": {}})
        claim["broker"] = claim["broker"] or broker
        claim["topics"] |= _pairs(connection)

    # Leaving: what is held among what is listed

    def _shut_down(self, goal: Goal) -> tuple[tuple[str, str | None], ...]:
        """Release, and return what was listed in vain.

        Which claim is meant is asked of the books as the request finds them: listing a thing
        twice must not reach for a second claim.
        """
        found, released = deepcopy(self._both()), False
        in_vain: list[tuple[str, str | None]] = []
        for app in goal.get("apps", []):
            id_, listed = app["header"]["id"], _listed_inputs(app)
            demand = _meant(found[0].get(id_, {}), demand_of(goal, app))
            claim = found[0][id_][demand] if demand else None
            if not demand or not claim or not _same_application(claim, app):
                in_vain += [(id_, topic) for _, _, topic in listed] or [(id_, None)]
                continue
            vain = [(role, s, t) for role, s, t in listed if (s, t) not in claim[role]]
            in_vain += [(id_, topic) for _, _, topic in vain]
            released = released or len(vain) < len(listed) or not listed
            self._subtract_inputs(id_, demand, listed)
        for connection in goal.get("connections", []):
            id_, pairs = connection["id"], _pairs(connection)
            demand = _meant(found[1].get(id_, {}), demand_of(goal, connection))
            claim = found[1][id_][demand] if demand else None
            if not demand or not claim or not _same_connection(claim, connection):
                in_vain += [(id_, topic) for topic in pairs] or [(id_, None)]
                continue
            # the source topic says which is meant, for it has one target only
            vain_topics = [topic for topic in pairs if topic not in claim["topics"]]
            in_vain += [(id_, topic) for topic in vain_topics]
            released = released or len(vain_topics) < len(pairs) or not pairs
            self._subtract_topics(id_, demand, pairs)
        if not released:
            raise _Refused("nothing listed is held")
        return tuple(in_vain)

    def _subtract_inputs(
        self, id_: str, demand: Demand, listed: list[tuple[str, str, str]]
    ) -> None:
        claim = self.applications.get(id_, {}).get(demand)
        if claim is None:
            return  # dropped by what the same request listed before
        for role, source, topic in listed:
            claim[role].discard((source, topic))
        if not listed or not (claim["ego_data"] or claim["point_cloud"]):
            _drop(self.applications, id_, demand)

    def _subtract_topics(self, id_: str, demand: Demand, topics: Mapping[str, str]) -> None:
        claim = self.connections.get(id_, {}).get(demand)
        if claim is None:
            return
        for topic in topics:
            claim["topics"].pop(topic, None)
        if not topics or not claim["topics"]:
            _drop(self.connections, id_, demand)

    # The view

    def services(self) -> dict[tuple[str, str, str], dict[str, Any]]:
        """Return who requests which service, by service, node and what it is for.

        A detection is for one cloud (``source topic``), a fusion for one application. The
        fusion's object lists are told by the clouds that they come from.
        """
        found: dict[tuple[str, str, str], dict[str, Any]] = {}
        for id_, claims in self.applications.items():
            for (_, who), claim in claims.items():
                node = claim["node"]
                fusion = found.setdefault(("object-fusion", node, id_), _service())
                _add(fusion, id_, who)
                fusion["inputs"]["ego_data"] |= {topic for _, topic in claim["ego_data"]}
                for source, topic in claim["point_cloud"]:
                    cloud = f"{source} {topic}"
                    fusion["inputs"]["object_list"].add(cloud)
                    detection = found.setdefault(("object-detection", node, cloud), _service())
                    _add(detection, id_, who)
                    detection["inputs"]["point_cloud"].add(topic)
        return {key: _sorted(entry) for key, entry in found.items()}

    def connection_view(self) -> dict[str, dict[str, Any]]:
        """Return who requests which connection, as the contract prints it."""
        return {
            id_: {
                "source": next(iter(claims.values()))["source"],
                "target": next(iter(claims.values()))["target"],
                "topics": sorted({topic for claim in claims.values() for topic in claim["topics"]}),
                "requesters": sorted({who for _, all_ in claims for who in all_}),
            }
            for id_, claims in self.connections.items()
            if claims
        }

    def view(self) -> dict[str, Any]:
        """Return both, to be compared with :func:`in_model_words`."""
        return {"services": self.services(), "connections": self.connection_view()}

    def demands(self) -> set[tuple[str, str, Demand]]:
        """Return every standing claim as (kind, subject, demand)."""
        pairs = zip(("application", "connection"), self._both(), strict=True)
        return {
            (kind, subject, demand)
            for kind, claims in pairs
            for subject, held in claims.items()
            for demand in held
        }


def _meant(claims: Mapping[Demand, Claim], demand: Demand) -> Demand | None:
    if demand in claims:
        return demand
    who = set(demand[1])
    same = [other for other in claims if set(other[1]) == who]
    if len(same) == 1:
        return same[0]
    around = [other for other in claims if set(other[1]) >= who]
    return around[0] if len(around) == 1 else None


def _same_application(claim: Claim, app: Item) -> bool:
    # a shutdown that names no node names no other node
    node = app["header"].get("node_id", "")
    return node in ("", claim["node"]) and app.get("type", 0) == claim["type"]


def _same_connection(claim: Claim, connection: Item) -> bool:
    # the broker is not among what a shutdown is told apart by
    source = connection.get("source_node_id", "")
    target = connection.get("target_node_id", "")
    return (
        source in ("", claim["source"])
        and target in ("", claim["target"])
        and connection.get("type", 0) == claim["type"]
    )


def _drop(claims: Claims, subject: str, demand: Demand) -> None:
    del claims[subject][demand]
    if not claims[subject]:
        del claims[subject]


def _inputs(app: Item) -> dict[str, set[tuple[str, str]]]:
    body = app.get(_BODY, {})
    return {
        role: {
            (topic.get("source_node_id", ""), absolute(topic["topic_name"]))
            for topic in body.get(field, [])
        }
        for role, field in (("ego_data", "ego_data_topics"), ("point_cloud", "pointcloud_topics"))
    }


def _listed_inputs(app: Item) -> list[tuple[str, str, str]]:
    return sorted((role, *topic) for role, topics in _inputs(app).items() for topic in topics)


def _pairs(connection: Item) -> dict[str, str]:
    return dict(_absolute_pairs(connection))


def _two_targets(connection: Item) -> bool:
    pairs = set(_absolute_pairs(connection))
    return len({source for source, _ in pairs}) < len(pairs)


def _absolute_pairs(connection: Item) -> list[tuple[str, str]]:
    sources, targets = connection.get("source_topics", []), connection.get("target_topics", [])
    pairs = zip(sources, targets, strict=False)  # where they do not pair the request is refused
    return [(absolute(source), absolute(target)) for source, target in pairs]


def _service() -> dict[str, Any]:
    inputs: dict[str, set[str]] = {"ego_data": set(), "object_list": set(), "point_cloud": set()}
    return {"applications": set(), "inputs": inputs, "requesters": set()}


def _add(entry: dict[str, Any], application: str, who: Iterable[str]) -> None:
    entry["applications"].add(application)
    entry["requesters"].update(who)


def _sorted(entry: dict[str, Any]) -> dict[str, Any]:
    return {
        "applications": sorted(entry["applications"]),
        "inputs": {role: sorted(topics) for role, topics in entry["inputs"].items() if topics},
        "requesters": sorted(entry["requesters"]),
    }


def in_model_words(
    data: Mapping[str, Any], object_lists: Mapping[tuple[str, str], str]
) -> dict[str, Any]:
    """Return the bookkeeping JSON of the contract as :meth:`Books.view` tells it.

    Args:
        data: ``services`` and ``connections`` as ``demandops bookkeeping --output json`` prints.
        object_lists: (node, object list topic) → the cloud that a detection there makes it from,
            as the rendered releases say.
    """
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
            assert topics == sorted(set(topics)), topics
        inputs = {role: list(topics) for role, topics in entry["inputs"].items() if topics}
        if "object_list" in inputs:
            inputs["object_list"] = sorted(
                object_lists.get((node, topic), f"published by nobody: {topic}")
                for topic in inputs["object_list"]
            )
        services[key] = {
            "applications": entry["applications"],
            "inputs": inputs,
            "requesters": entry["requesters"],
        }
    return {"services": services, "connections": dict(data["connections"])}


def object_lists(manifests: Iterable[str]) -> dict[tuple[str, str], str]:
    """Return (node, object list) → the cloud it is made from, as rendered releases say."""
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
