"""Demands and nodes as lists for people."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

from demandops.base.naming import SubjectKind
from demandops.decide.planning.overrides import suspended_by
from demandops.model.config.config import Config
from demandops.model.demand.demand import Lease
from demandops.model.ledger.claim import Claim, requesters_of
from demandops.model.ledger.ledger import World
from demandops.model.ledger.records import WaitingDemand
from demandops.model.release import Release

# ---- the demands that hold something or wait for room, and the overrides that keep claims ----

# The state of a claim or of a demand. A claim is held by its demand, kept by an override, or
# suspended by an override. A demand has the state of its claims. If the states of its claims
# differ, the demand is partly suspended. If it waits for room, it has no claims.
State = Literal["held", "kept", "suspended", "partly suspended", "waiting"]


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldDemand:
    name: str
    state: State
    requests: tuple[str, ...]
    requesters: tuple[str, ...]
    applications: tuple[str, ...] = ()
    connections: tuple[str, ...] = ()
    nodes: tuple[str, ...] = ()
    domains: tuple[str, ...] = ()
    since: datetime
    lease: Lease | None = None  # the first that ends
    suspended_by: tuple[str, ...] = ()


def state_of(claim: Claim, world: World) -> State:
    if suspended_by(claim, world) is not None:
        return "suspended"
    return "kept" if claim.keeping_override else "held"


def domains_of(nodes: Iterable[str], config: Config) -> tuple[str, ...]:
    return tuple(sorted({config.domain_of[id].name for id in nodes if id in config.domain_of}))


def nodes_of(claim: Claim) -> tuple[str, ...]:
    held = claim.held
    if claim.is_on_application:
        sources = (topic.source for _, topic in claim.application.all_inputs())
        delivered = (delivery.node for delivery in claim.application.deliver)
        return tuple(sorted({*held.nodes, *sources, *delivered}))
    return tuple(sorted({*held.nodes, *filter(None, (claim.connection.broker,))}))


def demands(world: World) -> list[HeldDemand]:
    by_demand: defaultdict[str, list[Claim]] = defaultdict(list)
    for claim in world.ledger:
        by_demand[claim.demand].append(claim)
    entries = [held_demand(claims, world) for claims in by_demand.values()]
    entries += [waiting_demand(demand) for demand in world.ledger.waiting.values()]
    return sorted(entries, key=lambda entry: (entry.since, entry.name))


def held_demand(claims: Sequence[Claim], world: World) -> HeldDemand:
    states = {state_of(claim, world) for claim in claims}
    (state,) = states if len(states) == 1 else ("partly suspended",)
    suspending = filter(None, (suspended_by(claim, world) for claim in claims))
    nodes = {node for claim in claims for node in nodes_of(claim)}
    leases = [claim.lease for claim in claims if claim.lease]
    return HeldDemand(
        name=claims[0].demand,
        state=state,  # type: ignore[arg-type]  # one of the words
        requests=tuple(sorted({claim.request for claim in claims})),
        requesters=requesters_of(claims),
        applications=tuple(ids_of(claims, SubjectKind.APPLICATION)),
        connections=tuple(ids_of(claims, SubjectKind.CONNECTION)),
        nodes=tuple(sorted(nodes)),
        domains=domains_of(nodes, world.config),
        since=min(claim.booked for claim in claims),
        lease=min(leases, key=lambda lease: lease.until) if leases else None,
        suspended_by=tuple(sorted({override.path for override in suspending})),
    )


def waiting_demand(demand: WaitingDemand) -> HeldDemand:
    return HeldDemand(
        name=demand.demand,
        state="waiting",
        requests=(demand.put.id,),
        requesters=demand.requesters,
        since=demand.since,
    )


def ids_of(claims: Iterable[Claim], kind: SubjectKind) -> Iterator[str]:
    yield from sorted(claim.subject.id for claim in claims if claim.subject.kind is kind)


# ---- the nodes, and what uses each of them ----


def nodes(world: World, releases: Iterable[Release]) -> list[dict[str, Any]]:
    # those of the inventory and of claims, and what uses each, if only as a source of inputs
    running: defaultdict[str, list[str]] = defaultdict(list)
    for release in releases:
        running[release.node.id].append(release.name)
    needing: defaultdict[str, list[Claim]] = defaultdict(list)
    for claim in world.ledger:
        for id in nodes_of(claim):
            needing[id].append(claim)
    inventory = world.config.nodes
    used = []
    # A claim may need a node that a person removed from the inventory.
    for id in sorted({*inventory, *needing}):
        node, domain, claims = inventory.get(id), world.config.domain_of.get(id), needing[id]
        used.append(
            {
                "name": id,
                "type": node.type if node else None,
                "cluster": node.cluster if node else None,
                "domain": domain.name if domain else None,
                "drained": bool(node and node.drained),
                "capabilities": node.capabilities if node else (),
                "properties": dict(node.properties) if node else {},
                "position": node.position.model_dump() if node and node.position else None,
                "releases": sorted(running[id]),
                "applications": sorted({*ids_of(claims, SubjectKind.APPLICATION)}),
                "connections": sorted({*ids_of(claims, SubjectKind.CONNECTION)}),
                "requesters": requesters_of(claims),
            }
        )
    return used
