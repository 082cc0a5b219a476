"""The demands that hold something or wait for room, as a list for people.

An override that keeps claims is listed like a demand.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from demandops.config.config import Config
from demandops.demand.claim import Claim, requesters_of
from demandops.demand.lease import Lease
from demandops.ledger.waiting import WaitingDemand
from demandops.ledger.world import World
from demandops.plan.overrides.claim_overrides import suspended_by
from demandops.subject import SubjectKind

# The state of a claim or of a demand. A claim is held by its demand, kept by an override, or
# suspended by an override. A demand has the state of its claims. If the states of its claims
# differ, the demand is partly suspended. If it waits for room, it has no claims.
State = Literal["held", "kept", "suspended", "partly suspended", "waiting"]


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldDemand:
    """A demand and what it holds. Of the demand's leases, ``lease`` is the first that ends."""

    name: str
    state: State
    requests: tuple[str, ...]
    requesters: tuple[str, ...]
    applications: tuple[str, ...] = ()
    connections: tuple[str, ...] = ()
    nodes: tuple[str, ...] = ()
    domains: tuple[str, ...] = ()
    since: datetime
    lease: Lease | None = None
    suspended_by: tuple[str, ...] = ()


def state_of(claim: Claim, world: World) -> State:
    if suspended_by(claim, world) is not None:
        return "suspended"
    return "kept" if claim.keeping_override else "held"


def domains_of(nodes: Iterable[str], config: Config) -> tuple[str, ...]:
    """Return the access domains of nodes, sorted; a node without a domain is skipped."""
    return tuple(sorted({config.domain_of[id].name for id in nodes if id in config.domain_of}))


def nodes_of(claim: Claim) -> tuple[str, ...]:
    """Return the nodes that a claim needs, sorted.

    These include the sources of its inputs, the nodes to which it delivers, and its broker's node.
    """
    held = claim.held
    if claim.is_on_application:
        sources = (topic.source for _, topic in claim.application.all_inputs())
        delivered = (delivery.node for delivery in claim.application.deliver)
        return tuple(sorted({*held.nodes, *sources, *delivered}))
    return tuple(sorted({*held.nodes, *filter(None, (claim.connection.broker,))}))


def demands(world: World) -> list[HeldDemand]:
    """Return every demand, and each override that keeps claims, the oldest first."""
    by_demand: defaultdict[str, list[Claim]] = defaultdict(list)
    for claim in world.ledger:
        by_demand[claim.demand].append(claim)
    entries = [held_demand(claims, world) for claims in by_demand.values()]
    entries += [waiting_demand(demand) for demand in world.ledger.waiting.values()]
    return sorted(entries, key=lambda entry: (entry.since, entry.name))


def held_demand(claims: Sequence[Claim], world: World) -> HeldDemand:
    """Return the entry for a demand; ``claims`` are all claims that it holds."""
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
        requests=(demand.request,),
        requesters=tuple(sorted(demand.requesters)),
        since=demand.since,
    )


def ids_of(claims: Iterable[Claim], kind: SubjectKind) -> Iterator[str]:
    yield from sorted(claim.subject.id for claim in claims if claim.subject.kind is kind)
