"""Moves applications and services to other nodes: off drained ones, and where overrides say."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from itertools import islice
from math import inf

from demandops.base.errors import Fault, Refused
from demandops.base.naming import Subject, SubjectKind
from demandops.base.quoting import quoted
from demandops.decide import carriers
from demandops.decide.admission import admission, permission
from demandops.decide.booking import Drain, conflicts, request_for
from demandops.decide.checks import collisions, forbidden
from demandops.decide.checks.collisions import Names
from demandops.decide.checks.forbidden import Need, Usage
from demandops.decide.placement import candidates
from demandops.decide.placement.candidates import Choice, Chosen, Room
from demandops.decide.planning import overrides
from demandops.decide.planning.flows import flows, with_booked_outputs
from demandops.decide.planning.planner import affected_keys
from demandops.model.config.appdef import Service
from demandops.model.demand.demand import Application, Demand, InputTopic, Item, Requirement
from demandops.model.ledger.claim import Claim, ClaimKey, requesters_of
from demandops.model.ledger.ledger import (
    Changes,
    ClaimChange,
    Ledger,
    World,
    claim_changes,
)

# ---- when an application moves, the connections of its demands follow, with type and options ----

# Returns the given application on its new nodes.
Move = Callable[[Application], Application]


def with_moved(
    world: World, claims: Iterable[Claim], move: Move, done: frozenset[ClaimKey] = frozenset()
) -> tuple[World, tuple[ClaimChange, ...]]:
    """Return the world with applications moved, followed by what depends on where they run.

    The connections of their demands follow, and so do the inputs of those that read their outputs,
    except of the claims ``done``, because claims that people wrote may read one another.
    """
    ledger, claims = world.ledger, tuple(claims)
    for claim in claims:
        ledger = ledger.replace(claim.key, replace(claim, held=move(claim.application)))
    for claim in claims:
        ledger = carriers.with_moved_routes(
            replace(world, ledger=ledger), claim, move(claim.application)
        )
    demands = dict.fromkeys(claim.demand for claim in claims)
    held = (
        c for old in (world.ledger, ledger) for d in demands for c in old.claims_with("demand", d)
    )
    keys = list(dict.fromkeys(claim.key for claim in held))
    changes = claim_changes(world.ledger, ledger, keys)
    ledger, _ = carriers.without_idle_routes(ledger, world.config, changes)
    done |= {claim.key for claim in claims}
    moved = dict.fromkeys(claim.subject.id for claim in claims)
    reading = [each.key for id in moved for each in ledger.claims_with("reads", id)]
    for reader in filter(None, (ledger.get(key) for key in reading if key not in done)):
        follow = partial(
            with_booked_outputs, demand=reader.demand, ledger=ledger, config=world.config
        )
        if follow(reader.application) != reader.application:
            after, changes = with_moved(replace(world, ledger=ledger), [reader], follow, done)
            ledger, keys = after.ledger, [*keys, *(change.key for change in changes)]
    return replace(world, ledger=ledger), claim_changes(world.ledger, ledger, keys)


# ---- relocation: applications and services leave a drained node, and overrides move services ----
#
# Claims and definitions contain what is required of a node, so the original demands are not needed.


def with_moves(
    request: Drain, world: World, usage: Usage, names: Names, most: float = inf
) -> Drain:
    """Return ``request`` with the moves that are possible, after ``most`` attempts no more."""
    start, moved, stays, keys = world, list[str](), list[str](), list[ClaimKey]()
    attempts, last = 0, request.after
    node = request.id
    for id in applications_of(world.ledger, node):
        if id <= request.after:
            continue
        if attempts >= most:
            break
        last = id
        app = world.ledger.application(id)
        assert app is not None  # noqa: S101 - applications_of lists only claimed ones
        definitions = world.config.services.get(app.appdef, {})
        # The application itself is first, as ``None``.
        leaving: list[Service | None] = [None] if app.node == node else []
        leaving += [
            definitions[name]
            for name, at in sorted(app.services.items())
            if at == node and name in definitions
        ]
        for service in leaving:
            ids = [id]
            now = world.ledger.application(id)
            if now and service and service.scope == "topic":
                # They share the instances of the service on the node. If only some moved, the
                # application's node would get the same outputs from two nodes.
                ids = [
                    each
                    for each in applications_of(world.ledger, node)
                    if (other := world.ledger.application(each))
                    and other.services.get(service.name) == node
                    and candidates.shares(service, now, other)
                ]
            claims = tuple(claim for id in ids for claim in world.ledger.application_claims(id))
            what = [f"application '{id}'" for id in ids]
            what = [f"service '{service.name}' of {text}" for text in what] if service else what
            attempts += 1
            # What cannot move holds up nothing else.
            if fixed := next(filter(None, (_why_fixed(c, node, service) for c in claims)), ""):
                # what an override moved runs elsewhere already
                here = [each.name for each in definitions.values() if each.is_movable]
                here = [service.name] if service else [*{*here} - {*app.services}]
                if not here or any(app.moved.get(name, node) == node for name in here):
                    stays.append(f"{what[0]} stays, because {fixed}")
                continue
            # another node is chosen by what all the claims require and read
            apps = [claim.application for claim in claims]
            places = (app.place or Requirement() for app in apps)
            own = candidates.requirement_of(service) if service else None
            required = own or reduce(Requirement.united, places)
            inputs: dict[str, dict[InputTopic, None]] = {}
            for role, topics in (each for app in apps for each in app.inputs.items()):
                inputs.setdefault(role, {}).update(dict.fromkeys(topics))
            united = apps[0].with_inputs({role: (*topics,) for role, topics in inputs.items()})
            item = Item(united, requesters_of(claims))
            choice = Choice(item, required, Room(world, usage), service)
            try:
                chosen, moving = choice.first(partial(_moved, world, names, usage, claims, service))
            except Refused as refusal:
                stays.append(f"{what[0]} stays, because {refusal.faults[0].message}")
            else:
                world, names, changes, grown = moving
                usage = usage.plus(grown)
                keys += [change.key for change in changes]
                on = f"is placed on {quoted(chosen.node)}, {chosen.why}"
                moved += [f"{text} {on}" for text in what]
            attempts += len(choice.refused)
    else:
        last = ""
    moves = claim_changes(start.ledger, world.ledger, keys)
    return replace(request, moves=moves, moved=tuple(moved), stays=tuple(stays), last=last)


def _why_fixed(claim: Claim, node: str, service: Service | None) -> str:
    app = claim.application
    way = shlex.join(["demandops", "override", "create", "NAME", "--node", node, "--on", "NODE"])
    named, way = f"demand '{claim.demand}' names the node", f"; to move it: {way} -m REASON"
    if service is not None:
        return named + way if service.name in app.named else ""
    if claim.keeping_override:
        return f"the override '{claim.keeping_override}' keeps it"
    if app.place is None:  # a claim has this only if the generator chose the node
        return named + way
    here = [name for name in app.named if name not in app.services]
    return f"{named} of {candidates.joined(here)}{way}" if here else ""


def applications_of(ledger: Ledger, node: str) -> list[str]:
    """Return the ids of the applications on a node, or with a service placed on it, sorted."""
    apps = ((id, ledger.application(id)) for id in ledger.ids_with("node", node))
    return [id for id, app in apps if app and node in app.chosen_nodes]


def _moved(
    world: World,
    names: Names,
    usage: Usage,
    claims: tuple[Claim, ...],
    service: Service | None,
    chosen: Chosen,
) -> tuple[World, Names, tuple[ClaimChange, ...], Mapping[Need, int]]:
    """Move claims to a node, or raise Refused if that would cause a fault.

    Return the world and the names after it, and what changes of claims and of usage.
    """
    for claim in claims:
        for flow in flows(world.config, claim.application):
            for _, route in carriers.carrying(world.ledger, claim.demand, flow):
                # On the sender's own node, no connection would rename the topic.
                renamed = flow.delivery is None and route.read_topic != route.written_topic
                if renamed and flow.key.sender == chosen.node:
                    message = (
                        f"'{route.read_topic}' would not be renamed to '{route.written_topic}'"
                    )
                    raise Refused.at("", message)
    move = partial(candidates.on_node, node=chosen.node, service=service, world=world)
    after, changes = with_moved(world, claims, move)
    followed = collisions.followed(names, world, after, affected_keys(world, after, changes))
    if faults := [*islice(_faults(world, after, changes, followed), 1)]:
        raise Refused(faults)
    grown, host = forbidden.growth_by(world, after, changes), world.config.host_of(chosen.node)
    there = {need: amount for need, amount in grown.items() if need[0] == host}
    if (refusal := forbidden.NoRoom(usage, there, world.config)).full:
        raise refusal
    return after, followed, changes, grown


@dataclass(frozen=True, slots=True)
class LedgerUpdate:
    """The ledger after a change of overrides or claims, and the ledger files to write.

    ``keys`` are the keys of the claims that may have changed. A file with ``None`` is removed.
    """

    ledger: Ledger
    keys: tuple[ClaimKey, ...]
    # (file, reason) for each override and each application whose service it cannot move
    stays: tuple[tuple[str, str], ...]
    files: Mapping[str, str | None] = field(default_factory=dict)


def following_overrides(world: World, subjects: Iterable[Subject] | None = None) -> LedgerUpdate:
    """Return the ledger after services have moved to the nodes that overrides name; no files.

    A service moves back when no override moves it any longer, and stays if the move would cause a
    fault. ``subjects`` are those whose claims changed; ``None`` means all applications.
    """
    ids = [subject.id for subject in subjects or () if subject.kind is SubjectKind.APPLICATION]
    if subjects is None:
        ids = [*world.ledger.ids_with("moved")]
        if any(override.node for override in world.overrides):
            ids = sorted(world.ledger.subjects(SubjectKind.APPLICATION))
    change = partial(overrides.with_overridden_nodes, world=world)
    moving = [
        id
        for id in dict.fromkeys(ids)
        for app in [world.ledger.application(id)]
        if app is not None and change(app) != app
    ]
    keys, stays = list[ClaimKey](), list[tuple[str, str]]()
    if not moving:
        return LedgerUpdate(world.ledger, (), ())
    names = collisions.all_names(world)
    groups = [moving]  # applications that share a service must move at the same time
    while groups:
        ids = groups.pop(0)
        after, changes = world, dict[str, tuple[ClaimChange, ...]]()
        for id in ids:
            after, changes[id] = with_moved(after, after.ledger.application_claims(id), change)
        every = [each for own in changes.values() for each in own]
        moved_names = collisions.followed(names, world, after, affected_keys(world, after, every))
        faults = {
            id: fault
            for id, own in changes.items()
            if (fault := next(_faults(world, after, own, moved_names), None))
        }
        if not faults:
            world, names = after, moved_names
            keys += [each.key for each in every]
        elif len(ids) > 1:
            # A fault of one application may have come from another that does not move in the end.
            # So each that caused a fault is tried again, alone, after the others have moved.
            groups = [[id for id in ids if id not in faults], *groups, *([id] for id in faults)]
        else:
            app = world.ledger.application(ids[0])
            assert app is not None  # noqa: S101 - it is claimed
            nodes = change(app).moved
            changed = {
                name for name in {*nodes, *app.moved} if nodes.get(name) != app.moved.get(name)
            }
            for override in world.overrides:
                services = sorted(name for name in changed if nodes.get(name) == override.node)
                if override.node and services:
                    message = (
                        f"does not move {' and '.join(services)} of application '{app.id}' to "
                        f"'{override.node}': {faults[app.id].message}"
                    )
                    stays.append((override.path, message))
    return LedgerUpdate(world.ledger, tuple(dict.fromkeys(keys)), tuple(stays))


def _faults(
    before: World, after: World, changes: tuple[ClaimChange, ...], names: Names
) -> Iterator[Fault]:
    """Yield the faults of moved claims; each claim is checked as if it were demanded now."""
    for change in changes:
        claim = change.after
        if claim is None:
            continue
        request, others = request_for(claim), after.ledger.replace(claim.key, None)
        if claim.keeping_override is None:  # no requester demands what an override keeps
            yield from admission.faults(request, after.config)
            yield from permission.faults(request, after.config)
        yield from conflicts(request.demanded[0], others)
        override = overrides.suspended_by(claim, after)
        if override and change.before and not overrides.suspended_by(change.before, before):
            yield Fault("denied", "", f"{claim.subject} would be denied by {override.path}")
    yield from forbidden.quota_faults(before, after, Changes(changes))
    for change in changes:
        if not (claim := change.after):
            continue
        yield from collisions.faults_of_claim(claim, before, after, names)
        if not claim.is_on_application:
            former = change.before.connection.topics if change.before else ()
            held = after.ledger.claims_with("demand", claim.demand)
            apps = [each.application for each in held if each.is_on_application]
            for index, words in carriers.chosen_twice(claim.connection, apps, after.ledger):
                if claim.connection.topics[index] not in former:
                    yield Fault("conflict", "", words)
    keys = affected_keys(before, after, changes)
    yield from collisions.name_faults(Demand("drain"), before, after, keys, Changes(changes), names)
