"""Changes the ledger as a request asks, or refuses it. :func:`apply`, at the end, is the way in."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime

from demandops.base.errors import Fault, Refused, fault, suggestion
from demandops.base.naming import Subject, SubjectKind, TopicKey
from demandops.connections import connection as routes
from demandops.connections.connection import Connection
from demandops.decide.admission import admission, permission
from demandops.model.demand.demand import (
    Application,
    Decommission,
    Demand,
    Item,
    Operation,
    Rollback,
)
from demandops.model.ledger.claim import Claim, ClaimKey, demand_id, path_of, requesters_of
from demandops.model.ledger.ledger import Changes, ClaimChange, Ledger, World, claim_changes
from demandops.model.ledger.records import Wait


def claims_of(ledger: Ledger, request: Demand) -> tuple[Claim, ...]:
    """Return the claims of the request's demand; raise Refused if it holds none."""
    held = ledger.claims_with("demand", request.demand)
    if not held:
        demands = sorted(
            {
                claim.demand
                for requester in request.own_requesters
                for claim in ledger.claims_with("requester", requester)
                if claim.keeping_override is None
            }
        )
        hint = "the demand has ended, or was never booked; see 'demandops log'"
        if demands:
            hint = f"the requesters of this request hold, for example, {', '.join(demands[:5])}"
        message = f"'{request.demand}' holds nothing; {hint}"
        raise Refused.at("demand", message, code="not-held")
    return held


# ---- conflicts: a demand contradicts existing claims on the same application or connection ----


def conflicts(  # noqa: PLR0912 - a branch for each contradiction
    item: Item, ledger: Ledger, *, above: bool = False
) -> Iterator[Fault]:
    """Yield the faults of an item that contradicts claims, or with ``above`` earlier items."""
    held = item.held
    against = f"contradicts {'an item above' if above else 'an existing claim'}"
    by = "listed for" if above else "held by"
    if isinstance(held, Application):
        # all claims on an application agree about its node and type, so the first speaks for all
        first = ledger.first_claim(held.subject)
        if first is None:
            return
        booked, holders = first.application, ", ".join(first.requesters)
        wait = "" if above else ", or wait until the application is released"
        for name, new, current, holding, remedy in (
            ("node", held.node, booked.node, "on", f"request node '{booked.node}'{wait}"),
            ("type", held.appdef, booked.appdef, "as", "use another application id"),
        ):
            if new != current:
                message = (
                    f"'{new}' {against}: '{held.id}' is {by} {holders} {holding} '{current}'; "
                    f"{remedy}"
                )
                yield item.fault(name, message, code="conflict")
                return
        return
    told = set[str]()  # a contradiction with several claims is told once
    for claim in ledger.connection_claims(held.id):
        holding = f"'{held.id}' is {by} {', '.join(claim.requesters)}"
        for name, new, current in (
            ("source", held.source, claim.connection.source),
            ("target", held.target, claim.connection.target),
        ):
            if new != current:
                message = (
                    f"'{new}' {against}: {holding} with {name} '{current}'; use the same {name}, "
                    "or another connection id"
                )
                yield item.fault(name, message, code="conflict")
                return
        by_source = {route.source: route for route in claim.connection.topics}
        carried_back = {r.target: r for r in claim.connection.topics if r.reverse}
        faults: list[tuple[str, str]] = []
        for index, route in enumerate(held.topics):
            where, carried = f"topics[{index}]", by_source.get(route.source)
            if carried is None:
                if route.reverse and (other := carried_back.get(route.target)):
                    message = (
                        f"connection {holding} and already carries '{route.target}' back to "
                        f"'{other.source}'; a connection carries a target topic back to only one "
                        "source topic, so use a second connection"
                    )
                    faults.append((f"{where}.target", message))
                continue
            if carried.target != route.target:
                message = (
                    f"connection {holding} and already carries '{route.source}' to "
                    f"'{carried.target}'; a connection carries a source topic to only one "
                    "target topic, so use a second connection"
                )
                faults.append((f"{where}.target", message))
            for option, old, demanded in routes.contradictions(carried, route):
                message = (
                    f"{option} {demanded} of '{route.source}' {against}: {holding} with {option} "
                    f"{old}; use the same {option}"
                )
                faults.append((f"{where}.{option}", message))
        for field, message in faults:
            conflict = item.fault(field, message, code="conflict")
            if conflict.field not in told:
                told.add(conflict.field)
                yield conflict


# ---- the operations: what each kind of request changes in the ledger ----


def book(
    ledger: Ledger,
    item: Item,
    request: Demand,
    key: ClaimKey,
    current: Claim | None,
    now: datetime,
    *,
    joined: bool = False,
) -> Ledger:
    """Book an item; ``current`` is the demand's claim on the same subject so far."""
    lease = item.lease
    if lease and not request.awaits_approval:
        lease = lease.started(now, current.lease if current else None)
    held = item.held.booked()
    if joined and current:  # with everything added that the claim so far holds
        held = current.held.extended(held).booked()  # type: ignore[arg-type]
    claim = Claim(
        held=held,
        demand=key.demand,
        request=request.id,
        requesters=tuple(sorted(set(item.requesters))),
        booked=now,
        lease=lease,
        joined=joined,
    )
    # The time of booking stays if at most the lease changes. Else each renewal, and each demand
    # that is sent again, would change the claim's file.
    if current and replace(claim, booked=current.booked, lease=current.lease) == current:
        claim = replace(claim, booked=current.booked)
    return ledger.replace(key, claim)


def join(ledger: Ledger, request: Demand, now: datetime) -> tuple[Ledger, Changes]:
    # A goal of the reference's action adds to what its demand already holds.
    faults: list[Fault] = []
    start = ledger
    keys: list[ClaimKey] = []
    listed = set[Subject]()
    for item in request.demanded:
        with_claims = [*conflicts(item, start)]
        # an item that contradicts a claim and an item above is reported once for each field
        fields = {each.field for each in with_claims}
        above = conflicts(item, ledger, above=True) if item.held.subject in listed else ()
        faults += [*with_claims, *(each for each in above if each.field not in fields)]
        listed.add(item.held.subject)
        key = ClaimKey(item.held.subject, demand_id(request.id, item.requesters))
        # a put may have chosen this id for its demand, because demand ids are free text
        others = [
            claim
            for claim in start.claims_with("demand", key.demand)
            if not claim.joined or {*claim.requesters}.isdisjoint(item.requesters)
        ]
        if others:
            message = (
                f"gives the demand id {key.demand}, which belongs to a demand of "
                f"{', '.join(requesters_of(others))}; use another id"
            )
            faults.append(fault("id", message, code="conflict"))
        ledger = book(ledger, item, request, key, ledger.get(key), now, joined=True)
        keys.append(key)
    if faults:
        raise Refused(faults)
    changes = claim_changes(start, ledger, keys)
    return ledger, Changes(claims=changes)


def put(ledger: Ledger, request: Demand, now: datetime) -> tuple[Ledger, Changes]:
    # After a put, a demand with an id holds exactly what the put lists.
    start, demand = ledger, request.demand
    held = ledger.claims_with("demand", demand)
    waited = (demand,) * (demand in ledger.waiting)
    # the demand's own claims are no contradiction, because a put may move its own applications
    ledger = others = ledger.without(held)
    faults: list[Fault] = []
    keys = [claim.key for claim in held]
    for item in request.demanded:
        faults += conflicts(item, others)
        key = ClaimKey(item.held.subject, demand)
        if ledger.get(key) is not None:
            message = f"'{key.subject.id}' is listed twice; list it once, with all its topics"
            if isinstance(item.held, Connection):
                message = (
                    f"'{key.subject.id}' is listed between several nodes, or carries another topic "
                    "of this demand between others; use a second connection id"
                )
            faults.append(item.fault("id", message))
        ledger = book(ledger, item, request, key, start.get(key), now)
        keys.append(key)
    if faults:
        raise Refused(faults)
    changes = Changes(claims=claim_changes(start, ledger, keys), waiting=waited)
    return ledger.without_waiting(waited), changes


def shut_down(ledger: Ledger, request: Demand) -> tuple[Ledger, Changes]:
    """Take what a shutdown lists, or all of an item that lists nothing.

    It takes from the claims that joins with its own request id and exactly its own requesters
    booked, and never from others. So a shutdown that is sent again, or that nobody's join preceded,
    ends nothing that somebody else demands.
    """
    taken, not_held = dict[ClaimKey, set[TopicKey]](), list[str]()
    for item in request.demanded:
        subject, who = item.held.subject, ", ".join(sorted(set(item.requesters)))
        mine = [
            claim
            for claim in ledger.claims_with("demand", demand_id(request.id, item.requesters))
            if claim.joined
        ]
        listing = _listed_inputs if isinstance(item.held, Application) else _listed_routes
        for words, held in listing(item.held, mine):  # type: ignore[arg-type]
            for key, topics in held:
                taken.setdefault(key, set()).update(topics)
            if not held:
                not_held.append(
                    f"{subject}: {words} for {who}" if words else f"{subject} for {who}"
                )
    if not taken:
        similar = [
            f"{claim.subject} for {', '.join(claim.requesters)} ("
            + (
                f"request '{claim.request}')"
                if claim.joined
                else f"demand '{claim.demand}', which a shutdown cannot end)"
            )
            for subject in request.subjects()
            for claim in ledger.claims_on(subject)
        ] or [
            f"{claim.subject} for {', '.join(claim.requesters)}"
            for requester in sorted(request.requesters())
            for claim in ledger.claims_with("requester", requester)
        ]
        shown = "; ".join(dict.fromkeys(similar[:5])) or "none"
        message = (
            f"nothing that the shutdown lists is held by a join with the id '{request.id}' and the "
            f"same requesters; similar claims: {shown}"
        )
        place = request.demanded[0].fault if request.demanded else fault
        raise Refused([place("id", message, code="not-held")])
    after = ledger
    for key, topics in taken.items():
        claim = ledger.get(key)
        after = after.replace(key, claim and claim.without_topics(topics))
    changes = claim_changes(ledger, after, taken)
    return after, Changes(claims=changes, not_held=tuple(dict.fromkeys(not_held)))


# (words, claims and their topics) for each topic that a shutdown lists; no words: for the subject
_Keys = list[tuple[ClaimKey, set[TopicKey]]]
_Listed = Iterator[tuple[str, _Keys]]


def _listed_inputs(listed: Application, claims: list[Claim]) -> _Listed:
    claim = next((claim for claim in claims if claim.subject == listed.subject), None)
    app = claim.application if claim else listed
    if claim is None or listed.node not in ("", app.node) or listed.appdef != app.appdef:
        yield "", []
    elif any(listed.inputs.values()):
        by_name: dict[TopicKey, list[TopicKey]] = {}
        for key in app.topic_keys():
            by_name.setdefault(key[:2], []).append(key)
        for role, topic in listed.all_inputs():
            named = by_name.get((role, topic.topic), ())
            # listed without a source, a topic is that of any source
            keys = {key for key in named if topic.source in ("", key[2])}
            words = f"{role} {topic.topic} of {topic.source}"
            yield words, [(claim.key, keys)] if keys else []
    else:
        yield "", [(claim.key, set(app.topic_keys()))]


def _listed_routes(listed: Connection, claims: list[Claim]) -> _Listed:
    """Find the routes wherever the demand has them; a node that is left out matches any node."""
    nodes = {*filter(None, listed.nodes)}
    claims = [c for c in claims if not c.is_on_application and nodes <= {*c.connection.nodes}]
    if not listed.topics:
        listing = {
            claim.key: {
                (route.source,)
                for route in claim.connection.topics
                if not route.implied and (route.listed or claim.subject.id) == listed.id
            }
            for claim in claims
        }
        yield "", [(key, set[TopicKey](topics)) for key, topics in listing.items() if topics]
        return
    held: list[tuple[str, _Keys]] = []
    for route in listed.topics:
        named, keys = (route.read_topic, route.written_topic), _Keys()
        for claim in claims:
            is_same = claim.subject == listed.subject
            booked = claim.connection.route(route.source) if is_same else None
            for other in filter(None, map(claim.connection.route, dict.fromkeys(named))):
                if booked is None and (other.read_topic, other.written_topic) == named:
                    booked = other
            if booked:
                keys.append((claim.key, {(booked.source,)}))
        held.append((f"topic {route.source}", keys))
    if not any(keys for _, keys in held) and not any(c.subject == listed.subject for c in claims):
        held = [("", [])]
    yield from held


def decommission(  # noqa: PLR0912 - of four kinds
    ledger: Ledger, request: Decommission
) -> tuple[Ledger, Changes]:
    """Release or reduce claims, because a person ends them.

    If a node is decommissioned, these are released for all requesters: the applications that run on
    the node, the inputs from it, the deliveries to it, and the connections from or to it. A
    connection that names the node's broker loses the broker. If a requester is decommissioned, all
    its claims are released, also those that name others, who might never release them. A demand, or
    the claims on an application, are released for all their requesters.
    """
    start, claims, waiting = ledger, dict[str, Claim](), tuple[str, ...]()
    nodes = request.nodes or (request.id,)
    if "node" in request.kinds:
        needing = (c for node in nodes for c in ledger.claims_needing(node))
        claims |= {f"{c.subject} {c.demand}": c for c in needing}
    if "requester" in request.kinds:
        held = ledger.claims_with("requester", request.id)
        claims |= {f"{c.subject} {c.demand}": c for c in held}
        # a waiting demand that names others too stays, because they can still release it
        demands = ledger.waiting.values()
        waiting = tuple(each.demand for each in demands if each.requesters == (request.id,))
    whole = list[Claim]()
    if "demand" in request.kinds:
        whole += ledger.claims_with("demand", request.id)
        waiting += (request.id,) * (request.id in ledger.waiting)
    if "application" in request.kinds:
        whole += ledger.application_claims(request.id)
    for claim in whole:
        if claim.keeping_override is None:  # an override keeps it as long as the override is there
            ledger = ledger.replace(claim.key, None)
    for claim in claims.values():
        left: Claim | None = claim
        if "requester" in request.kinds and request.id in claim.requesters:
            left = None
        for node in nodes:
            left = left.without_node(node) if left and left.held.needs(node) else left
        ledger = ledger.replace(claim.key, left)
    changes = claim_changes(start, ledger, [c.key for c in (*claims.values(), *whole)])
    if not changes and not waiting:
        names = start.indexed_names("requester") if "requester" in request.kinds else set()
        if "node" in request.kinds:
            names |= start.indexed_names("node") | start.indexed_names("link")
        if "demand" in request.kinds:
            names |= start.indexed_names("demand") | {*start.waiting}
        if "application" in request.kinds:
            names |= {*start.subjects(SubjectKind.APPLICATION)}
        kinds = " or ".join(sorted(request.kinds))
        message = f"no claim names the {kinds} '{request.id}'{suggestion(request.id, names)}"
        raise Refused.at("name", message, code="not-held")
    return ledger.without_waiting(waiting), Changes(claims=changes, waiting=waiting)


@dataclass(frozen=True, slots=True)
class Drain(Demand):
    """The generator's request to move what it placed on the drained node ``id``.

    :mod:`.relocation` determines which claims change. ``moved`` and ``stays`` have a text about
    each application or service that moves or cannot move.
    """

    operation: Operation = "drain"
    is_complete: bool = True
    # One drain looks only for so many nodes, because demands wait meanwhile. It begins with the
    # application that follows ``after`` in the order of ids. If some are left for another drain,
    # ``last`` is the last one before them.
    after: str = ""
    last: str = ""
    moves: tuple[ClaimChange, ...] = ()
    moved: tuple[str, ...] = ()
    stays: tuple[str, ...] = ()


# ---- a restoration books the claims of an earlier commit again ----
#
# It undoes newer claims only if the request says so. Afterwards, as after every change,
# :mod:`.overrides` updates the claims that overrides keep.

_MOST_SHOWN = 20


@dataclass(frozen=True, slots=True)
class Restoration(Rollback):
    """A rollback with the claims of the commit ``to``."""

    is_complete: bool = True
    claims: tuple[Claim, ...] = ()


def restore(ledger: Ledger, request: Restoration, now: datetime) -> tuple[Ledger, Changes]:
    """Restore the claims; raise Refused if newer ones would change without ``drop_newer``."""
    changes = _restored(ledger, request)
    # claims that overrides keep do not count, because they are made again
    newer = [(c, c.before) for c in changes if c.before and c.before.keeping_override is None]
    if newer and not request.drop_newer:
        refusals: list[Fault] = []
        for change, claim in newer[:_MOST_SHOWN]:
            effect = "drop" if change.after is None else "undo a change of"
            message = (
                f"would {effect} the claim of {', '.join(claim.requesters)} on {claim.subject}, "
                f"booked {claim.booked:%Y-%m-%d %H:%M:%S} UTC (request '{claim.request}')"
            )
            refusals.append(fault("", message, code="newer").within(path_of(claim.key)))
        more = len(newer) - _MOST_SHOWN
        what = f"{more} more {'claims' if more > 1 else 'claim'} would change; " if more > 0 else ""
        message = (
            f"{what}claims that were booked or changed since are undone only with --drop-newer"
        )
        raise Refused([*refusals, fault("", message, code="newer")])
    start = ledger
    for change in changes:
        restored = change.after
        if restored and restored.lease:  # from now on, because its old end may have passed
            restored = replace(restored, lease=restored.lease.started(now))
        ledger = ledger.replace(change.key, restored)
    keys = [change.key for change in changes]
    return ledger, Changes(claims=claim_changes(start, ledger, keys))


def _restored(ledger: Ledger, request: Restoration) -> list[ClaimChange]:
    now, then, app = list(ledger), list(request.claims), request.application
    if request.demand or app:
        of_app = {c.demand for c in (*now, *then) if c.is_on_application and c.subject.id == app}
        demands = {request.demand} if request.demand else of_app
        now, then = (
            [
                claim
                for claim in claims
                if claim.demand in demands
                and (not app or not claim.is_on_application or claim.subject.id == app)
            ]
            for claims in (now, then)
        )
        if not (now or then):
            what = f"application '{app}'" if app else f"demand '{request.demand}'"
            message = f"no claim of {what} is here, nor was one at commit {request.to[:10]}"
            raise Refused.at("", message, code="not-held")
    earlier = {claim.key: claim for claim in then}
    changes = [ClaimChange(claim, None) for claim in now if claim.key not in earlier]
    for key, claim in earlier.items():
        current = ledger.get(key)
        if current is not None:
            # a renewal is no change, and neither is a claim that an override kept at another time
            is_kept = current.keeping_override is not None
            booked = claim.booked if is_kept else current.booked
            same_lease = bool(current.lease) == bool(claim.lease)
            if same_lease and replace(current, booked=booked, lease=claim.lease) == claim:
                continue
        changes.append(ClaimChange(current, claim))
    return sorted(changes, key=lambda change: path_of(change.key))


def restoration_faults(request: Restoration, world: World) -> Iterator[Fault]:
    for change in _restored(world.ledger, request):
        after = change.after
        if after is None or after.keeping_override is not None:
            continue
        booking, config = request_for(after), world.config
        for each in (*admission.faults(booking, config), *permission.faults(booking, config)):
            yield each.within(path_of(change.key))


def request_for(claim: Claim) -> Demand:
    """Return a request that books this claim; its faults name fields of the claim."""
    return Demand(
        "put",
        id=claim.request,
        demanded=(Item(claim.held, claim.requesters),),
        demand=claim.demand,
        lease_s=claim.lease.seconds if claim.lease else None,
    )


# ---- the way in ----


def apply(  # noqa: PLR0912 - a case for each operation
    ledger: Ledger, request: Demand, now: datetime
) -> tuple[Ledger, Changes]:
    """Return the ledger after an admitted request is carried out, and the changes.

    If the same request is booked already, at most the leases of its claims change.
    ``docs/demand.md``, "How a demand is booked", says what each operation means.
    """
    after, demand = ledger, request.demand
    waited = (demand,) * (demand in ledger.waiting)
    match request:
        case Demand(operation="join"):
            return join(ledger, request, now)
        case Demand(operation="shutdown"):
            return shut_down(ledger, request)
        case Demand(operation="put"):
            return put(ledger, request, now)
        case Decommission():
            return decommission(ledger, request)
        case Restoration():
            return restore(ledger, request, now)
        case Demand(operation="release"):
            held = ledger.claims_with("demand", demand) if waited else claims_of(ledger, request)
            after, keys = ledger.without(held).without_waiting(waited), [c.key for c in held]
            return after, Changes(claims=claim_changes(ledger, after, keys), waiting=waited)
        case Demand(operation="renew"):
            # a demand that waits has no lease yet, but its client may renew it already
            if waited and not ledger.claims_with("demand", demand):
                return ledger, Changes()
            held = claims_of(ledger, request)
            keys = [claim.key for claim in held]
            for claim in held:
                if claim.lease is not None:
                    renewed = claim.lease.started(now, claim.lease)
                    after = after.replace(claim.key, replace(claim, lease=renewed))
        case Demand(operation="expire"):
            held = ledger.claims_with("demand", demand)
            ended = [claim for claim in held if claim.lease and claim.lease.has_ended(now)]
            readers = [c for c in held if c.is_on_application and c.application.read_outputs]
            for claim in ended:  # what reads it ends with it, and may be read itself
                read = claim.subject.id if claim.is_on_application else ""
                more = [c for c in readers if read in c.application.read_outputs]
                ended += [c for c in more if c not in ended]
            after, keys = ledger.without(ended), [claim.key for claim in ended]
        case Wait():
            assert request.waiting is not None  # noqa: S101 - the decision sets it
            waiting = ledger.waiting.insert(demand, request.waiting)
            is_new = ledger.waiting.get(demand) != request.waiting
            return replace(ledger, waiting=waiting), Changes(waiting=(demand,) * is_new)
        case Drain():
            keys = [move.key for move in request.moves]
            for move in request.moves:
                after = after.replace(move.key, move.after)
        case _:
            raise TypeError(f"a {request.operation} cannot be applied")
    return after, Changes(claims=claim_changes(ledger, after, keys))
