"""Placement: nodes for those applications and services for which a demand names no node.

The nodes are chosen before the booking, and only from the configuration and the claims at one
commit. A claim records a chosen node in the same field as a node that the demand names, so later
stages treat both alike.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timezone

from demandops.base.errors import Fault
from demandops.base.quoting import quoted
from demandops.decide.admission import permission
from demandops.decide.placement import candidates
from demandops.decide.placement.candidates import Choice, Chosen, joined, lacks, requirement_of
from demandops.decide.placement.capacity import Room, Usage
from demandops.decide.planning.overrides import with_overridden_nodes
from demandops.model.config.appdef import Service
from demandops.model.demand.demand import AnyDemand, Application, Demand, Item
from demandops.model.ledger.claim import Claim, demand_id
from demandops.model.ledger.ledger import World

# The booking time of a claim that is not booked yet. It is later than any other booking time, as
# that of a new claim is, so ``merge: latest`` takes its parameters.
_LAST = datetime.max.replace(tzinfo=timezone.utc)

# Returns whether a request can be booked. All its applications have a node already.
Trial = Callable[[Demand], bool]

# Stands for the faults of a demand whose fixed part is refused; the caller knows these faults.
_NOWHERE = Fault("no-node", "", "is refused whatever nodes are chosen")


def with_chosen_nodes(
    request: AnyDemand,
    world: World,
    usage: Usage,
    trial: Trial | None,
    checkpoint: Callable[[], None],
) -> tuple[AnyDemand, list[Fault]]:
    """Return the request with a node for each application and service to place, and the faults.

    A booked application or service stays on its node if the node still fits. If other demands hold
    it too, it stays even on a node that is drained or no longer permitted. Any other application or
    service gets the first node that fits and has room. Finally, services move to the nodes that
    overrides name.

    If ``trial`` is given, a node is chosen only if ``trial`` returns ``True`` for the request with
    this node. It is not called for a node on which the application or service is booked already,
    nor for one on which another application has a service to share. ``checkpoint`` is called at
    each step; it may raise an exception to end the search.
    """
    if not request.adds_claims:
        return request, []
    faults: list[Fault] = []
    if needs_placement(request, world):
        request, faults = _placed(request, world, usage, trial, checkpoint)
    demanded = list(request.demanded)
    for index, item in enumerate(demanded):
        app = item.held
        if isinstance(app, Application):
            # The moved services of a booked application stay on the booked nodes. Only a change of
            # an override or of a definition moves them again, and not a further demand.
            booked = world.ledger.application(app.id)
            moved = replace(app, moved=booked.moved) if booked else app
            if booked is None or not moved.has_same_definition_and_nodes(booked):
                moved = with_overridden_nodes(app, world)
            demanded[index] = replace(item, held=moved)
    return replace(request, demanded=tuple(demanded)), faults


def needs_placement(request: Demand, world: World) -> bool:
    # A service with a node of its own, in the request or in the ledger, needs its node checked.
    apps = (item.held for item in request.demanded if isinstance(item.held, Application))
    return any(
        app.place
        or app.services
        or _services_to_place(app, world)
        or ((booked := world.ledger.application(app.id)) and booked.services)
        for app in apps
    )


def _services_to_place(app: Application, world: World) -> list[Service]:
    services = world.config.services.get(app.appdef, {}).values()
    return [service for service in services if service.place and service.name not in app.named]


def _placed(
    request: AnyDemand,
    world: World,
    usage: Usage,
    trial: Trial | None,
    checkpoint: Callable[[], None],
) -> tuple[AnyDemand, list[Fault]]:
    ledger, faults = world.ledger, list[Fault]()
    kept = [claim for subject in request.subjects() for claim in ledger.kept_claims(subject)]
    room = Room(world, usage, [*ledger.claims_of_demand(request.demand), *kept], checkpoint)
    demanded = list(request.demanded)
    for index, item in enumerate(demanded):
        if isinstance(item.held, Application):
            services = {service.name: "" for service in _services_to_place(item.held, world)}
            services |= {name: item.held.services[name] for name in item.held.named}
            held = replace(item.held, services=services)
            demanded[index] = replace(item, held=held)
    # What leaves no choice is tried first and alone. If that is refused, no node helps.
    fixed = tuple(
        item
        for item in demanded
        if not isinstance(item.held, Application)
        or (item.held.place is None and all(item.held.services.values()))
    )
    if trial is not None and fixed and not trial(replace(request, demanded=fixed)):
        return request, [_NOWHERE]
    on_named_nodes = [
        item for item in demanded if isinstance(item.held, Application) and item.held.place is None
    ]
    for item in on_named_nodes:
        room.take(_claim(request, item))

    def suits(index: int) -> Callable[[Application], bool] | None:
        if trial is None:
            return None

        def can_be_booked(app: Application) -> bool:
            items = list(demanded)
            items[index] = replace(items[index], held=app)
            # Applications that get their node later are left out.
            placed = (
                each for each in items if not isinstance(each.held, Application) or each.held.node
            )
            return trial(replace(request, demanded=tuple(placed)))

        return can_be_booked

    positions = request.positions
    # The choices follow one another. What is chosen first is not changed for the sake of what comes
    # later, and after the first failure no more is tried.
    for index, item in enumerate(demanded):
        if isinstance(item.held, Application) and item.held.place is not None:
            if faults and trial is not None:
                return request, faults
            checkpoint()
            claims = (_claim(request, item),)
            place = item.held.place
            choice = Choice(item, place, world, room, claims, None, suits(index), positions)
            placed = _with_node(request, item, choice)
            if isinstance(placed, Fault):
                faults.append(placed)
            else:
                demanded[index] = placed
                room.take(_claim(request, placed))
    # Services come after all applications, because a service runs on its application's node if it
    # can.
    for index, item in enumerate(demanded):
        if isinstance(item.held, Application) and item.held.node:
            if faults and trial is not None:
                return request, faults
            checkpoint()
            demanded[index], failed = _with_services(request, item, world, room, suits(index))
            faults += failed
    return replace(request, demanded=tuple(demanded)), faults


def may_wait(request: Demand, world: World, checkpoint: Callable[[], None]) -> bool:
    """Return whether a demand that lacks only room may wait.

    Each application and service needs a node that would fit, in a domain that lets demands wait.
    """
    for item in request.demanded:
        app = item.held
        if not isinstance(app, Application):
            continue
        # All nodes count as empty, so the choices show which nodes could ever fit.
        empty, claims, choices = Room(world, Usage()), (_claim(request, item),), list[Choice]()
        if app.place and not app.node:
            choices.append(Choice(item, app.place, world, empty, claims))
        for service in _services_to_place(app, world):
            required = requirement_of(service)
            choices.append(Choice(item, required, world, empty, claims, service))
        for choice in choices:
            checkpoint()
            for node in choice.nodes():
                if world.config.domain_of[node].when_full == "wait":
                    on_it = candidates.on_node(choice.app, node, choice.service, world)
                    claim = _claim(request, replace(item, held=on_it))
                    # A person approves only what can be booked at once, so what needs approval
                    # cannot wait.
                    if not permission.approval_reasons(request, [(None, claim)], world.config):
                        break
            else:
                return False
    return True


def _claim(request: Demand, item: Item) -> Claim:
    """Return the claim that a demanded application would get if it were booked last of all."""
    demand = request.demand or demand_id(request.id, item.requesters)
    return Claim(item.held.booked(), demand, request.id, item.requesters, _LAST)


def _with_node(request: Demand, item: Item, choice: Choice) -> Item | Fault:
    app = choice.app
    if app.node:
        # ``node`` and ``place`` together are a check of the named node, and no preference.
        node = choice.config.nodes.get(app.node)
        # admission reports an unknown node
        lacking = list(lacks(node, choice.requirement)) if node else []
        if not lacking:
            return replace(item, held=replace(app, place=None))
        message = (
            f"{quoted(app.node)} lacks {joined(lacking)}; name another node, or leave out one of "
            "the fields 'node' and 'place'"
        )
        return item.fault("place", message, code="no-node")
    chosen = _booked(choice, request.demand)
    if chosen is None:
        chosen = next(choice.candidates(), None) or choice.none_fits()
    if isinstance(chosen, Fault):
        return chosen
    placed = f"application '{app.id}' is placed on {quoted(chosen.node)}, {chosen.why}"
    return replace(item, held=replace(app, node=chosen.node), placed=(placed,))


def _shared_node(app: Application, service: Service, world: World) -> str:
    # Another application may have an instance to share. If a second instance ran on another node,
    # the application's node would get the same outputs twice.
    role = service.root or ""
    for topic in app.inputs.get(role, ()) if service.scope == "topic" else ():
        for claim in world.ledger.claims_reading(topic.source, topic.topic):
            other = world.ledger.application(claim.subject.id) or claim.application
            if other.id == app.id or not candidates.shares(service, app, other):
                continue
            if claim.application.inputs_from(role, topic.source, topic.topic):
                return other.chosen_node(service.name)
    return ""


def _booked(choice: Choice, demand: str) -> Chosen | Fault | None:
    """Return the booked node if it stays, a fault if it must but lacks something, or ``None``."""
    app, claims = choice.app, choice.world.ledger.claims_on(choice.app.subject)
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
    return choice.item.fault("place", message, code="conflict")


def _of_another(claims: tuple[Claim, ...], demand: str) -> Claim | None:
    others = (claim for claim in claims if claim.demand != demand and not claim.keeping_override)
    return next(others, None)


def _with_services(
    request: Demand,
    item: Item,
    world: World,
    room: Room,
    suits: Callable[[Application], bool] | None,
) -> tuple[Item, list[Fault]]:
    app = item.held
    assert isinstance(app, Application)  # noqa: S101 - callers pass only applications
    claims, faults = world.ledger.claims_on(app.subject), list[Fault]()
    first = claims[0].application if claims and claims[0].application.appdef == app.appdef else None
    if first and (request.is_reference or _of_another(claims, request.demand)):
        # What others hold stays where it is. So does what a goal of the reference's action holds:
        # its connections are those that it lists, and would not follow.
        for name in app.named:
            node = first.chosen_node(name)
            if node != app.services[name]:
                message = (
                    f"{quoted(app.services[name])} contradicts an existing claim of "
                    f"{', '.join(claims[0].requesters)}: service {name} of '{app.id}' is on node "
                    f"'{node}'; name node '{node}', or use another application id"
                )
                faults.append(item.fault(f"services.{name}", message, code="conflict"))
        # A service that the claim does not place runs with its application. To name that node
        # changes nothing, and is not recorded, because all claims on an application say the same.
        named = tuple(name for name in app.named if name in first.services)
        item = replace(item, held=replace(app, services=first.services, named=named))
        room.book([_claim(request, item)])
        return item, faults
    services = world.config.services.get(app.appdef, {})
    for name in app.named:
        wanted, definition = world.config.nodes.get(app.services[name]), services.get(name)
        if wanted and definition and (lacking := [*lacks(wanted, requirement_of(definition))]):
            message = (
                f"{quoted(wanted.id)} lacks {joined(lacking)}, which the service requires ('place' "
                f"in {definition.file}); name another node, or name none for this service"
            )
            faults.append(item.fault(f"services.{name}", message, code="no-node"))
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
    item = replace(item, held=replace(app, services=kept | {**app.services}))
    positions = request.positions
    for service in _services_to_place(app, world):
        claims = (_claim(request, item),)
        required = requirement_of(service)
        choice = Choice(item, required, world, room, claims, service, suits, positions)
        here, shared = booked.get(service.name, ""), _shared_node(choice.app, service, world)
        chosen: Chosen | Fault = Chosen(here, "where it is booked already")
        if not here or (here != shared and not choice.fits(here)):
            chosen = (
                choice.chosen(shared, "where the service already runs for this topic")
                or next(choice.candidates(), None)
                or choice.none_fits()
            )
        if isinstance(chosen, Fault):
            faults.append(chosen)
            continue
        text = f"service '{service.name}' of application '{app.id}' is placed on "
        placed = f"{text}{quoted(chosen.node)}, {chosen.why}"
        held = candidates.on_node(choice.app, chosen.node, service, world)
        item = replace(item, held=held, placed=(*item.placed, placed))
        room.newly_placed[chosen.node] += 1
        room.book([_claim(request, item)])
    return item, faults
