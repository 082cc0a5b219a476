"""Placement: a search for nodes, with the decision itself as the test of each node.

It chooses nodes for those applications and services for which a demand names none. A claim records
a chosen node in the same field as a node that the demand names, so booking and planning treat both
alike.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from typing import Generic, TypeVar

from demandops.base.errors import Fault, OverBudget, Refused, fault
from demandops.base.quoting import quoted
from demandops.decide.admission import permission
from demandops.decide.checks.forbidden import NoRoom, Usage
from demandops.decide.placement import candidates
from demandops.decide.placement.candidates import (
    NO_ROOM,
    Choice,
    Chosen,
    Room,
    joined,
    lacks,
    requirement_of,
)
from demandops.decide.state import State
from demandops.model.config.appdef import Service
from demandops.model.demand.demand import Application, Demand, Item
from demandops.model.demand.goals import items_of
from demandops.model.ledger.claim import Claim
from demandops.model.ledger.ledger import ClaimChange, World

_Result = TypeVar("_Result")

# Carries out a request, in which some applications may be missing, together with the faults of the
# search: returns the decision so far, or raises Refused.
Attempt = Callable[[Demand, Sequence[Fault]], _Result]

# The codes of faults that might not occur if other nodes were chosen for the demand
_BY_NODE = frozenset(
    ("not-allowed", "quota", "denied", "conflict", "unsupported-connection-type", "no-broker")
)
# How many bookings one demand, or one drain of a node, may attempt while nodes are looked for. Each
# attempt books all that is placed so far. So the attempts of one demand together may also book no
# more items than the largest demand may list.
MOST_ATTEMPTS = 64


def search(
    request: Demand, state: State, attempt: Attempt[_Result], checkpoint: Callable[[], None]
) -> _Result:
    """Return what the attempt returns with the first nodes with which it is not refused.

    A booked application or service stays on its node if the node still fits. If other demands hold
    it too, it stays even on a node that is drained or no longer permitted. Any other application or
    service gets the first node that fits, has room and is not refused. The first attempt has the
    best node for each. Only if it is refused for a reason that other nodes may not give, the
    applications and services are placed one by one, each with attempts of its own.

    ``checkpoint`` is called at each step; it may raise an exception to end the search.
    """
    # A service with a node of its own, in the request or in the ledger, needs its node checked.
    is_open = any(
        app.place
        or app.services
        or _services_to_place(app, state)
        or ((booked := state.ledger.application(app.id)) and booked.services)
        for app in request.applications
    )
    if not request.adds_claims or not is_open:
        return attempt(request, ())
    places = _Places(request, state, attempt, checkpoint)
    placed, faults = places.placed()
    try:
        return attempt(placed, faults)
    except Refused as refusal:
        full = refusal.full.keys() if isinstance(refusal, NoRoom) else ()
        chosen = (node for app in placed.applications for node in app.chosen_nodes)
        nodes = {*map(state.config.host_of, chosen)}
        elsewhere = nodes & {*full} or all(each.code in _BY_NODE for each in refusal.faults)
        if faults or not elsewhere:
            raise
        first = refusal
    try:
        return places.one_by_one()
    except OverBudget as spent:
        # with the faults of the first refusal: they tell the requester what to change
        raise Refused([fault("", str(spent), code="too-large"), *first.faults]) from None
    except Refused as refusal:
        lacks_room = isinstance(first, NoRoom) and all(f.code == NO_ROOM for f in refusal.faults)
        raise refusal if lacks_room else first from None


def _services_to_place(app: Application, world: World) -> list[Service]:
    services = world.config.services.get(app.appdef, {}).values()
    return [service for service in services if service.place and service.name not in app.named]


class _Places(Generic[_Result]):
    """The nodes of one request's applications and services, chosen one after another."""

    def __init__(
        self,
        request: Demand,
        state: State,
        attempt: Attempt[_Result],
        checkpoint: Callable[[], None],
    ) -> None:
        self._state, self._attempt, self._checkpoint = state, attempt, checkpoint

        def opened(app: Application) -> Application:
            services = {service.name: "" for service in _services_to_place(app, state)}
            return replace(
                app, services=services | {name: app.services[name] for name in app.named}
            )

        self._request = request.with_each(opened)
        self._demanded, self._faults = [*self._request.demanded], list[Fault]()
        self._room = self._whole_room()
        self._one_by_one = False
        self._attempts = self._items = 0
        # what was tried last with success, and what the attempt returned
        self._last: tuple[tuple[Item, ...], _Result] | None = None

    def _whole_room(self) -> Room:
        request, ledger = self._request, self._state.ledger
        kept = (each for subject in request.subjects() for each in ledger.kept_claims(subject))
        own = [*ledger.claims_with("demand", request.demand), *kept]
        nodes = {node for c in own if c.is_on_application for node in c.application.needed_nodes()}
        placed = Counter(app.node for app in request.applications if app.node)
        return Room(self._state, self._state.usage, nodes, placed=placed)

    def placed(self) -> tuple[Demand, list[Fault]]:
        """Return the request with the best node for each application and service, and the faults.

        The choices follow one another. What is chosen first is not changed for the sake of what
        comes later. Services come after all applications, because a service runs on its
        application's node if it can.
        """
        positions = self._request.positions
        for index, item in enumerate(self._demanded):
            if not isinstance(item.held, Application) or (place := item.held.place) is None:
                continue
            with self._faults_noted():
                choice = Choice(item, place, self._room, None, positions)
                if not item.held.node:
                    self._take(index, choice, _booked(choice, self._request.demand))
                    continue
                # ``node`` and ``place`` together are a check of the named node, and no preference.
                node = choice.config.nodes.get(item.held.node)
                # admission reports an unknown node
                if node and (lacking := list(lacks(node, place))):
                    message = (
                        f"{quoted(node.id)} lacks {joined(lacking)}; name another node, or leave "
                        "out one of the fields 'node' and 'place'"
                    )
                    raise Refused([item.fault("place", message, code="no-node")])
                self._demanded[index] = replace(item, held=replace(item.held, place=None))
        for index, item in enumerate(self._demanded):
            if not isinstance(item.held, Application) or not item.held.node:
                continue
            for service in self._services_left(index, item, item.held):
                with self._faults_noted():
                    so_far, required = self._demanded[index], requirement_of(service)
                    choice = Choice(so_far, required, self._room, service, positions)
                    first = self._booked_as(choice.app)
                    here = first.services.get(service.name, "") if first else ""
                    shared = _shared_node(choice.app, service, self._state)
                    chosen = None
                    if here and (here == shared or choice.fits(here)):
                        chosen = Chosen(here, "where it is booked already")
                    elif shared and choice.has_room(shared):
                        chosen = Chosen(shared, "where the service already runs for this topic")
                    self._take(index, choice, chosen)
        return replace(self._request, demanded=tuple(self._demanded)), self._faults

    @contextmanager
    def _faults_noted(self) -> Iterator[None]:
        self._checkpoint()
        try:
            yield
        except Refused as refusal:
            if self._one_by_one:
                raise
            self._faults += refusal.faults

    def one_by_one(self) -> _Result:
        """Return what the attempt returns for nodes that are attempted one after another."""
        self._demanded, self._room = list(self._request.demanded), self._whole_room()
        self._one_by_one = True
        # What leaves no choice is tried first and alone. If that is refused, no node helps.
        fixed = tuple(
            item
            for item in self._demanded
            if not isinstance(item.held, Application)
            or (item.held.place is None and all(item.held.services.values()))
        )
        if fixed:
            self._last = fixed, self._tried(fixed)
        request, _ = self.placed()
        if self._last and self._last[0] == request.demanded:
            return self._last[1]
        return self._tried(request.demanded)

    def _services_left(self, index: int, item: Item, app: Application) -> list[Service]:
        """Return the services that still need a node; those that are named or booked get theirs."""
        request, ledger, config = self._request, self._state.ledger, self._state.config
        claims, first = ledger.claims_on(app.subject), self._booked_as(app)
        if first and (request.is_reference or _of_another(claims, request.demand)):
            # What others hold stays where it is. So does what a goal of the reference's action
            # holds: its connections are those that it lists, and would not follow.
            for name in app.named:
                node = first.chosen_node(name)
                if node != app.services[name]:
                    message = (
                        f"{quoted(app.services[name])} contradicts an existing claim of "
                        f"{', '.join(claims[0].requesters)}: service {name} of '{app.id}' is on "
                        f"node '{node}'; name node '{node}', or use another application id"
                    )
                    self._faults.append(item.fault(f"services.{name}", message, code="conflict"))
            # A service that the claim does not place runs with its application. To name that node
            # changes nothing, and is not recorded, because all claims on an application say the
            # same.
            named = tuple(name for name in app.named if name in first.services)
            held = replace(app, services=first.services, named=named)
            self._demanded[index] = replace(item, held=held)
            return []
        services = config.services.get(app.appdef, {})
        for name in app.named:
            wanted, definition = config.nodes.get(app.services[name]), services.get(name)
            if wanted and definition and (lacking := [*lacks(wanted, requirement_of(definition))]):
                message = (
                    f"{quoted(wanted.id)} lacks {joined(lacking)}, which the service requires "
                    f"('place' in {definition.file}); name another node, or name none for this "
                    "service"
                )
                self._faults.append(item.fault(f"services.{name}", message, code="no-node"))
        # A node that the demand named for a service and names no longer does not stay.
        no_longer_named = {
            name
            for claim in claims
            if claim.demand == request.demand
            for name in claim.application.named
        }
        stay = {*services} - {*app.services} - no_longer_named
        booked = first.services if first else {}
        kept = {name: node for name, node in booked.items() if name in stay}
        self._demanded[index] = replace(item, held=replace(app, services=kept | {**app.services}))
        return _services_to_place(app, self._state)

    def _booked_as(self, app: Application) -> Application | None:
        booked = self._state.ledger.application(app.id)
        return booked if booked and booked.appdef == app.appdef else None

    def _take(self, index: int, choice: Choice, chosen: Chosen | None) -> None:
        """Put the application or service on ``chosen``, or else on the first node that will do."""

        def attempt(chosen: Chosen) -> None:
            if self._one_by_one:
                demanded = [*self._demanded]
                demanded[index] = choice.on(chosen)
                # Applications that get their node later are left out.
                placed = tuple(
                    each
                    for each in demanded
                    if not isinstance(each.held, Application) or each.held.node
                )
                self._last = placed, self._tried(placed)

        if chosen is None:
            chosen, _ = choice.first(attempt)
            choice.take(chosen.node)
        self._demanded[index] = choice.on(chosen)

    def _tried(self, demanded: tuple[Item, ...]) -> _Result:
        request = replace(self._request, demanded=demanded)
        self._attempts += 1
        self._items += items_of(request)
        most = self._state.config.repo_settings.limits.demand_items
        if self._attempts > MOST_ATTEMPTS or self._items > most:
            raise OverBudget(
                "too many nodes would have to be tried for this demand; name a node for each "
                "application, or split the demand"
            )
        return self._attempt(request, ())


def may_wait(request: Demand, state: State, checkpoint: Callable[[], None]) -> bool:
    """Return whether a demand that lacks only room may wait.

    Each application and service needs a node that would fit, in a domain that lets demands wait.
    """
    for item in request.demanded:
        app = item.held
        if not isinstance(app, Application):
            continue
        room, choices = Room(state, Usage()), list[Choice]()
        if app.place and not app.node:
            choices.append(Choice(item, app.place, room))
        for service in _services_to_place(app, state):
            choices.append(Choice(item, requirement_of(service), room, service))
        for choice in choices:
            checkpoint()
            waiting = (
                choice.on(Chosen(node, "")).held.booked()
                for node in choice.nodes()
                if state.config.domain_of[node].when_full == "wait"
            )
            # judged, but not booked at any time
            claims = (
                Claim(held, "", request.id, item.requesters, datetime.max) for held in waiting
            )
            # A person approves only what can be booked at once, so what needs approval cannot wait.
            changes = (ClaimChange(None, claim) for claim in claims)
            if all(permission.approval(request, [each], state.config)[0] for each in changes):
                return False
    return True


def _shared_node(app: Application, service: Service, world: World) -> str:
    # Another application may have an instance to share. If a second instance ran on another node,
    # the application's node would get the same outputs twice.
    role = service.root or ""
    for topic in app.inputs.get(role, ()) if service.scope == "topic" else ():
        for claim in world.ledger.claims_with("takes", topic.source, topic.topic):
            other = world.ledger.application(claim.subject.id) or claim.application
            if other.id == app.id or not candidates.shares(service, app, other):
                continue
            if claim.application.inputs_from(role, topic.source, topic.topic):
                return other.chosen_node(service.name)
    return ""


def _booked(choice: Choice, demand: str) -> Chosen | None:
    """Return the booked node if it stays; raise Refused if it must but lacks something."""
    app, claims = choice.app, choice.room.world.ledger.claims_on(choice.app.subject)
    if not claims:
        return None
    id = claims[0].application.node
    node = choice.config.nodes.get(id)
    stays = Chosen(id, "where it is booked already")
    other = _of_another(claims, demand)
    # Only the demand that holds an application alone moves it, and only if the node no longer fits.
    # So an application does not follow a vehicle that drives past the nodes.
    if other is None:
        return stays if choice.fits(id) else None
    lacking = list(lacks(node, choice.requirement)) if node else []
    if not lacking:
        return stays
    message = (
        f"'{app.id}' is held by {', '.join(other.requesters)} on '{id}', which "
        f"lacks {joined(lacking)}; ask only for what '{id}' has, or use another application id"
    )
    raise Refused([choice.item.fault("place", message, code="conflict")])


def _of_another(claims: tuple[Claim, ...], demand: str) -> Claim | None:
    others = (claim for claim in claims if claim.demand != demand and not claim.keeping_override)
    return next(others, None)
