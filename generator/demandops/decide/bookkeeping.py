"""Bookkeeping: who requests each service, connection and topic, and what each demand holds.

The paper shows the bookkeeping in Table III, column 4. The bookkeeping is derived from the claims
whenever it is shown, and is stored nowhere.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, get_args

from demandops.base.naming import Subject, SubjectKind
from demandops.base.quantities import amount_text
from demandops.decide.checks.forbidden import whole_usage
from demandops.decide.planning.overrides import suspended_claims, without_suspended
from demandops.decide.planning.planner import all_keys, connection_topics, demanded_inputs, plan
from demandops.model.ledger.claim import Claim, requesters_of
from demandops.model.ledger.ledger import Ledger, World
from demandops.model.ledger.records import in_turn
from demandops.model.release import ServiceRelease, claims_of

# those that the plain data lacks if they are empty
_LEFT_OUT = ("demands", "suspended", "nodes", "waiting", "targets", "listed")
# Topic → the requesters of the topic, sorted.
_Requesters: TypeAlias = dict[str, list[str]]
Json: TypeAlias = dict[str, Any]
Kind = Literal["service", "connection"]


def bookkeeping(world: World) -> Json:
    active = without_suspended(world)
    releases = (plan(world, key) for key in all_keys(world))
    services = {
        release.name: service_entry(active, release)
        for release in releases
        if isinstance(release, ServiceRelease)
    }
    connections = {
        id: connection_entry(claims)
        for id in world.ledger.subjects(SubjectKind.CONNECTION)
        if (claims := active.ledger.connection_claims(id))
    }
    suspended = [
        {
            "kind": claim.subject.kind.value[:-1],
            "id": claim.subject.id,
            "demand": claim.demand,
            "requesters": list(claim.requesters),
            "override": override.path,
            "reason": override.reason,
        }
        for claim, override in suspended_claims(world)
    ]
    waiting = [
        {
            "demand": each.demand,
            "requesters": list(each.requesters),
            "since": each.since.strftime("%Y-%m-%dT%H:%M:%SZ"),
            "priority": each.put.priority,
        }
        for each in in_turn(world.ledger.waiting)
    ]
    by_demand: dict[str, list[Claim]] = {}
    subjects = [Subject(kind, id) for kind in SubjectKind for id in world.ledger.subjects(kind)]
    for claim in (claim for subject in subjects for claim in world.ledger.claims_on(subject)):
        if claim.keeping_override is None:  # a claim that an override keeps is of no demand
            by_demand.setdefault(claim.demand, []).append(claim)
    # also those whose claims are suspended, but no service or connection counts these claims
    demands: dict[str, Json] = {}
    for demand, held in sorted(by_demand.items()):
        demands[demand] = {
            # the ROS action that takes such a demand
            "action": "DeploymentRequest" if held[0].joined else "Demand",
            "request": held[0].request,
            "requesters": list(requesters_of(held)),
        }
        # applications that it does not list, each with those that read its outputs
        held_for = {
            claim.subject.id: list(claim.application.held_for)
            for claim in held
            if claim.is_on_application and claim.application.held_for
        }
        if held_for:
            demands[demand]["held_for"] = held_for
    # of those that declare a capacity, what services request of each resource, and the capacity
    usage, config, nodes = whole_usage(world), world.config, dict[str, dict[str, Json]]()
    # A machine that is in several access domains is one entry, because it has one capacity.
    used = {*config.nodes, *(node for node, _ in usage.amounts)}
    machines = {id: config.nodes[id] for id in used - {*config.hosts} if id in config.nodes}
    for id, node in sorted(machines.items()):
        names = {*(node.capacity or ()), *(name for at, name in usage.amounts if at == id)}
        limits = ((name, node.most(name)) for name in sorted(names))
        resources = {
            name: {
                "requested": amount_text(usage.of(id, name), name),
                "capacity": amount_text(most, name),
            }
            for name, most in limits
            if most is not None
        }
        if resources:
            nodes[id] = resources
    return {
        "services": dict(sorted(services.items())),  # by release name
        "connections": connections,
        "demands": demands,
        "suspended": suspended,
        "nodes": nodes,
        "waiting": waiting,  # in the order of the tries to book
    }


def service_entry(active: World, release: ServiceRelease) -> Json:
    inputs = {
        role: {topic.topic: set[str]() for topic in topics}
        for role, topics in release.inputs.items()
    }
    for claim in claims_of(release, active.ledger):
        for role, topic in demanded_inputs(active, release, claim.application):
            if topic in inputs[role]:  # a claim that a person wrote may name another topic
                inputs[role][topic].update(claim.requesters)
    return {
        "applications": list(release.applications),
        "service": release.key.service,
        "node": release.node.id,
        "source": release.key.source,
        "source_topic": release.key.topic,
        "version": release.chart.version,
        "application_version": release.version.name or None,  # in registry/versions.yaml
        "versions_asked": versions_asked(release, active.ledger),
        "parameters": dict(release.parameters),
        "inputs": {role: _sorted(topics) for role, topics in inputs.items()},
        "requesters": list(release.requesters),
    }


def connection_entry(claims: Sequence[Claim]) -> Json:
    # of claims that are not suspended, at least one
    first = claims[0].connection
    routes = connection_topics(claims)
    requesters = {route.source: set[str]() for route in routes}
    listed: dict[str, set[str]] = {}
    for claim in claims:
        for route in claim.connection.topics:
            requesters[route.source].update(claim.requesters)
            if route.listed:
                listed.setdefault(route.source, set()).add(route.listed)
    return {
        "type": first.type.word if first.type else "",
        "source": first.source,
        "target": first.target,
        "topics": _sorted(requesters),
        "requesters": list(requesters_of(claims)),
        # by topic, where they differ: its name at the target, and the ids that demands list it
        # under
        "targets": {r.source: r.target for r in routes if r.source != r.target},
        "listed": _sorted(dict(sorted(listed.items()))),
    }


def versions_asked(release: ServiceRelease, ledger: Ledger) -> dict[str, list[str]]:
    asking: dict[str, set[str]] = {}
    for claim in claims_of(release, ledger):
        if claim.application.version:
            asking.setdefault(claim.application.version, set()).update(claim.requesters)
    return {version: sorted(requesters) for version, requesters in sorted(asking.items())}


def _sorted(topics: dict[str, set[str]]) -> _Requesters:
    return {topic: sorted(who) for topic, who in topics.items()}


def carried_topics(entry: Json) -> _Requesters:
    """Return the requesters of each topic of a connection, in words such as ``/raw as /points``."""
    targets, listed = entry.get("targets", {}), entry.get("listed", {})
    return {
        topic
        + (f" as {targets[topic]}" if topic in targets else "")
        + (f" of {', '.join(listed[topic])}" if topic in listed else ""): who
        for topic, who in entry["topics"].items()
    }


def as_data(view: Json, commit: str) -> Json:
    connections = {
        id: {name: part for name, part in entry.items() if part or name not in _LEFT_OUT}
        for id, entry in view["connections"].items()
    }
    data = view | {"connections": connections, "commit": commit}
    return {name: part for name, part in data.items() if part or name not in _LEFT_OUT}


@dataclass(frozen=True, slots=True)
class EntryChange:
    kind: Kind
    name: str
    change: Literal["added", "changed", "removed"]
    requesters: list[str]  # the last ones
    lost: tuple[str, ...] = ()  # of one that was changed: the facts that no longer hold
    gained: tuple[str, ...] = ()


def bookkeeping_changes(old: Json, new: Json) -> tuple[EntryChange, ...]:
    changes, kinds = list[EntryChange](), get_args(Kind)
    for kind, was, now in ((kind, old[f"{kind}s"], new[f"{kind}s"]) for kind in kinds):
        for name in sorted({*was, *now}):
            if name not in now:
                changes.append(EntryChange(kind, name, "removed", was[name]["requesters"]))
            elif name not in was:
                changes.append(EntryChange(kind, name, "added", now[name]["requesters"]))
            elif was[name] != now[name]:
                had, has = list(_facts(was[name], now[name])), list(_facts(now[name], was[name]))
                lost = tuple(fact for fact in had if fact not in has)
                gained = tuple(fact for fact in has if fact not in had)
                who = now[name]["requesters"]
                changes.append(EntryChange(kind, name, "changed", who, lost, gained))
    return tuple(changes)


def _facts(entry: Json, other: Json) -> Iterator[str]:
    yield from (f"requester {requester}" for requester in entry["requesters"])
    if "topics" in entry:
        yield f"from {entry['source']} to {entry['target']}"
        yield f"by {entry['type']}"
    else:
        yield f"on {entry['node']}"
        yield from (f"for {application}" for application in entry["applications"])
        yield f"version {entry['version']}"
        if entry["application_version"]:
            yield f"application version {entry['application_version']}"
        for version, requesters in entry["versions_asked"].items():
            yield f"version {version} for {', '.join(requesters)}"
        yield from (f"{name} = {value}" for name, value in sorted(entry["parameters"].items()))
    others = _topics(other)
    for topic, requesters in sorted(_topics(entry).items()):
        yield topic
        # a requester that ``other`` lacks is not repeated here, because it is a fact above
        lasting = (who for who in requesters if topic in others and who in other["requesters"])
        yield from (f"{topic} for {who}" for who in lasting)


def _topics(entry: Json) -> _Requesters:
    inputs = {"topic": carried_topics(entry)} if "topics" in entry else entry["inputs"]
    return {
        f"{role} {topic}": requesters
        for role, topics in inputs.items()
        for topic, requesters in topics.items()
    }
