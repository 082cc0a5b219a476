"""Placement: the node of an application, if its demand says what the node must have instead.

It is decided before the booking, by the configuration and the claims at that commit alone. The
claim holds the node as if the demand had named it, so nothing after this knows the difference.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from math import fsum, inf

from demandops.config.config import NODES_FILE, Config
from demandops.config.inventory import Node, Position
from demandops.demand import permission
from demandops.demand.application import Application
from demandops.demand.demand_request import Demanded, DemandRequest, Put, Requirement
from demandops.errors import Fault, suggestion
from demandops.ledger.ledger import Ledger
from demandops.quoting import quoted

_MOST_SHOWN = 5


@dataclass(frozen=True, slots=True)
class _Chosen:
    """A node, and why it is this one, for people."""

    node: str
    why: str = ""


def with_chosen_nodes(
    request: DemandRequest, ledger: Ledger, config: Config
) -> tuple[DemandRequest, list[Fault]]:
    """Return the request with a node for each application that has a requirement.

    An application that is booked stays where it is, if the node has what is required. Otherwise it
    gets the node nearest to its sources; if positions are not known, the node with the fewest
    applications; of several such nodes, the one with the first id.

    Returns:
        The request, and a fault for each application that gets no node.
    """
    faults: list[Fault] = []
    demanded: list[Demanded] = []
    soon: Counter[str] = Counter()
    for one in request.demanded:
        if one.requirement is not None and isinstance(one.held, Application):
            choice = _Choice(request, one, one.held, one.requirement, ledger, config, soon)
            found = choice.named() if one.held.node else choice.booked() or choice.best()
            if isinstance(found, Fault):
                faults.append(found)
            else:
                soon[found.node] += 1
                held = replace(one.held, node=found.node)
                placed = f"is placed on {quoted(found.node)}, {found.why}" if found.why else ""
                one = replace(one, held=held, placed=placed)  # noqa: PLW2901
        demanded.append(one)
    return (replace(request, demanded=tuple(demanded)), faults) if demanded else (request, [])


@dataclass(frozen=True, slots=True)
class _Choice:
    """The choice of the node of one application; ``soon`` counts those of the same request."""

    request: DemandRequest
    one: Demanded
    app: Application
    requirement: Requirement
    ledger: Ledger
    config: Config
    soon: Mapping[str, int]

    def named(self) -> _Chosen | Fault:
        """Return the node that the demand names, if it has what the demand requires as well."""
        node = self.config.nodes.get(self.app.node)
        lacks = list(_lacks(node, self.requirement)) if node else []  # admission reports no node
        if not lacks:
            return _Chosen(self.app.node)
        message = (
            f"{quoted(self.app.node)} lacks {_joined(lacks)}; name another node, or leave out node "
            "or place"
        )
        return self.one.fault("place", message, code="no-node")

    def booked(self) -> _Chosen | Fault | None:
        """Return the node where the application is booked; ``None`` if it may get another one."""
        claims = self.ledger.claims_on(self.app.subject)
        if not claims:
            return None
        id = claims[0].application.node
        node, mine = self.config.nodes.get(id), self.request.demand
        stays = _Chosen(id, "where it is booked already")
        lacks = list(_lacks(node, self.requirement)) if node else []
        other = next((c for c in claims if c.demand != mine and not c.keeping_override), None)
        if other is None:
            fits = node and not lacks and not self._closed(node) and self._is_permitted(node)
            return stays if fits else None
        if not lacks:
            return stays
        message = (
            f"'{self.app.id}' is held by {', '.join(other.requesters)} on '{id}', which "
            f"lacks {_joined(lacks)}; ask for what that node has, or use another application id"
        )
        return self.one.fault("place", message, code="conflict")

    def best(self) -> _Chosen | Fault:
        """Return the first of the nodes that fit, or why none does."""
        nodes = self.config.nodes_by_role.get(self.requirement.role, ())
        fitting = [
            node
            for node in nodes
            if not any(_lacks(node, self.requirement)) and not self._closed(node)
        ]
        centre = self._centre()
        ranks = {node.id: self._rank(node, centre) for node in fitting}
        fitting.sort(key=lambda node: ranks[node.id])
        for place, node in enumerate(fitting):
            if self._is_permitted(node):
                nearest = ranks[node.id][0] < inf
                first = "the nearest to its sources" if nearest else "with the fewest applications"
                among = " that its requesters may use" if place else ""
                why = f"{first}{among} of {len(fitting)} nodes that fit"
                return _Chosen(node.id, why if len(fitting) > 1 else "the only node that fits")
        return self._none_fits({node.id for node in fitting}, centre)

    def _rank(self, node: Node, centre: Position | None) -> tuple[float, int, str]:
        """Return the order of a node: squared distance, applications there, id."""
        position, distance = self._position(node.id), inf
        if centre and position:
            distance = (position.x - centre.x) ** 2 + (position.y - centre.y) ** 2
        booked = self.ledger.applications_on.get(node.id) or 0
        return distance, booked + self.soon.get(node.id, 0), node.id

    def _centre(self) -> Position | None:
        """Return the middle of the sources whose position is known."""
        sources = sorted({topic.source for _, topic in self.app.all_inputs()})
        known = [position for source in sources if (position := self._position(source))]
        if not known:
            return None
        x, y = (fsum(getattr(one, axis) for one in known) / len(known) for axis in "xy")
        return Position(x=x, y=y)

    def _position(self, node: str) -> Position | None:
        """Return where a node is, by the inventory, else by the demand."""
        listed = self.config.nodes.get(node)
        said = self.request.positions if isinstance(self.request, Put) else {}
        return (listed.position if listed else None) or said.get(node)

    def _closed(self, node: Node) -> str:
        """Return why no application may be placed on a node, or an empty text."""
        if node.drained:
            return "is drained"
        return "" if node.id in self.config.domain_of else "is in no access domain"

    def _is_permitted(self, node: Node) -> bool:
        return permission.may_place(self.one, self.app.appdef, node.id, self.config)

    def _none_fits(self, not_permitted: set[str], centre: Position | None) -> Fault:
        """Return the refusal, with the nodes that miss the least first."""
        role, roles = self.requirement.role, self.config.nodes_by_role.keys() - {""}
        if role and role not in roles:
            message = f"no node has the role {quoted(role)}{suggestion(role, roles)}"
            return self.one.fault("place", message, code="no-node")
        misses: list[tuple[int, tuple[float, int, str], str]] = []
        for node in self.config.nodes_by_role.get(role, ()):
            lacks = list(_lacks(node, self.requirement))
            reasons = [f"lacks {_joined(lacks)}"] if lacks else []
            reasons += filter(None, [self._closed(node)])
            if node.id in not_permitted:
                domain = self.config.domain_of[node.id].name
                reasons.append(f"is in access domain '{domain}', which does not permit it")
            text = f"'{node.id}' {_joined(reasons)}"
            count = len(lacks) + len(reasons) - bool(lacks)
            misses.append((count, self._rank(node, centre), text))
        shown = [text for _, _, text in sorted(misses)[:_MOST_SHOWN]]
        more = [f"{len(misses) - len(shown)} more do not"] if len(misses) > len(shown) else []
        message = (
            f"no node fits: {'; '.join([*shown, *more]) or 'there is none'}; ask for less, or have "
            f"{self.config.place_of(NODES_FILE)} changed"
        )
        return self.one.fault("place", message, code="no-node")


def _lacks(node: Node, requirement: Requirement) -> Iterator[str]:
    """Yield what a node does not have of what is required."""
    if requirement.role not in ("", node.type):
        yield f"the role {quoted(requirement.role)}"
    labels = node.labels() if requirement.labels else {}
    for key, value in requirement.labels:
        if labels.get(key) != value:
            yield f"the label {quoted(f'{key}={value}')}"
    for capability in requirement.capabilities:
        if capability not in node.capabilities:
            yield f"the capability {quoted(capability)}"


def _joined(reasons: list[str]) -> str:
    *first, last = reasons
    return f"{', '.join(first)} and {last}" if first else last
