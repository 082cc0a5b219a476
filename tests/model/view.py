"""The bookkeeping of the model, and that of the program in the same words."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from demandops.model.demand.demand import Application
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger.claim import demand_id

from tests.model import books as model
from tests.model.books import Books
from tests.model.listed import Subject

Key = tuple[Subject, str]
"""A claim's key: its subject and the id of its demand in the ledger."""
Content = tuple[dict[str, Any], tuple[str, ...]]
"""What a claim holds, and its requesters."""


def key_of(key: model.Key) -> Key:
    subject, (id, who) = key
    return subject, demand_id(id, who) if who else id


def claims_of(books: Books) -> dict[Key, Content]:
    return {key_of(key): (claim.content(), claim.who) for key, claim in books.claims.items()}


def key_in_ledger(key: claim_files.ClaimKey) -> Key:
    return (key.subject.kind.value.removesuffix("s"), key.subject.id), key.demand


def claims_in_ledger(ledger: Iterable[claim_files.Claim]) -> dict[Key, Content]:
    return {key_in_ledger(claim.key): (_content(claim), claim.requesters) for claim in ledger}


def _content(claim: claim_files.Claim) -> dict[str, Any]:
    held = claim.held
    if isinstance(held, Application):
        fixed = {"type": held.appdef, "node": held.node, "version": held.version}
        return fixed | {"topics": dict.fromkeys(held.topic_keys(), "")}
    routes = {(route.source,): route.target for route in held.topics}
    return {"source": held.source, "target": held.target, "topics": routes, "version": ""}


def view(books: Books) -> dict[str, Any]:
    return {"services": _services(books), "connections": _connections(books)}


def _services(books: Books) -> dict[tuple[str, str, str], dict[str, Any]]:
    # who requests each service: (service, node, point cloud or application)
    found: dict[tuple[str, str, str], dict[str, Any]] = {}

    def read(
        key: tuple[str, str, str], app: str, role: str, topic: str, who: Iterable[str]
    ) -> None:
        new: dict[str, Any] = {"applications": set(), "inputs": {}, "requesters": set()}
        entry = found.setdefault(key, new)
        entry["applications"].add(app)
        entry["requesters"] |= {*who}
        entry["inputs"].setdefault(role, {}).setdefault(topic, set()).update(who)

    for id, claim in books.on("application"):
        node, who = claim.fixed["node"], claim.who
        for role, topic, source in claim.topics:
            if role == "ego_data":
                read(("object-fusion", node, id), id, role, topic, who)
                continue
            cloud = f"{source} {topic}"
            read(("object-fusion", node, id), id, "object_list", cloud, who)
            read(("object-detection", node, cloud), id, "point_cloud", topic, who)
    return {key: _without_names(entry) for key, entry in _sorted(found).items()}


def _without_names(entry: dict[str, Any]) -> dict[str, Any]:
    """Return an entry of a service with only the requesters of each object list.

    The docs do not promise the lists' names, which test_flows compares at both ends.
    """
    inputs = entry["inputs"]
    lists = {role: sorted(inputs[role].values()) for role in inputs if role == "object_list"}
    return entry | {"inputs": inputs | lists}


def _connections(books: Books) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {}
    for id, claim in books.on("connection"):
        ends = {end: claim.fixed[end] for end in ("source", "target")}
        entry = found.setdefault(id, {**ends, "topics": {}, "requesters": set()})
        entry["requesters"] |= {*claim.who}
        for (topic,) in claim.topics:
            entry["topics"].setdefault(topic, set()).update(claim.who)
    return _sorted(found)  # type: ignore[no-any-return]


def _sorted(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _sorted(inner) for key, inner in value.items()}
    return sorted(value) if isinstance(value, set) else value


def in_model_words(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the program's bookkeeping as :func:`view` gives it."""
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
        told = {name: entry[name] for name in ("applications", "requesters")}
        services[key] = _without_names(told | {"inputs": inputs})
    compared = ("source", "target", "topics", "requesters")
    connections = {
        id: {name: entry[name] for name in compared} for id, entry in data["connections"].items()
    }
    return {"services": services, "connections": connections}
