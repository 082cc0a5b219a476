"""Capacity: how much the running services request of each node, and how much the node has.

Each replica of a service requests resources of the node where the replica runs. The service's
definition says how much. A shared service counts once. Communication clients request nothing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from rpds import HashTrieMap

from demandops.base.errors import Fault, Refused, fault
from demandops.base.naming import Subject, SubjectKind
from demandops.decide.planning import release_keys
from demandops.decide.planning.planner import plan
from demandops.decide.planning.release_keys import ReleaseKey
from demandops.model.config.config import NODES_FILE, Config
from demandops.model.config.inventory import Node, amount_of, amount_text
from demandops.model.ledger.claim import Claim
from demandops.model.ledger.ledger import ClaimChange, World
from demandops.model.release import Release, ServiceKey, ServiceRelease, most_replicas

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
    keys: dict[ReleaseKey, None] = {}
    for subject in world.ledger.claims:
        if subject.kind is SubjectKind.APPLICATION:
            keys |= dict.fromkeys(release_keys.keys_of(world, subject))
    return Usage().plus(_requests(_plan_leniently(world, keys), world.config))


def growth(before: Plans, after: Plans, config: Config) -> dict[Need, int]:
    if not config.limits_capacity:
        return {}
    change = _requests(after, config)
    change.subtract(_requests(before, config))
    return {need: amount for need, amount in change.items() if amount}


def growth_by(before: World, after: World, changes: Iterable[ClaimChange]) -> dict[Need, int]:
    if not after.config.limits_capacity:
        return {}
    keys = release_keys.affected_keys(before, after, changes)
    planned = _plan_leniently(before, keys), _plan_leniently(after, keys)
    return growth(*planned, after.config)


def _plan_leniently(world: World, keys: Iterable[ReleaseKey]) -> Plans:
    planned: dict[ReleaseKey, Release | None] = {}
    for key in keys:
        try:
            planned[key] = plan(world, key)
        except Refused:  # a release that cannot be planned requests nothing
            planned[key] = None
    return planned


def _requests(plans: Plans, config: Config) -> Counter[Need]:
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
        node = config.nodes.get(id)
        most = node.most(resource) if node else None
        used = usage.of(id, resource)
        # Only growth is refused. If a person lowers a capacity below what is used, no demand is
        # stopped that adds nothing there.
        if most is None or amount <= 0 or used + amount <= most:
            continue
        free, capacity = (amount_text(each, resource) for each in (max(most - used, 0), most))
        asked = amount_text(amount, resource)
        yield id, f"has {free} of {capacity} {resource} free, but {asked} is asked for"


def faults(usage: Usage, grown: Mapping[Need, int], config: Config) -> Iterator[Fault]:
    for node, excess in excesses(usage, grown, config):
        message = (
            f"'{node}' {excess}; choose another node, release something first, or ask "
            f"for a change of {config.place_of(NODES_FILE)}"
        )
        yield fault("", message, code="capacity")


class Room:
    """The room that nodes have left while the applications of a demand are placed one by one.

    The claims in ``given_back`` count as released, so the room that they took is free.
    ``checkpoint`` is called before each step that plans releases; it may raise an exception.
    """

    def __init__(
        self,
        world: World,
        usage: Usage,
        given_back: Iterable[Claim] = (),
        checkpoint: Callable[[], None] = lambda: None,
    ) -> None:
        self._world, self._usage, self._checkpoint = world, usage, checkpoint
        self._least: dict[tuple[Subject, str], dict[str, int]] = {}
        # How many applications and services were placed on each node so far.
        self.newly_placed: Counter[str] = Counter()
        self.book((claim for claim in given_back if claim.is_on_application), give_back=True)

    def take(self, claim: Claim) -> None:
        self.newly_placed[claim.application.node] += 1
        self.book([claim])

    def book(self, claims: Iterable[Claim], *, give_back: bool = False) -> None:
        if self._world.config.limits_capacity:
            self._world, grown = self._after(claims, give_back=give_back)
            self._usage = self._usage.plus(grown)

    def lacks(self, claims: Sequence[Claim], node: str, service: str) -> list[str]:
        """Return, in words, the resources of which a node has too little for an application.

        ``claims`` are those to book for the application on ``node``. If ``service`` is not empty,
        only this service is placed there. An application that cannot be planned lacks nothing.
        """
        host = self._world.config.host_of(node)
        least = {(host, resource): most for resource, most in self.least(claims, service).items()}
        short = [excess for _, excess in excesses(self._usage, least, self._world.config)]
        if short:
            return short
        # What the application needs is tried, not estimated: it is booked in memory and planned.
        _, grown = self._after(claims)
        exceeded = excesses(self._usage, grown, self._world.config)
        return [excess for id, excess in exceeded if id == host]

    def is_full(self, node: Node, needed: Mapping[str, int]) -> bool:
        host = self._world.config.host_of(node.id)
        return any(
            most is not None and self._usage.of(host, resource) + amount > most
            for resource, amount in needed.items()
            for most in [node.most(resource)]
        )

    def least(self, claims: Sequence[Claim], service: str) -> Mapping[str, int]:
        """Return what an application, or its ``service``, requests at least of its node.

        Services that it shares do not count, nor do services with a node of their own.
        """
        subject, world = claims[0].subject, self._world
        # Planning for each node takes long. This amount is the same on all nodes, so it is planned
        # once and rules out full nodes. It is unknown if overrides may make it depend on the node.
        if any(each.node or each.deny or each.replicas is not None for each in world.overrides):
            return {}
        if (subject, service) not in self._least:
            after, _ = self._booked(claims)
            apart = claims[0].application.services
            keys = [
                key
                for key in release_keys.keys_of_claims(after, claims)
                if isinstance(key, ServiceKey)
                and key.application is not None
                and (key.service == service if service else key.service not in apart)
            ]
            total: Counter[str] = Counter()
            requests = _requests(_plan_leniently(after, keys), after.config)
            for (_, resource), amount in requests.items():
                total[resource] += amount
            self._least[subject, service] = dict(total)
        return self._least[subject, service]

    def _booked(
        self, claims: Iterable[Claim], *, give_back: bool = False
    ) -> tuple[World, list[ClaimChange]]:
        ledger, changes = self._world.ledger, list[ClaimChange]()
        for claim in claims:
            change = ClaimChange(ledger.get(claim.key), None if give_back else claim)
            ledger = ledger.replace(claim.key, change.after)
            changes.append(change)
        return replace(self._world, ledger=ledger), changes

    def _after(
        self, claims: Iterable[Claim], *, give_back: bool = False
    ) -> tuple[World, Mapping[Need, int]]:
        """Return the world after the booking, and what services then request in addition."""
        self._checkpoint()
        after, changes = self._booked(claims, give_back=give_back)
        try:
            return after, growth_by(self._world, after, changes)
        except Refused:  # admission reports why the application cannot run
            return after, {}


def overcommitted(world: World, usage: Usage) -> Iterator[tuple[Node, str]]:
    for (id, resource), used in sorted(usage.amounts.items()):
        node = world.config.nodes.get(id)
        most = node.most(resource) if node else None
        if node and most is not None and used > most:
            used_text, most_text = amount_text(used, resource), amount_text(most, resource)
            yield node, f"services request {used_text} {resource}, but the node has {most_text}"
