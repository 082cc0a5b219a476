"""Changes the ledger as a request asks, or refuses it. :func:`apply`, at the end, is the way in."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime

from demandops.base.errors import Fault, Refused, fault, suggestion
from demandops.base.naming import Subject, SubjectKind, TopicKey
from demandops.connections import connection as routes
from demandops.connections.connection import Connection
from demandops.decide.restoration import Restoration, restore
from demandops.model.demand.claim import Application, Claim, ClaimKey, Term, demand_id, renewed
from demandops.model.demand.demand_request import (
    Decommission,
    Demanded,
    DemandRequest,
    Expire,
    Join,
    Put,
    Release,
    Renew,
    Shutdown,
)
from demandops.model.ledger.ledger import Changes, ClaimChange, Ledger, claim_changes
from demandops.model.ledger.records import RecentShutdown, Wait

# ---- owners: the requesters for whom a demand that has an id holds claims or waits ----
#
# A request is refused if it names none of the owners. So if a second requester chooses the same
# demand id by chance, its requests cannot change the demand of the first requester.


def is_waiting(ledger: Ledger, request: DemandRequest) -> bool:
    """Return whether the request's demand waits; raise :class:`Refused` if it is of other
    requesters.
    """
    waiting = ledger.waiting.get(request.demand)
    if waiting is not None:
        _refuse_others(waiting.requesters, request)
    return waiting is not None


def owned_claims(ledger: Ledger, request: DemandRequest) -> tuple[Claim, ...]:
    """Return the claims of the demand; raise Refused if it holds none or is of others."""
    held = ledger.claims_of_demand(request.demand)
    if not held:
        demands = sorted(
            {
                claim.demand
                for requester in request.own_requesters
                for claim in ledger.claims_of_requester(requester)
                if claim.keeping_override is None
            }
        )
        hint = "the demand has ended, or was never booked; see 'demandops log'"
        if demands:
            hint = f"the requesters of this request hold, for example, {', '.join(demands[:5])}"
        message = f"'{request.demand}' holds nothing; {hint}"
        raise Refused.at("demand", message, code="not-held")
    refuse_other_owners(held, request)
    return held


def refuse_other_owners(held: Iterable[Claim], request: DemandRequest) -> None:
    """Raise :class:`Refused` if the claims belong to none of the request's requesters."""
    _refuse_others({requester for claim in held for requester in claim.requesters}, request)


def _refuse_others(owners: Iterable[str], request: DemandRequest) -> None:
    owners = sorted(owners)
    if owners and not set(owners) & set(request.requesters()):
        message = (
            f"'{request.demand}' is a demand of {', '.join(owners)}; name one of them, or choose "
            "another demand id"
        )
        raise Refused.at("demand", message, code="not-yours")


# ---- conflicts ----
#
# Contradictions between a demand and existing claims on the same application or connection.


def conflicts(item: Demanded, ledger: Ledger, *, above: bool = False) -> Iterator[Fault]:
    """Yield the faults of a demanded application or connection that contradicts claims on it.

    With ``above``, the messages say that ``item`` contradicts an earlier item of the same request.
    """
    if isinstance(item.held, Application):
        yield from _application_conflicts(item, item.held, ledger, above)
    else:
        yield from _connection_conflicts(item, item.held, ledger, above)


def _contradicts(above: bool) -> str:
    return f"contradicts {'an item above' if above else 'an existing claim'}"


def _held(claim: Claim, above: bool) -> str:
    holders = ", ".join(claim.requesters)
    return f"'{claim.held.id}' is {'listed for' if above else 'held by'} {holders}"


def _application_conflicts(
    item: Demanded, app: Application, ledger: Ledger, above: bool
) -> Iterator[Fault]:
    # all claims on an application agree about its node and type, so the first speaks for all
    claim = ledger.first_claim(app.subject)
    if claim is None:
        return
    booked = claim.application
    wait = "" if above else ", or wait until the application is released"
    for name, new, current, holding, remedy in (
        ("node", app.node, booked.node, "on", f"request node '{booked.node}'{wait}"),
        ("appdef", app.appdef, booked.appdef, "as", "use another application id"),
    ):
        if new != current:
            message = (
                f"'{new}' {_contradicts(above)}: {_held(claim, above)} {holding} '{current}'; "
                f"{remedy}"
            )
            yield item.fault(name, message, code="conflict")
            return


def _connection_conflicts(
    item: Demanded, demanded: Connection, ledger: Ledger, above: bool
) -> Iterator[Fault]:
    for claim in ledger.connection_claims(demanded.id):
        booked = claim.connection
        for name, new, current in (
            ("type", str(demanded.type), str(booked.type)),
            ("source", demanded.source, booked.source),
            ("target", demanded.target, booked.target),
            ("broker", demanded.broker, booked.broker),
        ):
            # a broker that only one of the two names is no contradiction
            if new == current or (name == "broker" and not (new and current)):
                continue
            message = (
                f"'{new}' {_contradicts(above)}: {_held(claim, above)} with {name} '{current}'; "
                f"use the same {name}, or another connection id"
            )
            yield item.fault(name, message, code="conflict")
            return
        yield from _route_conflicts(item, demanded, claim, above)


def _route_conflicts(
    item: Demanded, demanded: Connection, claim: Claim, above: bool
) -> Iterator[Fault]:
    held = _held(claim, above)
    by_source = {route.source: route for route in claim.connection.topics}
    carried_back = {route.target: route for route in claim.connection.topics if route.reverse}
    for index, route in enumerate(demanded.topics):
        where, current = f"topics[{index}]", by_source.get(route.source)
        if current is None:
            if route.reverse and (other := carried_back.get(route.target)):
                message = (
                    f"connection {held} and already carries '{route.target}' back to "
                    f"'{other.source}'; a connection carries a target topic back to only one "
                    "source topic, so use a second connection"
                )
                yield item.fault(f"{where}.target", message, code="conflict")
            continue
        if current.target != route.target:
            message = (
                f"connection {held} and already carries '{route.source}' to '{current.target}'; a "
                "connection carries a source topic to only one target topic, so use a second "
                "connection"
            )
            yield item.fault(f"{where}.target", message, code="conflict")
        for name, old, new in routes.contradictions(current, route):
            message = (
                f"{name} {new} of '{route.source}' {_contradicts(above)}: {held} with "
                f"{name} {old}; use the same {name}, or a second connection"
            )
            yield item.fault(f"{where}.{name}", message, code="conflict")


# ---- the booking of one demanded application or connection ----


def book(
    ledger: Ledger,
    item: Demanded,
    request: str,
    key: ClaimKey,
    current: Claim | None,
    now: datetime,
    *,
    joined: bool = False,
) -> Ledger:
    """Return the ledger with a claim on a demanded application or connection.

    ``current`` is the demand's claim on the same subject so far. A join keeps what it holds.
    """
    claim = Claim(
        held=item.held.booked(),
        demand=key.demand,
        request=request,
        requesters=tuple(sorted(set(item.requesters))),
        booked=now,
        lease=renewed(current.lease if current else None, item.term, now),
        joined=joined,
    )
    if joined and current:
        claim = claim.extending(current)
    return ledger.replace(key, claim.after_booking(current))


# ---- a join: a goal of the reference's action adds to what its demand already holds ----


def join(ledger: Ledger, request: Join, now: datetime) -> tuple[Ledger, Changes]:
    """Return the ledger with the request's items added to what is held, and the changes."""
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
        claims = start.claims_of_demand(key.demand)
        owners = {who for claim in claims for who in claim.requesters}
        if owners and owners.isdisjoint(item.requesters):
            message = (
                f"gives the demand id {key.demand}, which belongs to a demand of "
                f"{', '.join(sorted(owners))}; use another id"
            )
            faults.append(fault("id", message, code="conflict"))
        ledger = book(ledger, item, request.id, key, ledger.get(key), now, joined=True)
        keys.append(key)
    if faults:
        raise Refused(faults)
    changes = claim_changes(start, ledger, keys)
    if not changes:
        return start, Changes()
    # A join that only renews claims keeps the records of recent shutdowns. If it removed the record
    # of a shutdown, a repeat of this shutdown would count as a new one and end another demand.
    adds = not all(change.only_renews for change in changes)
    shutdowns, forgotten = start.shutdowns.forget(now, request.requesters() if adds else ())
    return replace(ledger, shutdowns=shutdowns), Changes(claims=changes, shutdowns=forgotten)


# ---- a put: a demand with an id holds exactly the applications and connections that it lists ----


def put(ledger: Ledger, request: Put, now: datetime) -> tuple[Ledger, Changes]:
    """Return the ledger in which the demand holds only what ``request`` lists, and the changes."""
    start, demand = ledger, request.demand
    held = ledger.claims_of_demand(demand)
    refuse_other_owners(held, request)
    waited = (demand,) * is_waiting(ledger, request)
    # the demand's own claims are no contradiction, because a put may move its own applications
    ledger = others = ledger.without(held)
    faults: list[Fault] = []
    keys = [claim.key for claim in held]
    for item in request.demanded:
        faults += conflicts(item, others)
        key = ClaimKey(item.held.subject, demand)
        if ledger.get(key) is not None:
            message = f"'{key.subject.id}' is listed twice; list it once, with all its topics"
            faults.append(item.fault("id", message))
        ledger = book(ledger, item, request.id, key, start.get(key), now)
        keys.append(key)
    if faults:
        raise Refused(faults)
    changes = Changes(claims=claim_changes(start, ledger, keys), waiting=waited)
    return ledger.without_waiting(waited), changes


# ---- a shutdown takes one hold from each requester that it names, on each topic that it lists ----
#
# If several claims hold the topic for the requester, the hold is taken from the first of:
#
# 1. the claim with the shutdown's request id and requesters
# 2. the oldest other claim with this request id
# 3. the oldest claim with another request id
#
# If the shutdown lists no topic of an application or a connection, it takes all holds that the
# requester has in the first of these claims. A shutdown never takes holds from the claims of a
# demand that has an id.


def shut_down(ledger: Ledger, request: Shutdown, now: datetime) -> tuple[Ledger, Changes]:
    """Return the ledger without the holds that a shutdown lists, and the changes."""
    record = RecentShutdown.of(request, now)
    repeats = ledger.shutdowns.earlier(record)
    if repeats is not None:
        return ledger, Changes(repeats=repeats)
    start, not_held = ledger, list[str]()
    taken: dict[tuple[ClaimKey, str], set[TopicKey]] = {}
    for item in request.demanded:
        own = demand_id(request.id, item.requesters)
        for requester in item.requesters:
            # look in the ledger before the request, so that a topic listed twice is taken once
            claims = sorted(
                (
                    claim
                    for claim in start.claims_held_by(requester, item.held.subject)
                    if claim.joined and claim.held.matches_listed(item.held)
                ),
                key=lambda c: (c.demand != own, c.request != request.id, c.booked, c.demand),
            )
            for words, claim, held in _holds(item, requester, claims):
                if claim is None:
                    not_held.append(words)
                else:
                    taken.setdefault((claim.key, requester), set()).update(held)
    for (key, requester), topics in taken.items():
        left = ledger.get(key)
        assert left is not None  # noqa: S101 - the requester's holds are in the claim until now
        ledger = ledger.replace(key, left.without_holds(requester, topics))
    if not taken:
        raise Refused([_nothing_held(start, request)])
    shutdowns, forgotten = ledger.shutdowns.forget(now)
    ledger = replace(ledger, shutdowns=shutdowns.replace(record.digest, record))
    return ledger, Changes(
        claims=claim_changes(start, ledger, [key for key, _ in taken]),
        not_held=tuple(dict.fromkeys(not_held)),
        shutdowns=(*forgotten, record.digest),
    )


def _holds(
    item: Demanded, requester: str, claims: list[Claim]
) -> Iterator[tuple[str, Claim | None, list[TopicKey]]]:
    """Yield (text, claim, keys) for each topic that a shutdown lists.

    ``claim`` is the first in which the requester holds matching topics, whose keys are ``keys``.
    """
    subject = item.held.subject
    listed = [words for words, _ in item.held.listed_topics(item.held)]
    # who lists no topic means all of the first claim
    if not claims or not listed:
        first = next(iter(claims), None)
        yield f"{subject} for {requester}", first, list(first.held.topic_keys()) if first else []
        return
    by_claim = [(claim, dict(claim.held.listed_topics(item.held))) for claim in claims]
    for words in listed:
        for claim, meant in by_claim:
            held = [topic for topic in meant[words] if requester in claim.holders(topic)]
            if held:
                yield words, claim, held
                break
        else:
            yield f"{subject}: {words} for {requester}", None, []


def _nothing_held(ledger: Ledger, request: Shutdown) -> Fault:
    def origin(claim: Claim) -> str:
        if claim.joined:
            return f"request '{claim.request}'"
        return f"demand '{claim.demand}', which a shutdown cannot end"

    near = [
        f"{claim.subject} for {', '.join(claim.requesters)} ({origin(claim)})"
        for subject in request.subjects()
        for claim in ledger.claims_on(subject)
    ] or [
        f"{claim.subject} for {', '.join(claim.requesters)}"
        for requester in sorted(request.requesters())
        for claim in ledger.claims_of_requester(requester)
    ]
    shown = "; ".join(dict.fromkeys(near[:5])) or "none"
    message = f"nothing that the shutdown lists is held; similar claims: {shown}"
    if not request.demanded:
        return fault("id", message, code="not-held")
    return request.demanded[0].fault("id", message, code="not-held")


# ---- a release ends a demand that has an id: the demand gives up everything that it holds ----


def release_demand(ledger: Ledger, request: Release) -> tuple[Ledger, Changes]:
    """Return the ledger in which a demand holds nothing and does not wait, and the changes."""
    waited = (request.demand,) * is_waiting(ledger, request)
    held = ledger.claims_of_demand(request.demand) if waited else owned_claims(ledger, request)
    after = ledger.without(held).without_waiting(waited)
    claims = claim_changes(ledger, after, [claim.key for claim in held])
    return after, Changes(claims=claims, waiting=waited)


# ---- the renewal of the leases of a demand ----


def renew_leases(ledger: Ledger, request: Renew, now: datetime) -> tuple[Ledger, Changes]:
    """Return the ledger with each lease of a demand renewed for its term, and the changes."""
    # a demand that waits has no lease yet, but its client may renew it already
    if is_waiting(ledger, request) and not ledger.claims_of_demand(request.demand):
        return ledger, Changes()
    start = ledger
    held = owned_claims(ledger, request)
    for claim in held:
        if claim.lease is None:
            continue
        term = Term(claim.lease.seconds, claim.lease.slack)
        ledger = ledger.replace(claim.key, replace(claim, lease=claim.lease.renewed(term, now)))
    return ledger, Changes(claims=claim_changes(start, ledger, [claim.key for claim in held]))


# ---- an expiry releases the claims whose lease has ended. The generator requests the expiry ----


def expire(ledger: Ledger, request: Expire, now: datetime) -> tuple[Ledger, Changes]:
    held = ledger.claims_of_demand(request.demand)
    ended = [claim for claim in held if claim.lease and claim.lease.has_ended(now)]
    after = ledger.without(ended)
    return after, Changes(claims=claim_changes(ledger, after, [claim.key for claim in ended]))


# ---- decommission ----
#
# Decommissioning: a node or a requester leaves for good, so claims are released or reduced.
#
# If a node is decommissioned, these are released for all requesters: the applications that run on
# the node, the inputs from it, the deliveries to it, and the connections from or to it. A
# connection that names the node's broker loses the broker. If a requester is decommissioned, all
# its claims are released. These include claims that also name other requesters, because the others
# might never release the claims.


def decommission(ledger: Ledger, request: Decommission, now: datetime) -> tuple[Ledger, Changes]:
    """Return the ledger after a node or requester is decommissioned, and the changes."""
    start, claims, waiting = ledger, dict[str, Claim](), tuple[str, ...]()
    nodes = request.nodes or (request.id,)
    if "node" in request.kinds:
        needing = (c for node in nodes for c in claims_needing(ledger, node))
        claims |= {f"{c.subject} {c.demand}": c for c in needing}
    if "requester" in request.kinds:
        held = ledger.claims_of_requester(request.id)
        claims |= {f"{c.subject} {c.demand}": c for c in held}
        # a waiting demand that names others too stays, because they can still release it
        demands = ledger.waiting.values()
        waiting = tuple(each.demand for each in demands if each.requesters == (request.id,))
    for claim in claims.values():
        left: Claim | None = claim
        if "requester" in request.kinds and request.id in claim.requesters:
            left = None
        for node in nodes:
            left = left.without_node(node) if left and left.held.needs(node) else left
        ledger = ledger.replace(claim.key, left)
    changes = claim_changes(start, ledger, [claim.key for claim in claims.values()])
    if not changes and not waiting:
        names = start.indexed_names("requester") if "requester" in request.kinds else set()
        if "node" in request.kinds:
            names |= start.indexed_names("node") | start.indexed_names("link")
        kinds = " or ".join(sorted(request.kinds))
        message = f"no claim names a {kinds} '{request.id}'{suggestion(request.id, names)}"
        raise Refused.at("name", message, code="not-held")
    return ledger.without_waiting(waiting), Changes(claims=changes, waiting=waiting)


def claims_needing(ledger: Ledger, node: str) -> list[Claim]:
    """Return the claims on applications and connections that need a node, in no order."""
    subjects = [Subject(SubjectKind.APPLICATION, id) for id in ledger.applications_at(node)]
    subjects += [Subject(SubjectKind.CONNECTION, id) for id in ledger.connections_needing(node)]
    return [
        claim
        for subject in subjects
        for claim in ledger.claims_on(subject)
        if claim.held.needs(node)
    ]


# ---- drain ----
#
# A drain moves placed applications and services, with their connections, off a drained node.
#
# The generator requests the drain. :mod:`.relocation` determines which claims change.


@dataclass(frozen=True, slots=True)
class Drain(DemandRequest):
    """The generator's request to move what it placed on the drained node ``id``.

    ``moved`` and ``stays`` have a text about each application or service that moves or cannot move.
    """

    # One drain looks only for so many nodes, because demands wait meanwhile. It begins with the
    # application that follows ``after`` in the order of ids. If some are left for another drain,
    # ``last`` is the last one before them.
    after: str = ""
    last: str = ""
    moves: tuple[ClaimChange, ...] = ()
    moved: tuple[str, ...] = ()
    stays: tuple[str, ...] = ()

    operation = "drain"


def drain(ledger: Ledger, request: Drain) -> tuple[Ledger, Changes]:
    start = ledger
    for move in request.moves:
        ledger = ledger.replace(move.key, move.after)
    return ledger, Changes(claims=claim_changes(start, ledger, [m.key for m in request.moves]))


# ---- the one way to change the ledger: :func:`apply` carries out a request ----
#
# ``docs/demand.md``, "How a demand is booked", says what each operation means.


def apply(ledger: Ledger, request: DemandRequest, now: datetime) -> tuple[Ledger, Changes]:
    """Return the ledger after an admitted request is carried out, and the changes.

    If the same request is booked already, at most the leases of its claims change. ``now`` is when
    the request was received, with time zone.

    Raises:
        Refused: if the request contradicts existing claims or itself, changes a demand of other
            requesters, releases or renews what is not held, or undoes newer claims unasked.
    """
    match request:
        case Join():
            return join(ledger, request, now)
        case Shutdown():
            return shut_down(ledger, request, now)
        case Put():
            return put(ledger, request, now)
        case Release():
            return release_demand(ledger, request)
        case Renew():
            return renew_leases(ledger, request, now)
        case Expire():
            return expire(ledger, request, now)
        case Decommission():
            return decommission(ledger, request, now)
        case Wait():
            assert request.waiting is not None  # noqa: S101 - the decision sets it
            waiting = ledger.waiting.insert(request.demand, request.waiting)
            is_new = ledger.waiting.get(request.demand) != request.waiting
            changes = Changes(waiting=(request.demand,) * is_new)
            return replace(ledger, waiting=waiting), changes
        case Drain():
            return drain(ledger, request)
        case Restoration():
            return restore(ledger, request, now)
    raise TypeError(f"{type(request).__name__} cannot be applied")
