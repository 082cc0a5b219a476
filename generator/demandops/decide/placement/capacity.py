"""Capacity: how much the running services request of each node, and how much the node has.

Each replica of a service requests resources of the node where the replica runs. The service's
definition says how much. A shared service counts once. Communication clients request nothing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field

from rpds import HashTrieMap

from demandops.base.errors import Refused, fault
from demandops.base.naming import SubjectKind
from demandops.base.quantities import amount_of, amount_text
from demandops.decide.planning import release_keys
from demandops.decide.planning.planner import plan
from demandops.decide.planning.release_keys import ReleaseKey
from demandops.model.config.config import NODES_FILE, Config
from demandops.model.ledger.ledger import ClaimChange, World
from demandops.model.release import Release, ServiceRelease, most_replicas

# The ids of a node and of a resource, as in ``("edge", "cpu")``.
Need = tuple[str, str]
Plans = Mapping[ReleaseKey, Release | None]


@dataclass(frozen=True, slots=True)
class Usage:
    """What services request on each node, for each resource, in thousandths of a unit."""

    # This map follows each demand by what the demand changes. Its copies share what stays the same.
    amounts: HashTrieMap[Need, int] = field(default_factory=HashTrieMap)

    def of(self, node: str, resource: str) -> int:
        return self.amounts.get((node, resource)) or 0

    def plus(self, growth: Mapping[Need, int]) -> Usage:
        amounts = self.amounts
        for need, amount in growth.items():
            total = self.of(*need) + amount
            amounts = amounts.insert(need, total) if total else amounts.discard(need)
        return Usage(amounts)


def whole_usage(world: World) -> Usage:
    """Return what all services request on each node; empty if no node declares a capacity."""
    if not world.config.limits_capacity:
        return Usage()
    apps = (each for each in world.ledger.claims if each.kind is SubjectKind.APPLICATION)
    keys = dict.fromkeys(key for app in apps for key in release_keys.keys_of(world, app))
    return Usage().plus(requests(_plan_leniently(world, keys), world.config))


def growth(before: Plans, after: Plans, config: Config) -> dict[Need, int]:
    if not config.limits_capacity:
        return {}
    change = requests(after, config)
    change.subtract(requests(before, config))
    return {need: amount for need, amount in change.items() if amount}


def growth_by(before: World, after: World, changes: Iterable[ClaimChange]) -> dict[Need, int]:
    if not after.config.limits_capacity:
        return {}
    keys = release_keys.affected_keys(before, after, changes)
    planned = _plan_leniently(before, keys), _plan_leniently(after, keys)
    return growth(*planned, after.config)


def _plan_leniently(world: World, keys: Iterable[ReleaseKey]) -> Plans:
    planned: dict[ReleaseKey, Release | None] = dict.fromkeys(keys)
    for key in planned:
        with suppress(Refused):  # a release that cannot be planned requests nothing
            planned[key] = plan(world, key)
    return planned


def requests(plans: Plans, config: Config) -> Counter[Need]:
    total: Counter[Need] = Counter()
    for release in plans.values():
        if isinstance(release, ServiceRelease) and release.service.requests:
            # A machine in several access domains has a node in each, but only one capacity.
            host, replicas = config.host_of(release.node.id), most_replicas(release.replicas)
            for resource, quantity in release.service.requests.items():
                total[host, resource] += amount_of(quantity) * replicas
    return total


def excesses(usage: Usage, grown: Mapping[Need, int], config: Config) -> Iterator[tuple[str, str]]:
    """Yield (node, reason) for each resource of which a node has too little for the growth."""
    for (id, resource), amount in sorted(grown.items()):
        node, used = config.nodes.get(id), usage.of(id, resource)
        most = node.most(resource) if node else None
        # Only growth is refused. If a person lowers a capacity below what is used, no demand is
        # stopped that adds nothing there.
        if most is not None and amount > 0 and used + amount > most:
            left = max(most - used, 0)
            free, capacity, asked = (amount_text(n, resource) for n in (left, most, amount))
            yield id, f"has {free} of {capacity} {resource} free, but {asked} is asked for"


class NoRoom(Refused):
    """Raised if a demand asks for more than nodes have; ``full`` says of what, by node."""

    def __init__(self, usage: Usage, grown: Mapping[Need, int], config: Config) -> None:
        self.full: dict[str, list[str]] = {}
        faults = []
        for node, excess in excesses(usage, grown, config):
            self.full.setdefault(node, []).append(excess)
            message = (
                f"'{node}' {excess}; choose another node, release something first, or ask "
                f"for a change of {config.place_of(NODES_FILE)}"
            )
            faults.append(fault("", message, code="capacity"))
        super().__init__(faults)
