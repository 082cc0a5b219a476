"""Moves applications and services to other nodes: off drained ones, and where overrides say."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial, reduce
from itertools import islice
from math import inf

from demandops.base.errors import Fault, sentences
from demandops.base.naming import Subject, SubjectKind
from demandops.base.quoting import quoted
from demandops.decide import carriers
from demandops.decide.admission import admission, permission
from demandops.decide.booking import Drain, conflicts
from demandops.decide.checks import collisions, quotas
from demandops.decide.checks.collisions import Names
from demandops.decide.placement import candidates
from demandops.decide.placement.candidates import Choice, Chosen
from demandops.decide.placement.capacity import Room, Usage
from demandops.decide.planning import chains, overrides
from demandops.decide.planning.flows import flows
from demandops.decide.planning.release_keys import affected_keys
from demandops.decide.rollback import Restoration, request_for
from demandops.model.config.appdef import Service
from demandops.model.config.override import Override, format_time
from demandops.model.demand.demand import Application, Demand, InputTopic, Item, Requirement
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger import records
from demandops.model.ledger.claim import Claim, ClaimKey, requesters_of
from demandops.model.ledger.ledger import (
    Changes,
    ClaimChange,
    Ledger,
    World,
    claim_changes,
    ledger_of,
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
    held = (c for old in (world.ledger, ledger) for d in demands for c in old.claims_of_demand(d))
    keys = list(dict.fromkeys(claim.key for claim in held))
    changes = claim_changes(world.ledger, ledger, keys)
    ledger, _ = carriers.without_idle_routes(ledger, world.config, changes)
    done |= {claim.key for claim in claims}
    moved = dict.fromkeys(claim.subject.id for claim in claims)
    reading = [each.key for id in moved for each in ledger.claims_reading_outputs(id)]
    for reader in filter(None, (ledger.get(key) for key in reading if key not in done)):
        follow = partial(chains.followed, demand=reader.demand, ledger=ledger, config=world.config)
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
    """Return ``request`` with the moves that are possible, after ``most`` tried nodes no more."""
    start, moved, stays, keys = world, list[str](), list[str](), list[ClaimKey]()
    room, tried, last = Room(world, usage), 0, request.after
    node = request.id
    for id in applications_of(world.ledger, node):
        if id <= request.after:
            continue
        if tried >= most:
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
            ids = _moving_with(id, service, node, world)
            claims = tuple(claim for id in ids for claim in world.ledger.application_claims(id))
            what = [f"application '{id}'" for id in ids]
            what = [f"service '{service.name}' of {text}" for text in what] if service else what
            fixed = (_why_fixed(claim, node, service) for claim in claims)
            outcome: _Moved | str = next(filter(None, fixed), "")
            tried += 1
            if not outcome:
                outcome, count = _moved(world, claims, room, names, service)
                tried += count
            # What cannot move holds up nothing else.
            if isinstance(outcome, str):
                stays.append(f"{what[0]} stays, because {outcome}")
                continue
            world, chosen, changed, names = outcome
            # ``world`` has the application on its new node, so ``room`` must count it on this node
            for moved_id in ids:
                room.book(world.ledger.application_claims(moved_id))
            keys += changed
            moved += [f"{text} is placed on {quoted(chosen.node)}, {chosen.why}" for text in what]
    else:
        last = ""
    moves = claim_changes(start.ledger, world.ledger, keys)
    return replace(request, moves=moves, moved=tuple(moved), stays=tuple(stays), last=last)


# The world after a move, the chosen node, the keys of the changed claims, and the names after it.
_Moved = tuple[World, Chosen, list[ClaimKey], Names]


def _moving_with(id: str, service: Service | None, node: str, world: World) -> list[str]:
    app = world.ledger.application(id)
    if service is None or service.scope != "topic" or app is None:
        return [id]
    # They share the instances of the service on the node. If only some moved, the application's
    # node would get the same outputs from two nodes.
    others = {each: world.ledger.application(each) for each in applications_of(world.ledger, node)}
    return [
        each
        for each, other in others.items()
        if other
        and other.services.get(service.name) == node
        and candidates.shares(service, app, other)
    ]


def _why_fixed(claim: Claim, node: str, service: Service | None) -> str:
    app = claim.application
    if service is not None:
        return f"demand '{claim.demand}' names the node" if service.name in app.named else ""
    if claim.keeping_override:
        return f"the override '{claim.keeping_override}' keeps it"
    if app.place is None:  # a claim has this only if the generator chose the node
        return f"demand '{claim.demand}' names the node"
    here = [name for name in app.named if name not in app.services]
    return f"demand '{claim.demand}' names the node of {candidates.joined(here)}" if here else ""


def applications_of(ledger: Ledger, node: str) -> list[str]:
    """Return the ids of the applications on a node, or with a service placed on it, sorted."""
    if not ledger.applications_on.get(node):
        return []
    apps = ((id, ledger.application(id)) for id in ledger.applications_at(node))
    return [id for id, app in apps if app and node in app.chosen_nodes]


def _moved(
    world: World, claims: tuple[Claim, ...], room: Room, names: Names, service: Service | None
) -> tuple[_Moved | str, int]:
    """Return the move to the best other node, or why there is none, and how many were tried."""
    places = (claim.application.place or Requirement() for claim in claims)
    required = candidates.requirement_of(service) if service else reduce(Requirement.united, places)
    inputs: dict[str, dict[InputTopic, None]] = {}
    for claim in claims:
        for role, topics in claim.application.inputs.items():
            inputs.setdefault(role, {}).update(dict.fromkeys(topics))
    united = {role: tuple(topics) for role, topics in inputs.items()}
    app = claims[0].application.with_inputs(united)
    demanded = Item(app, requesters_of(claims))
    choice = Choice(demanded, required, world, room, claims, service)
    reasons: list[str] = []
    # On the sender's own node, no connection would rename the topic.
    renamed = {
        flow.sender: route
        for claim in claims
        for flow in flows(world.config, claim.application)
        for _, route in carriers.carrying(world.ledger, claim.demand, flow)
        if flow.delivery is None and route.read_topic != route.written_topic
    }
    for chosen in islice(choice.candidates(), candidates.MOST_TRIED):
        if route := renamed.get(chosen.node):
            problem = f"'{route.read_topic}' would not be renamed to '{route.written_topic}'"
            reasons.append(f"on {quoted(chosen.node)} {problem}")
            continue
        move = partial(candidates.on_node, node=chosen.node, service=service, world=world)
        after, changes = with_moved(world, claims, move)
        moved_names = collisions.followed(names, world, after, affected_keys(world, after, changes))
        fault = next(_faults(world, after, changes, moved_names), None)
        if fault is None:
            keys = [change.key for change in changes]
            return (after, chosen, keys, moved_names), len(reasons) + 1
        reasons.append(f"on {quoted(chosen.node)} {fault.message}")
    return sentences(reasons) or choice.none_fits().message, len(reasons)


def _brought_twice(change: ClaimChange, ledger: Ledger) -> Iterator[Fault]:
    if change.after is None or change.after.is_on_application:
        return
    former = change.before.connection.topics if change.before else ()
    held = ledger.claims_of_demand(change.key.demand)
    apps = [claim.application for claim in held if claim.is_on_application]
    connection = change.after.connection
    for index, words in carriers.chosen_twice(connection, apps, ledger):
        if connection.topics[index] not in former:
            yield Fault("conflict", "", words)


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
        ids = [*world.ledger.moved_applications()]
        if any(override.node for override in world.overrides):
            ids = sorted(world.ledger.subjects(SubjectKind.APPLICATION))
    change = partial(overrides.with_overridden_nodes, world=world)
    moving = [
        id
        for id in dict.fromkeys(ids)
        for app in [world.ledger.application(id)]
        if app is not None and change(app) != app
    ]
    together, alone = moving, list[str]()
    names = collisions.all_names(world) if moving else collisions.NONE
    while together:  # applications that share a service must move at the same time
        after, changes, moved_names = _all_moved(world, together, change, names)
        faulty = [
            id for id, own in changes.items() if next(_faults(world, after, own, moved_names), None)
        ]
        if not faulty:
            break
        together, alone = [id for id in together if id not in faulty], [*alone, *faulty]
    keys, stays = list[ClaimKey](), list[tuple[str, str]]()
    # A fault of one application may have come from another that did not move in the end. So each
    # that caused a fault is tried again, alone, after the others have moved.
    for ids in filter(None, (together, *([id] for id in alone))):
        after, changes, moved_names = _all_moved(world, ids, change, names)
        faults = (
            fault for own in changes.values() for fault in _faults(world, after, own, moved_names)
        )
        fault = None if ids is together else next(faults, None)
        if fault is None:
            world, names = after, moved_names
            keys += [each.key for own in changes.values() for each in own]
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
                        f"'{override.node}': {fault.message}"
                    )
                    stays.append((override.path, message))
    return LedgerUpdate(world.ledger, tuple(dict.fromkeys(keys)), tuple(stays))


def with_restored_moves(request: Restoration, world: World) -> Restoration:
    if not any(override.node for override in world.overrides) and not any(
        claim.is_on_application and claim.application.moved for claim in request.claims
    ):
        return request
    ledger = replace(ledger_of(request.claims), ended=world.ledger.ended)
    return replace(request, claims=tuple(following_overrides(replace(world, ledger=ledger)).ledger))


def _all_moved(
    before: World, applications: Iterable[str], move: Move, names: Names
) -> tuple[World, dict[str, tuple[ClaimChange, ...]], Names]:
    world, changes = before, dict[str, tuple[ClaimChange, ...]]()
    for id in applications:
        world, changes[id] = with_moved(world, world.ledger.application_claims(id), move)
    keys = affected_keys(before, world, [each for own in changes.values() for each in own])
    return world, changes, collisions.followed(names, before, world, keys)


def _faults(
    before: World, after: World, changes: tuple[ClaimChange, ...], names: Names
) -> Iterator[Fault]:
    """Yield the faults of moved claims; each claim is checked as if it were demanded now."""
    for change in changes:
        claim = change.after
        if claim is None:
            continue
        request, others = request_for(claim), after.ledger.replace(claim.key, None)
        yield from admission.faults(request, after.config)
        yield from permission.faults(request, after.config)
        yield from conflicts(request.demanded[0], others)
        override = overrides.suspended_by(claim, after)
        if override and change.before and not overrides.suspended_by(change.before, before):
            yield Fault("denied", "", f"{claim.subject} would be denied by {override.path}")
    yield from quotas.quota_faults(before, after, Changes(changes))
    for change in changes:
        if change.after:
            yield from collisions.faults_of_claim(change.after, before, after)
            yield from _brought_twice(change, after.ledger)
    keys = affected_keys(before, after, changes)
    yield from collisions.name_faults(Demand("drain"), before, after, keys, Changes(changes), names)


# ---- changes to the ledger when overrides change or end: kept claims, moved services, markers ----
#
# A marker is a file of the ledger that records that an override has ended. When an override in
# effect reaches its end, the generator publishes a commit with the marker. Until then the override
# stays in effect, so what runs depends on files alone and not on a clock.


def update_ledger(
    before: World,
    after: World,
    subjects: Iterable[Subject],
    markers: Mapping[str, str],
    now: datetime,
) -> LedgerUpdate:
    """Return the ledger that a change of the configuration requires, and the files to write.

    ``subjects`` are those whose claims a person changed. ``markers`` are the ledger's markers of
    ended overrides, by path.
    """
    # An override that is merged after its end never applies. One that was in effect before stays
    # in effect until the generator's own commit ends it.
    in_effect = {override.name: override.end for override in before.overrides}
    expired = [
        override
        for override in expired_overrides(after, now)
        if override.name not in in_effect or in_effect[override.name] != override.end
    ]
    stale = records.stale_markers(markers, after.config.overrides)
    ended = {
        name: end
        for name, end in after.ledger.ended.items()
        if records.ended_override_path(name) not in stale
    }
    ended |= {each.name: format_time(each.end) for each in expired if each.end}
    files: dict[str, str | None] = dict.fromkeys(stale)
    for override in expired:
        files |= _marker(override)
    after = replace(after, ledger=replace(after.ledger, ended=ended))
    kept = (*overrides.kept_subjects(before.ledger), *overrides.kept_subjects(after.ledger))
    update = update_claims(before.ledger, after, dict.fromkeys((*subjects, *kept)), now)
    moved = following_overrides(replace(after, ledger=update.ledger))
    keys = (*update.keys, *moved.keys)
    files |= changed_claim_files(after.ledger, moved.ledger, keys)
    return replace(moved, keys=keys, files=files)


def update_claims(
    before: Ledger, after: World, subjects: Iterable[Subject], now: datetime
) -> LedgerUpdate:
    subjects = tuple(subjects)
    ledger, kept = overrides.update_kept_claims(before, after, subjects, now)
    moved = following_overrides(replace(after, ledger=ledger), subjects)
    keys = (*kept, *moved.keys)
    files = changed_claim_files(after.ledger, moved.ledger, keys)
    return replace(moved, keys=keys, files=files)


def end_override(world: World, override: Override, now: datetime) -> LedgerUpdate:
    if override.end is None:
        raise ValueError(f"{override.path} has no end")
    ended = {**world.ledger.ended, override.name: format_time(override.end)}
    after = replace(world, ledger=replace(world.ledger, ended=ended))
    update = update_ledger(world, after, (), {}, now)
    return replace(update, files={**update.files, **_marker(override)})


def _marker(override: Override) -> dict[str, str]:
    return {records.ended_override_path(override.name): records.ended_override_text(override)}


def changed_claim_files(
    before: Ledger, after: Ledger, keys: Iterable[ClaimKey]
) -> dict[str, str | None]:
    """Return the new texts of the files of changed claims, by path; ``None`` removes a file."""
    files: dict[str, str | None] = {}
    for key in keys:
        claim = after.get(key)
        if claim != before.get(key):
            files[claim_files.path_of(key)] = claim_files.text_of(claim) if claim else None
    return files


def expired_overrides(world: World, now: datetime) -> list[Override]:
    """Return the overrides in effect although their end has passed, sorted by end."""
    ends = [(each.end, each.name, each) for each in world.overrides if each.end]
    expired = [each for each in ends if each[0] <= now]
    return [override for _, _, override in sorted(expired, key=lambda each: each[:2])]


def changed_override_files(before: World, after: World) -> list[str]:
    old = {override.name: override for override in before.overrides}
    new = {override.name: override for override in after.overrides}
    names = [name for name in {*old, *new} if old.get(name) != new.get(name)]
    return sorted((new.get(name) or old[name]).path for name in names)
