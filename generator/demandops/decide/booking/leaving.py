"""A shutdown takes one hold from each requester that it names, on each topic that it lists.

If several claims hold the topic for the requester, the hold is taken from the first of:

1. the claim with the shutdown's request id and requesters
2. the oldest other claim with this request id
3. the oldest claim with another request id

If the shutdown lists no topic of an application or a connection, it takes all holds that the
requester has in the first of these claims. A shutdown never takes holds from the claims of a demand
that has an id.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime

from demandops.base.errors import Fault, Refused, fault, suggestion
from demandops.base.naming import Subject, SubjectKind, TopicKey
from demandops.decide.booking.joining import is_waiting, owned_claims
from demandops.model.demand.claim import Claim, ClaimKey, Term, demand_id
from demandops.model.demand.demand_request import (
    Decommission,
    Demanded,
    DemandRequest,
    Expire,
    Release,
    Renew,
    Shutdown,
)
from demandops.model.ledger.ledger import Changes, ClaimChange, Ledger, claim_changes
from demandops.model.ledger.records import RecentShutdown


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
