"""The nodes, and what uses each of them, as a list for people."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from demandops.config.inventory import Position
from demandops.config.node_property import PropertyValue
from demandops.demand.claim import Claim, requesters_of
from demandops.ledger.world import World
from demandops.plan.release import Release
from demandops.plan.views.demand_list import ids_of, nodes_of
from demandops.subject import SubjectKind


@dataclass(frozen=True, slots=True)
class UsedNode:
    """A node of the inventory or of a claim, and what uses the node.

    ``applications``, ``connections`` and ``requesters`` come from the claims that need the node.
    These include claims on applications that only read an input from the node.
    """

    name: str
    type: str | None
    cluster: str | None
    domain: str | None
    drained: bool
    capabilities: tuple[str, ...]
    properties: Mapping[str, PropertyValue]
    position: Position | None
    releases: tuple[str, ...]
    applications: tuple[str, ...]
    connections: tuple[str, ...]
    requesters: tuple[str, ...]


def nodes(world: World, releases: Iterable[Release]) -> list[UsedNode]:
    """Return every node, sorted by id; ``releases`` are all releases that run."""
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
            UsedNode(
                name=id,
                type=node.type if node else None,
                cluster=node.cluster if node else None,
                domain=domain.name if domain else None,
                drained=bool(node and node.drained),
                capabilities=node.capabilities if node else (),
                properties=node.properties if node else {},
                position=node.position if node else None,
                releases=tuple(sorted(running[id])),
                applications=tuple(sorted({*ids_of(claims, SubjectKind.APPLICATION)})),
                connections=tuple(sorted({*ids_of(claims, SubjectKind.CONNECTION)})),
                requesters=requesters_of(claims),
            )
        )
    return used
