"""Relocation: applications and services leave a drained node, and overrides move services.

An application leaves a drained node only if the generator placed it on this node. If a demand names
the node or an override keeps the application, it stays. Claims and definitions contain what is
required of a node, so the original demands are not needed. The connections of a moved application
follow (:mod:`demandops.plan.nodes.moved_connections`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import islice
from math import inf

from demandops.config.appdef import Service
from demandops.demand import admission, permission
from demandops.demand.application import Requirement
from demandops.demand.claim import Claim, ClaimKey, requesters_of
from demandops.demand.demand_request import Demanded
from demandops.errors import Fault, sentences
from demandops.ledger.claim_changes import Changes, ClaimChange, claim_changes
from demandops.ledger.ledger import Ledger
from demandops.ledger.operations.conflicts import conflicts
from demandops.ledger.operations.drain import Drain
from demandops.ledger.operations.restoration import Restoration, request_for
from demandops.ledger.world import World
from demandops.plan.checks import name_clash, quota, topic_clash
from demandops.plan.checks.name_clash import Names
from demandops.plan.nodes.capacity import Room, Usage
from demandops.plan.nodes.choice import (
    MOST_TRIED,
    Choice,
    Chosen,
    joined,
    on_node,
    requirement_of,
    shares,
    with_overridden_nodes,
)
from demandops.plan.nodes.moved_connections import Move, renaming, with_moved
from demandops.plan.overrides.claim_overrides import suspended_by
from demandops.plan.release_keys import affected_keys
from demandops.quoting import quoted
from demandops.subject import Subject, SubjectKind

_ANY = Requirement()


def with_moves(
    request: Drain, world: World, usage: Usage, names: Names, most: float = inf
) -> Drain:
    """Return ``request`` with the moves of all applications and services that can leave the node.

    Args:
        request: the drain; its ``id`` is the node.
        world: the claims and the configuration.
        usage: what services request on each node in ``world``.
        names: the names of all releases in ``world``.
        most: after so many tried nodes, the other applications are left for another drain.
    """
    start, moved, stays, keys = world, list[str](), list[str](), list[ClaimKey]()
    room, tried, last = Room(world, usage, ()), 0, request.after
    for id in applications_of(world.ledger, request.id):
        if id <= request.after:
            continue
        if tried >= most:
            break
        last = id
        for service in _placed_at(request.id, id, world):
            ids = _moving_with(id, service, request.id, world)
            claims = tuple(one for each in ids for one in world.ledger.application_claims(each))
            what = [f"application '{each}'" for each in ids]
            what = [f"service '{service.name}' of {each}" for each in what] if service else what
            fixed = (_why_fixed(one, request.id, service) for one in claims)
            found: _Moved | str = next(filter(None, fixed), "")
            tried += 1
            if not found:
                found, count = _moved(world, claims, room, names, service)
                tried += count
            if isinstance(found, str):
                stays.append(f"{what[0]} stays, because {found}")
                continue
            world, chosen, touched, names = found
            # ``world`` has the application on its new node, so ``room`` must count it on this node
            for each in ids:
                room.book(world.ledger.application_claims(each))
            keys += touched
            moved += [f"{one} is placed on {quoted(chosen.node)}, {chosen.why}" for one in what]
    else:
        last = ""
    moves = claim_changes(start.ledger, world.ledger, keys)
    return replace(request, moves=moves, moved=tuple(moved), stays=tuple(stays), last=last)


_Moved = tuple[World, Chosen, list[ClaimKey], Names]


def _placed_at(node: str, id: str, world: World) -> list[Service | None]:
    """Return the services of an application for which ``node`` was chosen or named.

    If ``node`` is the application's own node, the first item is ``None``.
    """
    app = world.ledger.application(id)
    if app is None:
        return []
    known = world.config.services.get(app.appdef, {})
    services = [
        known[one] for one, on in sorted(app.services.items()) if on == node and one in known
    ]
    return [*([None] if app.node == node else []), *services]


def _moving_with(id: str, service: Service | None, node: str, world: World) -> list[str]:
    """Return the ids of the applications that must move together with ``id``, including ``id``.

    These are the applications that share the instances of ``service`` on the node.
    """
    app = world.ledger.application(id)
    if service is None or service.scope != "topic" or app is None:
        return [id]
    others = ((one, world.ledger.application(one)) for one in applications_of(world.ledger, node))
    return [
        one
        for one, other in others
        if other and other.services.get(service.name) == node and shares(service, app, other)
    ]


def _why_fixed(claim: Claim, node: str, service: Service | None) -> str:
    """Return why a claim's application or service must stay on its node, or an empty text."""
    app = claim.application
    if service is not None:
        return f"demand '{claim.demand}' names the node" if service.name in app.named else ""
    if claim.keeping_override:
        return f"the override '{claim.keeping_override}' keeps it"
    if app.place is None:
        return f"demand '{claim.demand}' names the node"
    here = [name for name in app.named if name not in app.services]
    return f"demand '{claim.demand}' names the node of {joined(here)}" if here else ""


def applications_of(ledger: Ledger, node: str) -> list[str]:
    """Return the ids of the applications on a node, or with a service placed on it, sorted."""
    if not ledger.applications_on.get(node):
        return []
    apps = ((id, ledger.application(id)) for id in ledger.applications_at(node))
    return [id for id, app in apps if app and node in app.chosen_nodes]


def _moved(
    world: World, claims: tuple[Claim, ...], room: Room, names: Names, service: Service | None
) -> tuple[_Moved | str, int]:
    """Return the world with an application, or only its ``service``, moved to the best other node.

    The result also has the chosen node, the keys of the changed claims, and the names after the
    move. If no move is possible, the result is the reason as a text. The second value is how many
    nodes were tried.
    """
    required = reduce(Requirement.united, (one.application.place or _ANY for one in claims))
    required = requirement_of(service) if service else required
    roles = dict.fromkeys(role for one in claims for role in one.application.inputs)
    inputs = {
        role: tuple(dict.fromkeys(t for c in claims for t in c.application.inputs.get(role, ())))
        for role in roles
    }
    app = claims[0].application.with_inputs(inputs)
    demanded = Demanded(app, requesters_of(claims), str)
    choice = Choice(demanded, required, world, room, claims, service)
    reasons: list[str] = []
    renamed = {flow.sender: route for claim in claims for flow, route in renaming(world, claim)}
    for chosen in islice(choice.candidates({}), MOST_TRIED):
        if route := renamed.get(chosen.node):
            topics = f"'{route.read_topic}' would not be renamed to '{route.written_topic}'"
            reasons.append(f"on {quoted(chosen.node)} {topics}")
            continue
        move = partial(on_node, node=chosen.node, service=service, world=world)
        after, changes = with_moved(world, claims, move)
        moved_names = name_clash.followed(names, world, after, affected_keys(world, after, changes))
        fault = next(_faults(world, after, changes, moved_names), None)
        if fault is None:
            keys = [change.key for change in changes]
            return (after, chosen, keys, moved_names), len(reasons) + 1
        reasons.append(f"on {quoted(chosen.node)} {fault.message}")
    return sentences(reasons) or choice.none_fits({}).message, len(reasons)


@dataclass(frozen=True, slots=True)
class LedgerAfterMoves:
    """The ledger after services have moved to the nodes that overrides name.

    ``keys`` are the keys of the claims that may have changed.
    """

    ledger: Ledger
    keys: tuple[ClaimKey, ...]
    stays: tuple[tuple[str, str], ...]
    """(file, message) for each override that cannot move a service of an application."""


def following_overrides(
    world: World, subjects: Iterable[Subject] | None = None
) -> LedgerAfterMoves:
    """Return the ledger after services have moved to the nodes that overrides name.

    The connections follow the services. A service also moves back when no override moves it any
    longer. A service stays if the move would cause a fault.

    Args:
        world: the claims and the configuration.
        subjects: the subjects whose claims changed; ``None`` means all applications.
    """
    ids = [one.id for one in subjects or () if one.kind is SubjectKind.APPLICATION]
    if subjects is None:
        ids = [*world.ledger.moved_applications()]
        if any(one.node for one in world.overrides):
            ids = sorted(world.ledger.subjects(SubjectKind.APPLICATION))
    change = partial(with_overridden_nodes, world=world)
    wanted = [
        id
        for id in dict.fromkeys(ids)
        for app in [world.ledger.application(id)]
        if app is not None and change(app) != app
    ]
    together, left = wanted, list[str]()
    names = name_clash.all_names(world) if wanted else name_clash.NONE
    while together:  # applications that share a service must move at the same time
        after, changes, moved_names = _all_moved(world, together, change, names)
        wrong = [
            id for id, of in changes.items() if next(_faults(world, after, of, moved_names), None)
        ]
        if not wrong:
            break
        together, left = [id for id in together if id not in wrong], [*left, *wrong]
    keys, stays = list[ClaimKey](), list[tuple[str, str]]()
    for ids in filter(None, (together, *([one] for one in left))):
        after, changes, moved_names = _all_moved(world, ids, change, names)
        faults = (
            found for of in changes.values() for found in _faults(world, after, of, moved_names)
        )
        fault = None if ids is together else next(faults, None)
        if fault is None:
            world, names = after, moved_names
            keys += [one.key for of in changes.values() for one in of]
        else:
            stays += _unmoved(ids[0], world, fault)
    return LedgerAfterMoves(world.ledger, tuple(dict.fromkeys(keys)), tuple(stays))


def with_restored_moves(request: Restoration, world: World) -> Restoration:
    """Return the restoration with its claims adapted to the overrides that move services now.

    A service whose move would cause a fault among these claims is not adapted.
    """
    moves = any(one.node for one in world.overrides)
    if not moves and not any(
        one.is_on_application and one.application.moved for one in request.claims
    ):
        return request
    ledger = Ledger(ended=world.ledger.ended)
    for claim in request.claims:
        ledger = ledger.replace(claim.key, claim)
    return replace(request, claims=tuple(following_overrides(replace(world, ledger=ledger)).ledger))


def _all_moved(
    before: World, applications: Iterable[str], move: Move, names: Names
) -> tuple[World, dict[str, tuple[ClaimChange, ...]], Names]:
    world, changes = before, dict[str, tuple[ClaimChange, ...]]()
    for id in applications:
        world, changes[id] = with_moved(world, world.ledger.application_claims(id), move)
    every = [one for of in changes.values() for one in of]
    keys = affected_keys(before, world, every)
    return world, changes, name_clash.followed(names, before, world, keys)


def _unmoved(id: str, world: World, fault: Fault) -> Iterator[tuple[str, str]]:
    """Yield (file, message) for each override that cannot move a service of an application."""
    app = world.ledger.application(id)
    assert app is not None  # noqa: S101 - it is claimed
    wanted = with_overridden_nodes(app, world).moved
    changed = {name for name in {*wanted, *app.moved} if wanted.get(name) != app.moved.get(name)}
    nodes = {wanted[name] for name in changed if name in wanted}
    for override in world.overrides:
        if override.node in nodes:
            services = " and ".join(sorted(n for n in changed if wanted.get(n) == override.node))
            yield (
                override.path,
                f"does not move {services} of application '{app.id}' to '{override.node}': "
                f"{fault.message}",
            )


def _faults(
    before: World, after: World, changes: tuple[ClaimChange, ...], names: Names
) -> Iterator[Fault]:
    """Yield the faults of moved claims; each claim is checked as if it were demanded now.

    ``names`` are those of all releases in ``after``.
    """
    for change in changes:
        claim = change.after
        if claim is None:
            continue
        wanted, others = request_for(claim), after.ledger.replace(claim.key, None)
        yield from admission.faults(wanted, after.config)
        yield from permission.faults(wanted, after.config)
        yield from conflicts(wanted.demanded[0], others)
        override = suspended_by(claim, after)
        if override and change.before and not suspended_by(change.before, before):
            yield Fault("denied", "", f"{claim.subject} would be denied by {override.path}")
    yield from quota.faults(before, after, Changes(changes))
    for change in changes:
        if change.after:
            yield from topic_clash.faults_of_claim(change.after, before, after)
            yield from _brought_twice(change.after, after)
    keys = affected_keys(before, after, changes)
    yield from name_clash.faults(Drain(""), before, after, keys, Changes(changes), names)


def _brought_twice(claim: Claim, after: World) -> Iterator[Fault]:
    """Yield a fault for each topic that two connections bring to a node from different senders.

    ``claim`` is the claim on one of the two connections. A topic that a demand lists as an input is
    never a fault, because the demand names the source.
    """
    if claim.is_on_application:
        return
    apps = (
        one.application
        for one in after.ledger.claims_of_demand(claim.demand)
        if one.is_on_application
    )
    inputs = {(topic.source, topic.topic) for app in apps for _, topic in app.all_inputs()}
    for route in claim.connection.topics:
        sender, receiver = route.sender_and_receiver(*claim.connection.nodes)
        if (sender, route.read_topic) not in inputs:
            for other in _senders(after.ledger, receiver, route.written_topic) - {sender}:
                topic = quoted(route.written_topic)
                words = f"{topic} would come from {quoted(sender)} and from {quoted(other)}"
                yield Fault("conflict", "", words)


def _senders(ledger: Ledger, receiver: str, topic: str) -> set[str]:
    connections = map(ledger.connection, ledger.connections_bringing(receiver, topic))
    routes = ((one, route) for one in connections if one for route in one.topics)
    ends = ((*route.sender_and_receiver(*one.nodes), route.written_topic) for one, route in routes)
    return {sender for sender, *target in ends if target == [receiver, topic]}
