"""The choice of one node: for an application, or for one of its services.

For a service whose definition has ``place``, a node is chosen separately. The application's node is
chosen if it fits. If it does not fit, the best other node that fits is chosen.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from math import fsum, inf

from demandops.base import strict_yaml
from demandops.base.errors import Fault, suggestion
from demandops.base.quoting import quoted
from demandops.decide.admission import permission
from demandops.decide.placement.capacity import Room
from demandops.decide.planning.overrides import with_overridden_nodes
from demandops.model.config import inventory
from demandops.model.config.appdef import Place, Service
from demandops.model.config.config import DOMAINS_FILE, NODES_FILE, Config
from demandops.model.config.inventory import Node, Position
from demandops.model.demand.demand import Application, Item, Requirement
from demandops.model.ledger.claim import Claim
from demandops.model.ledger.ledger import World

_MOST_SHOWN = 5
# After a booking failed on so many nodes, no other node is tried, because each trial takes time.
# The bound is a number and not a time, so every generator comes to the same end.
MOST_TRIED = 20
# The code of the fault if no node fits, but at least one node lacks only room. Such a demand may
# wait.
NO_ROOM = "no-room"


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
    identity = (app.appdef, app.node, app.own_version)
    return service.scope == "topic" and identity == (other.appdef, other.node, other.own_version)


@dataclass(frozen=True, slots=True)
class Choice:
    """The choice of a node for one application, or for one of its services.

    ``claims`` are those that the application would get; the chosen node replaces the node in them.
    ``suits`` returns whether the demand can be booked with the given application.
    """

    item: Item
    requirement: Requirement
    world: World
    room: Room
    claims: tuple[Claim, ...]
    service: Service | None = None
    suits: Callable[[Application], bool] | None = None
    # Those that the demand gives, by node id. A position in the inventory has precedence.
    positions: Mapping[str, Position] = field(default_factory=dict)

    @property
    def config(self) -> Config:
        return self.world.config

    @property
    def app(self) -> Application:
        assert isinstance(self.item.held, Application)  # noqa: S101 - only these are placed
        return self.item.held

    def fits(self, node: str) -> bool:
        """Return whether a node meets the requirement, accepts services and permits this demand."""
        entry = self.config.nodes.get(node)
        if entry is None or any(lacks(entry, self.requirement)):
            return False
        return not self._closed(entry) and self._is_permitted(entry)

    def candidates(self) -> Iterator[Chosen]:
        """Yield the nodes that fit, have room and pass :attr:`suits`, the best first."""
        fitting = self._fitting()
        centre = self._centre()
        fitting.sort(key=lambda node: self._rank(node, centre))
        skipped: dict[str, None] = {}
        tried = 0
        least: Mapping[str, int] | None = None
        # The checks that cost least come first. A trial of the whole booking comes last.
        for node in fitting:
            if node.capacity is not None and least is None:
                least = self.room.least(self._claims_on(node), self._name)
            if node.capacity is not None and self.room.is_full(node, least or {}):
                skipped["that have room"] = None
            elif not self._is_permitted(node):
                skipped["that its requesters may use"] = None
            elif self._shortage(node):
                skipped["that have room"] = None
            elif self.suits and not self.suits(
                on_node(self.app, node.id, self.service, self.world)
            ):
                skipped["on which the demand can be booked"] = None
                tried += 1
                if tried == MOST_TRIED:
                    return
            else:
                choose = self.config.repo_settings.placement
                merit = f"the one with the {'most' if choose == 'pack' else 'fewest'} applications"
                if self._is_home(node):
                    merit = "the node of its application"
                elif choose == "nearest" and self._distance(node, centre) < inf:
                    merit = "the nearest to its sources"
                only = f", counting only nodes {' and '.join(skipped)}" if skipped else ""
                why = f"{merit} among {len(fitting)} nodes that fit{only}"
                yield Chosen(node.id, why if len(fitting) > 1 else "the only node that fits")

    def chosen(self, node: str, why: str) -> Chosen | None:
        # :attr:`suits` is not asked here.
        entry = self.config.nodes.get(node)
        if entry is None or not self.fits(node) or self._shortage(entry):
            return None
        return Chosen(node, why)

    def nodes(self) -> list[str]:
        # The full ones count too.
        return [node.id for node in self._fitting() if self._is_permitted(node)]

    def _fitting(self) -> list[Node]:
        required, config = self.requirement, self.config
        traits = (*((name,) for name in required.capabilities), *required.label_pairs)
        # Of the nodes with each required trait, only the shortest list is searched.
        pools = [config.nodes_with.get(trait, ()) for trait in traits]
        return [
            node
            for node in min((config.nodes_by_role.get(required.role, ()), *pools), key=len)
            if not any(lacks(node, required)) and not self._closed(node)
        ]

    def _shortage(self, node: Node) -> list[str]:
        """Return, in words, each resource of which a node has too little; empty if it has room."""
        if node.capacity is None:
            return []
        return self.room.lacks(self._claims_on(node), node.id, self._name)

    @property
    def _name(self) -> str:
        return self.service.name if self.service else ""

    def _claims_on(self, node: Node) -> list[Claim]:
        return [
            replace(claim, held=on_node(claim.application, node.id, self.service, self.world))
            for claim in self.claims
        ]

    def _is_home(self, node: Node) -> bool:
        # A service on its application's node needs no connection to it.
        return self.service is not None and node.id == self.app.node

    def _rank(self, node: Node, centre: Position | None) -> tuple[bool, float, float, str]:
        distance = self._distance(node, centre)
        booked = self.world.ledger.applications_on.get(node.id) or 0
        booked += self.room.newly_placed[node.id]
        away = not self._is_home(node)
        # The id comes last, so that every generator and every replay chooses the same node.
        match self.config.repo_settings.placement:
            case "spread":
                return away, booked, distance, node.id
            case "pack":
                return away, -booked, distance, node.id
        return away, distance, booked, node.id

    def _distance(self, node: Node, centre: Position | None) -> float:
        position = self._position(node.id)
        if centre is None or position is None:
            return inf
        # Squared, because every machine computes this alike.
        return (position.x - centre.x) ** 2 + (position.y - centre.y) ** 2

    def _centre(self) -> Position | None:
        # the middle of the sources whose position is known
        sources = sorted({topic.source for _, topic in self.app.all_inputs()})
        placed = [at for source in sources if (at := self._position(source))]
        if not placed:
            return None
        x, y = (fsum(getattr(at, axis) for at in placed) / len(placed) for axis in "xy")
        return Position(x=x, y=y)

    def _position(self, node: str) -> Position | None:
        entry = self.config.nodes.get(node)
        return (entry.position if entry else None) or self.positions.get(node)

    def _closed(self, node: Node) -> str:
        if node.drained:
            return "is drained"
        return "" if node.id in self.config.domain_of else "is in no access domain"

    def _is_permitted(self, node: Node) -> bool:
        return permission.may_place(self.item, self.app.appdef, node.id, self.config)

    def none_fits(self) -> Fault:
        """Return the fault if no node fits: what nodes lack, first those that lack the least."""
        if unknown := next(unmet(self.requirement, self.config), ""):
            return self._fault(unknown, "no-node")
        centre, code = self._centre(), "no-node"
        misses: list[tuple[int, tuple[bool, float, float, str], str]] = []
        places = {self.config.place_of(NODES_FILE): None}
        for node in self.config.nodes_by_role.get(self.requirement.role, ()):
            missing = list(lacks(node, self.requirement))
            reasons = [f"lacks {joined(missing)}"] if missing else []
            reasons += filter(None, [self._closed(node)])
            if not missing and node.id not in self.config.domain_of:
                places[self.config.place_of(DOMAINS_FILE)] = None
            if not reasons and not self._is_permitted(node):
                domain = self.config.domain_of[node.id].name
                reasons.append(f"is in access domain '{domain}', which does not permit this demand")
                places[self.config.place_of(DOMAINS_FILE)] = None
            elif not reasons and (shortage := self._shortage(node)):
                reasons, code = shortage, NO_ROOM
            elif not reasons:
                reasons.append("meets the requirement, but the demand would be refused there")
            text = f"'{node.id}' {joined(reasons)}"
            count = len(missing) + len(reasons) - bool(missing)
            misses.append((count, self._rank(node, centre), text))
        shown = [text for _, _, text in sorted(misses)[:_MOST_SHOWN]]
        hidden = len(misses) - len(shown)
        more = [f"{hidden} more {'are' if hidden > 1 else 'is'} not shown"] if hidden else []
        message = f"no node fits: {'; '.join([*shown, *more]) or 'the inventory has no node'}"
        less = f"change 'place' in {self.service.file}" if self.service else "ask for less"
        message += f"; {less}, or ask for a change of {' or '.join(places)}"
        return self._fault(message, code)

    def _fault(self, message: str, code: str) -> Fault:
        if self.service is None:
            return self.item.fault("place", message, code=code)
        return self.item.fault("type", f"{self.service.name}: {message}", code=code)


def unmet(requirement: Requirement, config: Config) -> Iterator[str]:
    """Yield a message for each part of a requirement that no node of the inventory can meet."""
    role, roles = requirement.role, config.nodes_by_role.keys() - {""}
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
    labels = node.labels() if requirement.labels else {}
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
