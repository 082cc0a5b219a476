"""Placement: nodes for those applications and services for which a demand names no node.

The nodes are chosen before the booking, and only from the configuration and the claims at one
commit. A claim records a chosen node in the same field as a node that the demand names, so later
stages treat both alike.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import datetime, timezone
from types import MappingProxyType

from demandops.config.appdef import Service
from demandops.connections.connection import Connection
from demandops.demand import permission
from demandops.demand.application import Application
from demandops.demand.claim import Claim, demand_id
from demandops.demand.demand_request import AnyRequest, Demanded, DemandRequest, Put
from demandops.errors import Fault
from demandops.ledger.world import World
from demandops.plan.nodes.capacity import Room, Usage
from demandops.plan.nodes.choice import (
    Choice,
    Chosen,
    Positions,
    joined,
    lacks,
    on_node,
    requirement_of,
    shares,
    with_overridden_nodes,
)
from demandops.quoting import quoted

_LAST = datetime.max.replace(tzinfo=timezone.utc)
"""The booking time of a claim that is not booked yet; it is later than any other booking time."""


Trial = Callable[[DemandRequest], bool]
"""A function that returns whether a request can be booked.

The request contains only applications that have a node already.
"""


_NOWHERE = Fault("no-node", "", "is refused whatever nodes are chosen")
"""Stands for the faults of a demand whose fixed part is refused; the caller knows these faults."""


def with_chosen_nodes(
    request: AnyRequest,
    world: World,
    usage: Usage,
    trial: Trial | None = None,
    checkpoint: Callable[[], None] = lambda: None,
) -> tuple[AnyRequest, list[Fault]]:
    """Return the request with a node for each application and service that is to be placed.

    A booked application or service stays on its node if the node still fits. If other demands hold
    it too, it stays even on a node that is drained or no longer permitted. Any other application or
    service gets the first node that fits and has room. ``placement`` in the settings decides the
    order of the nodes. Finally, services move to the nodes that overrides name.

    Args:
        request: the request.
        world: the claims and the configuration before the request.
        usage: what services request on each node in ``world``.
        trial: if given, a node is chosen only if ``trial`` returns ``True`` for the request with
            this node. It is not called for a node on which the application or service is booked
            already, nor for one on which another application has a service to share. First it is
            called for all that the demand leaves no choice for. If it returns ``False`` then, or
            for all nodes of an application or service, no more is placed.
        checkpoint: called at each step; it may raise an exception to end the search.

    Returns:
        The request, and the faults: of each application or service that gets no node, and of each
        node in the demand that lacks what is required or contradicts an existing claim.
    """
    if not request.adds_claims:
        return request, []
    faults: list[Fault] = []
    if needs_placement(request, world):
        request, faults = _placed(request, world, usage, trial, checkpoint)
    demanded = (
        replace(one, held=_overridden(one.held, world))
        if isinstance(one.held, Application)
        else one
        for one in request.demanded
    )
    return replace(request, demanded=tuple(demanded)), faults


def needs_placement(request: DemandRequest, world: World) -> bool:
    """Return whether nodes must be chosen or checked for a request.

    This is so if the request leaves the choice of a node to the generator. It is also so if a
    service of a requested application has a node of its own, in the request or in the ledger.
    """
    apps = (one.held for one in request.demanded if isinstance(one.held, Application))
    return any(
        app.place
        or app.services
        or _services_to_place(app, world)
        or ((booked := world.ledger.application(app.id)) and booked.services)
        for app in apps
    )


def _services_to_place(app: Application, world: World) -> list[Service]:
    services = world.config.services.get(app.appdef, {}).values()
    return [one for one in services if one.place and one.name not in app.named]


def _overridden(app: Application, world: World) -> Application:
    """Return an application with its services moved to the nodes that overrides name.

    If the application is booked already and its appdef and nodes do not change, its moved services
    stay on the booked nodes. Only a change of an override or a definition moves them again.
    """
    booked = world.ledger.application(app.id)
    if booked is not None and replace(app, moved=booked.moved).has_same_definition_and_nodes(
        booked
    ):
        return replace(app, moved=booked.moved)
    return with_overridden_nodes(app, world)


def _placed(
    request: AnyRequest,
    world: World,
    usage: Usage,
    trial: Trial | None,
    checkpoint: Callable[[], None],
) -> tuple[AnyRequest, list[Fault]]:
    """Return the request with chosen nodes, and a fault for each choice that failed.

    The applications get their nodes first, and then the services get theirs.
    """
    ledger, faults = world.ledger, list[Fault]()
    kept = [claim for subject in request.subjects() for claim in ledger.kept_claims(subject)]
    room = Room(world, usage, [*ledger.claims_of_demand(request.demand), *kept], checkpoint)
    demanded = [_with_named_service_nodes(one, world) for one in request.demanded]
    fixed = tuple(one for one in demanded if not _is_open(one.held))
    if trial is not None and fixed and not trial(replace(request, demanded=fixed)):
        return request, [_NOWHERE]
    for one in demanded:
        if isinstance(one.held, Application) and one.held.place is None:
            room.take(_claim(request, one))

    def suits(index: int) -> Callable[[Application], bool] | None:
        if trial is None:
            return None
        return lambda app: trial(_so_far(request, demanded, index, app))

    for index, one in enumerate(demanded):
        if isinstance(one.held, Application) and one.held.place is not None:
            if faults and trial is not None:
                return request, faults
            checkpoint()
            claims = (_claim(request, one),)
            choice = Choice(one, one.held.place, world, room, claims, suits=suits(index))
            placed = _with_node(request, one, choice)
            if isinstance(placed, Fault):
                faults.append(placed)
            else:
                demanded[index] = placed
                room.take(_claim(request, placed))
    for index, one in enumerate(demanded):
        if isinstance(one.held, Application) and one.held.node:
            if faults and trial is not None:
                return request, faults
            checkpoint()
            demanded[index], more = _with_services(request, one, world, room, suits(index))
            faults += more
    return replace(request, demanded=tuple(demanded)), faults


def _is_open(held: Application | Connection) -> bool:
    """Return whether the generator chooses the node of an application or of one of its services."""
    if not isinstance(held, Application):
        return False
    return held.place is not None or not all(held.services.values())


def _so_far(
    request: DemandRequest, demanded: list[Demanded], index: int, app: Application
) -> DemandRequest:
    """Return the request with the items of ``demanded``, except applications without a node.

    ``app`` takes the place of the application at ``index``.
    """
    listed = [*demanded[:index], replace(demanded[index], held=app), *demanded[index + 1 :]]
    placed = (one for one in listed if not isinstance(one.held, Application) or one.held.node)
    return replace(request, demanded=tuple(placed))


def _with_named_service_nodes(one: Demanded, world: World) -> Demanded:
    """Return an application whose services have only the nodes that the demand names."""
    if not isinstance(one.held, Application):
        return one
    services = {service.name: "" for service in _services_to_place(one.held, world)}
    services |= {name: one.held.services[name] for name in one.held.named}
    return replace(one, held=replace(one.held, services=MappingProxyType(services)))


def may_wait(request: DemandRequest, world: World, checkpoint: Callable[[], None]) -> bool:
    """Return whether a demand that lacks only room may wait.

    For each application and service to place, there must be a node that would fit if it had room.
    The node's access domain must let demands wait, and must ask for no approval. A demand that
    needs approval cannot wait, because a person approves only what can be booked at once.
    """
    for one in request.demanded:
        for choice in _choices(request, one, world):
            checkpoint()
            if not any(_waits_for(node, request, choice) for node in choice.nodes()):
                return False
    return True


def _waits_for(node: str, request: DemandRequest, choice: Choice) -> bool:
    config = choice.config
    if config.domain_of[node].when_full != "wait":
        return False
    app = on_node(choice.app, node, choice.service, choice.world)
    claim = _claim(request, replace(choice.one, held=app))
    changes: list[tuple[Claim | None, Claim | None]] = [(None, claim)]
    return not permission.approval_reasons(request, changes, config)


def _choices(request: DemandRequest, one: Demanded, world: World) -> Iterator[Choice]:
    """Yield a :class:`Choice` for an application and for each of its services to be placed.

    All nodes count as empty, so the choices show which nodes could ever fit.
    """
    if not isinstance(one.held, Application):
        return
    free, claims = Room(world, Usage(), ()), (_claim(request, one),)
    if one.held.place and not one.held.node:
        yield Choice(one, one.held.place, world, free, claims)
    for service in _services_to_place(one.held, world):
        yield Choice(one, requirement_of(service), world, free, claims, service)


def _claim(request: DemandRequest, one: Demanded) -> Claim:
    """Return the claim that a demanded application would get if it were booked last of all."""
    demand = request.demand or demand_id(request.id, one.requesters)
    return Claim(one.held.booked(), demand, request.id, one.requesters, _LAST)


def _with_node(request: DemandRequest, one: Demanded, choice: Choice) -> Demanded | Fault:
    app = choice.app
    if app.node:
        return _named(choice) or replace(one, held=replace(app, place=None))
    found = _booked(choice, request.demand)
    if found is None:
        positions = _positions(request)
        found = next(choice.candidates(positions), None) or choice.none_fits(positions)
    if isinstance(found, Fault):
        return found
    placed = f"application '{app.id}' is placed on {quoted(found.node)}, {found.why}"
    return replace(one, held=replace(app, node=found.node), placed=(placed,))


def _shared_node(app: Application, service: Service, world: World) -> str:
    """Return the node on which another application has a service instance that ``app`` can share.

    Return an empty text if there is no such instance. If a second instance ran on another node, the
    application's node would get the same outputs twice.
    """
    role = service.root or ""
    for topic in app.inputs.get(role, ()) if service.scope == "topic" else ():
        for claim in world.ledger.claims_reading(topic.source, topic.topic):
            other = world.ledger.application(claim.subject.id) or claim.application
            if other.id == app.id or not shares(service, app, other):
                continue
            if claim.application.inputs_from(role, topic.source, topic.topic):
                return other.chosen_node(service.name)
    return ""


def _unfit_named_nodes(one: Demanded, app: Application, world: World) -> Iterator[Fault]:
    """Yield a fault for each node that the demand names, if it lacks what its service requires."""
    for name in app.named:
        service = world.config.services.get(app.appdef, {}).get(name)
        node = world.config.nodes.get(app.services[name])
        if service and node and (lacking := list(lacks(node, requirement_of(service)))):
            message = (
                f"{quoted(node.id)} lacks {joined(lacking)}, which the service requires ('place' "
                f"in {service.file}); name another node, or name none for this service"
            )
            yield one.fault(f"services.{name}", message, code="no-node")


def _contradictions(one: Demanded, app: Application, claim: Claim) -> Iterator[Fault]:
    """Yield a fault for each service that is booked on another node than the demand names."""
    for name in app.named:
        current = claim.application.chosen_node(name)
        if current != app.services[name]:
            message = (
                f"{quoted(app.services[name])} contradicts an existing claim of "
                f"{', '.join(claim.requesters)}: service {name} of '{app.id}' is on node "
                f"'{current}'; name node '{current}', or use another application id"
            )
            yield one.fault(f"services.{name}", message, code="conflict")


def _positions(request: DemandRequest) -> Positions:
    return request.positions if isinstance(request, Put) else {}


def _named(choice: Choice) -> Fault | None:
    """Return the fault if the demand names a node that lacks what the demand requires."""
    node = choice.config.nodes.get(choice.app.node)
    # admission reports an unknown node
    lacking = list(lacks(node, choice.requirement)) if node else []
    if not lacking:
        return None
    message = (
        f"{quoted(choice.app.node)} lacks {joined(lacking)}; name another node, or leave out one "
        "of the fields 'node' and 'place'"
    )
    return choice.one.fault("place", message, code="no-node")


def _booked(choice: Choice, demand: str) -> Chosen | Fault | None:
    """Return the node on which the application of ``demand`` is booked already and stays.

    Return ``None`` if the generator may choose a node. Return a fault if another demand holds the
    application on a node that lacks what ``demand`` requires.
    """
    app, claims = choice.app, choice.world.ledger.claims_on(choice.app.subject)
    if not claims:
        return None
    id = claims[0].application.node
    node = choice.config.nodes.get(id)
    stays = Chosen(id, "where it is booked already")
    other = _of_another(claims, demand)
    if other is None:
        return stays if choice.fits(id) else None
    lacking = list(lacks(node, choice.requirement)) if node else []
    if not lacking:
        return stays
    message = (
        f"'{app.id}' is held by {', '.join(other.requesters)} on '{id}', which "
        f"lacks {joined(lacking)}; ask only for what '{id}' has, or use another application id"
    )
    return choice.one.fault("place", message, code="conflict")


def _of_another(claims: tuple[Claim, ...], demand: str) -> Claim | None:
    """Return the first claim of a demand other than ``demand``, or ``None``.

    A claim that an override keeps is of no demand.
    """
    return next((c for c in claims if c.demand != demand and not c.keeping_override), None)


def _with_services(
    request: DemandRequest,
    one: Demanded,
    world: World,
    room: Room,
    suits: Callable[[Application], bool] | None,
) -> tuple[Demanded, list[Fault]]:
    """Return a demanded application with its services on chosen nodes, and the faults.

    If another demand holds the application too, or if the request is a goal of the reference's
    action, services stay on the nodes on which they are booked.
    """
    app = one.held
    assert isinstance(app, Application)  # noqa: S101 - callers pass only applications
    claims, faults = world.ledger.claims_on(app.subject), list[Fault]()
    first = claims[0].application if claims and claims[0].application.appdef == app.appdef else None
    fixed = first if request.is_reference or _of_another(claims, request.demand) else None
    if fixed is not None:
        faults += _contradictions(one, app, claims[0])
        one = replace(one, held=replace(app, services=fixed.services))
        room.book([_claim(request, one)])
        return one, faults
    faults += _unfit_named_nodes(one, app, world)
    gone = {name for c in claims if c.demand == request.demand for name in c.application.named}
    stay = {*world.config.services.get(app.appdef, {})} - {*app.services} - gone
    booked = first.services if first else {}
    kept = {name: node for name, node in booked.items() if name in stay}
    one = replace(one, held=replace(app, services=MappingProxyType(kept | {**app.services})))
    for service in _services_to_place(app, world):
        claims = (_claim(request, one),)
        choice = Choice(one, requirement_of(service), world, room, claims, service, suits)
        known = first.services.get(service.name, "") if first else ""
        shared = _shared_node(choice.app, service, world)
        found: Chosen | Fault = Chosen(known, "where it is booked already")
        if not known or (known != shared and not choice.fits(known)):
            positions = _positions(request)
            found = (
                choice.chosen(shared, "where the service already runs for this topic")
                or next(choice.candidates(positions), None)
                or choice.none_fits(positions)
            )
        if isinstance(found, Fault):
            faults.append(found)
            continue
        text = f"service '{service.name}' of application '{app.id}' is placed on "
        told = f"{text}{quoted(found.node)}, {found.why}"
        held = on_node(choice.app, found.node, service, world)
        one = replace(one, held=held, placed=(*one.placed, told))
        room.newly_placed[found.node] += 1
        room.book([_claim(request, one)])
    return one, faults
