"""The choice of one node: for an application, or for one of its services.

For a service whose definition has ``place``, a node is chosen separately. The application's node is
chosen if it fits. If it does not fit, the best other node that fits is chosen.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from heapq import nsmallest
from math import fsum, inf
from typing import TypeVar

from demandops.base import strict_yaml
from demandops.base.errors import Fault, Refused, suggestion
from demandops.base.quantities import amount_of
from demandops.base.quoting import quoted
from demandops.decide.admission import permission
from demandops.decide.checks import forbidden
from demandops.decide.checks.forbidden import Need, NoRoom, Usage
from demandops.decide.planning.flows import instances, version_of_instance
from demandops.decide.planning.overrides import with_overridden_nodes
from demandops.decide.planning.planner import is_needed
from demandops.model.config import inventory
from demandops.model.config.appdef import Place, Service
from demandops.model.config.config import DOMAINS_FILE, NODES_FILE, Config
from demandops.model.config.inventory import Node, Position
from demandops.model.demand.demand import Application, Item, Requirement
from demandops.model.ledger.ledger import World
from demandops.model.release import ServiceKey

_MOST_SHOWN = 5
# After an attempt failed on so many nodes, no other node is tried, because each attempt takes time.
# The bound is a number and not a time, so every generator comes to the same end.
MOST_TRIED = 20
# The code of the fault if no node fits, but at least one node lacks only room. Such a demand may
# wait.
NO_ROOM = "no-room"

_Result = TypeVar("_Result")


@dataclass(frozen=True, slots=True)
class Chosen:
    node: str
    why: str


def requirement_of(service: Service) -> Requirement:
    place = service.place or Place()
    return Requirement(
        place.role,
        tuple(sorted(f"{key}={value}" for key, value in place.labels.items())),
        tuple(sorted({*place.capabilities})),
        tuple(sorted(inventory.condition_texts(place.properties))),
    )


def on_node(app: Application, node: str, service: Service | None, world: World) -> Application:
    """Return an application with ``service``, or with all of itself, moved to ``node``."""
    if service is None:
        app = replace(app, node=node)
    else:
        app = replace(app, services={**app.services, service.name: node})
    return with_overridden_nodes(app, world)


def shares(service: Service, app: Application, other: Application) -> bool:
    # A separate instance of an application shares only with separate instances of its version.
    mine, its = ((a.appdef, a.node, version_of_instance(a, service)) for a in (app, other))
    return service.scope == "topic" and mine == its


@dataclass(slots=True)
class Room:
    """What is left while the applications of a demand are placed one after another.

    It only rules out nodes that are certainly full. The decision counts exactly.
    """

    world: World
    usage: Usage
    # The nodes on which a demand gives something back itself are not ruled out.
    given_back: Collection[str] = ()
    # What was placed so far: the instances that begin to run, and how many at each node
    started: set[ServiceKey] = field(default_factory=set)
    placed: Counter[str] = field(default_factory=Counter)


@dataclass(slots=True)
class Choice:
    """The choice of a node for one application, or for one of its services."""

    item: Item
    requirement: Requirement
    room: Room
    service: Service | None = None
    # Those that the demand gives, by node id. A position in the inventory has precedence.
    positions: Mapping[str, Position] = field(default_factory=dict)
    # The refusals on nodes that were tried in vain
    refused: dict[str, Refused] = field(default_factory=dict)
    _starting: dict[ServiceKey, dict[str, int]] | None = None

    @property
    def config(self) -> Config:
        return self.room.world.config

    @property
    def app(self) -> Application:
        assert isinstance(self.item.held, Application)  # noqa: S101 - only these are placed
        return self.item.held

    def on(self, chosen: Chosen) -> Item:
        """Return the demanded application on a node, with a sentence that says why."""
        what = f"application '{self.app.id}'"
        what = f"service '{self.service.name}' of {what}" if self.service else what
        placed = f"{what} is placed on {quoted(chosen.node)}, {chosen.why}"
        held = on_node(self.app, chosen.node, self.service, self.room.world)
        return replace(self.item, held=held, placed=(*self.item.placed, placed))

    def first(self, attempt: Callable[[Chosen], _Result]) -> tuple[Chosen, _Result]:
        """Return the best node on which the attempt is not refused, and what the attempt returns.

        If there is none, raise Refused with what nodes lack.
        """
        for chosen in self.candidates():
            try:
                return chosen, attempt(chosen)
            except Refused as refusal:
                self.refused[chosen.node] = refusal
            if len(self.refused) == MOST_TRIED:
                break
        raise Refused([self.none_fits()])

    def fits(self, node: str) -> bool:
        """Return whether a node meets the requirement, accepts services and permits this demand."""
        entry = self.config.nodes.get(node)
        if entry is None or any(lacks(entry, self.requirement)):
            return False
        return not self._closed(entry) and self._is_permitted(entry)

    def candidates(self) -> Iterator[Chosen]:
        """Yield the nodes that fit and seem to have room, the best first."""
        fitting = self._fitting()
        rank = self._rank()
        order = self.config.repo_settings.placement
        skipped: dict[str, None] = {}
        for node in sorted(fitting, key=rank):
            if any(self._excesses(node)):
                skipped["that have room"] = None
                continue
            if not self._is_permitted(node):
                skipped["that its requesters may use"] = None
                continue
            merit = f"the one with the {'most' if order == 'pack' else 'fewest'} applications"
            # a service on its application's node needs no connection to it
            if self.service is not None and node.id == self.app.node:
                merit = "the node of its application"
            elif order == "nearest" and rank(node)[1] < inf:
                merit = "the nearest to its sources"
            only = f", counting only nodes {' and '.join(skipped)}" if skipped else ""
            why = f"{merit} among {len(fitting)} nodes that fit{only}"
            yield Chosen(node.id, why if len(fitting) > 1 else "the only node that fits")
            full = self._shortage(node)  # as the decision counted on the node
            skipped["that have room" if full else "on which the demand can be booked"] = None

    def nodes(self) -> list[str]:
        # The full ones count too.
        return [node.id for node in self._fitting() if self._is_permitted(node)]

    def has_room(self, node: str) -> bool:
        entry = self.config.nodes.get(node)
        return entry is not None and self.fits(node) and not any(self._excesses(entry))

    def take(self, node: str) -> None:
        """Add the application or service to the load of a node, as later choices see it."""
        self.room.usage = self.room.usage.plus(self._growth(node))
        self.room.started |= {replace(key, node=node) for key in self._starting or ()}
        self.room.placed[node] += 1

    def _growth(self, node: str) -> dict[Need, int]:
        """Return what the instances that would begin to run on ``node`` request at least."""
        world, host = self.room.world, self.config.host_of(node)
        # The same on each node, so it is found only once, unless an override may move a service
        if self._starting is None or any(override.node for override in world.overrides):
            app = on_node(self.app, node, self.service, world)
            overridden = [each.replicas for each in world.overrides if each.replicas is not None]
            self._starting = {
                key: {
                    name: amount_of(quantity) * min([service.scaling.least, *overridden])
                    for name, quantity in service.requests.items()
                }
                for service in self.config.services.get(app.appdef, {}).values()
                if service.requests and not service.at_source and not service.nodes
                if self.service in (None, service)
                for key in instances(app, service)
                if key.node == node
            }
        growth = dict[Need, int]()
        for key, amounts in self._starting.items():
            shared = None if key.application else replace(key, node=node)
            if shared and (shared in self.room.started or is_needed(world, shared)):
                continue
            for resource, amount in amounts.items():
                growth[host, resource] = growth.get((host, resource), 0) + amount
        return growth

    def _excesses(self, node: Node) -> Iterator[str]:
        if node.capacity is not None and node.id not in self.room.given_back:
            growth = self._growth(node.id)
            for _, excess in forbidden.excesses(self.room.usage, growth, self.config):
                yield excess

    def _shortage(self, node: Node) -> list[str]:
        """Return, in words, each resource of which a node has too little; empty if it has room."""
        refusal = self.refused.get(node.id)
        if refusal is not None:
            full = refusal.full if isinstance(refusal, NoRoom) else {}
            return full.get(self.config.host_of(node.id), [])
        return [*self._excesses(node)]

    def _fitting(self) -> list[Node]:
        required = self.requirement
        traits = (*((name,) for name in required.capabilities), *required.label_pairs)
        role, wanted = required.role, {*required.capabilities}
        more = required.labels or required.properties
        return [  # there may be thousands, so what is cheap to see comes first
            node
            for node in self._searched(*traits)
            if not self._closed(node)
            and (not role or node.type == role)
            and not wanted.difference(node.capabilities)
            and not (more and any(lacks(node, required)))
        ]

    def _searched(self, *traits: tuple[str, ...]) -> tuple[Node, ...]:
        # Of the nodes with the role and with each trait, the shortest list. Of those that nobody
        # listed, only the application's own may have one of its services.
        traits = (("", self.requirement.role), *traits)
        listed = [self.config.nodes_with.get(trait, ()) for trait in traits]
        home = self.config.nodes.get(self.app.node) if self.service else None
        unlisted = (home,) if home and home.id not in self.config.kinds else ()
        return (*unlisted, *min(listed, key=len))

    def _rank(self) -> Callable[[Node], tuple[bool, float, float, str]]:
        positions, order = self.positions, self.config.repo_settings.placement
        # the middle of the sources whose position is known
        sources = sorted({topic.source for _, topic in self.app.all_inputs()})
        known = [self.config.nodes.get(source) for source in sources]
        placed = [
            at
            for source, node in zip(sources, known, strict=True)
            if (at := (node.position if node else None) or positions.get(source))
        ]
        x, y = (fsum(getattr(at, axis) for at in placed) / (len(placed) or 1) for axis in "xy")
        applications_on, placed_on = self.room.world.ledger.applications_on, self.room.placed
        home = self.app.node
        is_service = self.service is not None

        def rank(node: Node) -> tuple[bool, float, float, str]:
            id, at = node.id, node.position
            if at is None and positions:
                at = positions.get(id)
            # Squared, because every machine computes this alike.
            distance = (at.x - x) ** 2 + (at.y - y) ** 2 if at and placed else inf
            booked = (applications_on.get(id) or 0) + placed_on[id]
            away = not (is_service and id == home)
            # The id comes last, so that every generator and every replay chooses the same node.
            if order == "nearest":
                return away, distance, booked, id
            return away, -booked if order == "pack" else booked, distance, id

        return rank

    def _closed(self, node: Node) -> str:
        if node.drained:
            is_gone = self.config.host_of(node.id) in self.config.gone_since
            return "is gone from its cluster" if is_gone else "is drained"
        return "" if node.id in self.config.domain_of else "is in no access domain"

    def _is_permitted(self, node: Node) -> bool:
        return permission.may_place(self.item, node.id, self.config)

    def none_fits(self) -> Fault:
        """Return the fault if no node fits: why, beginning with the nodes that nearly fit."""
        where, what = ("type", f"{self.service.name}: ") if self.service else ("place", "")
        if unknown := next(unmet(self.requirement, self.config), ""):
            return self.item.fault(where, what + unknown, code="no-node")
        rank, codes = self._rank(), set[str]()
        misses: list[tuple[int, tuple[bool, float, float, str], str]] = []
        places = {self.config.place_of(NODES_FILE): None}
        for node in self._searched():
            missing = list(lacks(node, self.requirement))
            reasons = [f"lacks {joined(missing)}"] if missing else []
            reasons += filter(None, [self._closed(node)])
            # What lacks nothing comes first: it is only full, or a rule is in the way.
            lacking = len(missing) + len(reasons) - bool(missing)
            if not missing and node.id not in self.config.domain_of:
                places[self.config.place_of(DOMAINS_FILE)] = None
            if not reasons and not self._is_permitted(node):
                domain = self.config.domain_of[node.id].name
                reasons.append(f"is in access domain '{domain}', which does not permit this demand")
                places[self.config.place_of(DOMAINS_FILE)] = None
            elif not reasons and (reasons := self._shortage(node)):
                codes.add(NO_ROOM)
            elif not reasons:
                codes.add("no-node")  # more room alone would not help
                refusal = self.refused.get(node.id)
                why = f": {refusal.faults[0].message}" if refusal else ""
                reasons = [f"meets the requirement, but the demand would be refused there{why}"]
            misses.append((lacking, rank(node), f"'{node.id}' {joined(reasons)}"))
        shown = [text for *_, text in nsmallest(_MOST_SHOWN, misses)]
        hidden = len(misses) - len(shown)
        more = [f"{hidden} more {'are' if hidden > 1 else 'is'} not shown"] if hidden else []
        nothing = "the inventory lists none"
        if self.config.node_patterns:
            nothing += ", and one of a pattern is used only where a demand names it"
        message = f"{what}no node fits: {'; '.join([*shown, *more]) or nothing}"
        less = f"change 'place' in {self.service.file}" if self.service else "ask for less"
        message += f"; {less}, or ask for a change of {' or '.join(places)}"
        code = NO_ROOM if codes == {NO_ROOM} else "no-node"
        return self.item.fault(where, message, code=code)


def unmet(requirement: Requirement, config: Config) -> Iterator[str]:
    """Yield a message for each part of a requirement that no node of the inventory can meet."""
    role, roles = requirement.role, {node.type for node in config.kinds.values()}
    if role and role not in roles:
        yield f"no node has the role {quoted(role)}{suggestion(role, roles)}"
    kinds = config.property_kinds
    for text in requirement.properties:
        condition = inventory.read_condition(text)
        if condition is None:  # the form of the demand has a fault
            continue
        if condition.name not in kinds:
            remedy = (
                suggestion(condition.name, kinds) or f"; add it in {config.place_of(NODES_FILE)}"
            )
            yield f"no node has the property {quoted(condition.name)}{remedy}"
        elif problem := inventory.condition_problem(condition, kinds[condition.name][0]):
            yield problem


def lacks(node: Node, requirement: Requirement) -> Iterator[str]:
    if requirement.role not in ("", node.type):
        yield f"the role {quoted(requirement.role)}"
    labels = node.labels if requirement.labels else {}
    for key, value in requirement.label_pairs:
        if labels.get(key) != value:
            yield f"the label {quoted(f'{key}={value}')}"
    for capability in requirement.capabilities:
        if capability not in node.capabilities:
            yield f"the capability {quoted(capability)}"
    for text in requirement.properties:
        if not inventory.meets_condition(node.properties, text):
            condition = inventory.read_condition(text)
            actual = node.properties.get(condition.name) if condition else None
            has = "" if actual is None else f" (it has {strict_yaml.short_repr(actual)})"
            yield f"the property {quoted(text)}{has}"


def joined(reasons: list[str]) -> str:
    *first, last = reasons
    return f"{', '.join(first)} and {last}" if first else last
