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
from dataclasses import replace
from datetime import datetime

from demandops.demand.claim import Claim, ClaimKey, demand_id
from demandops.demand.demand_request import Demanded, Shutdown
from demandops.errors import Fault, Refused, fault
from demandops.ledger.claim_changes import Changes, claim_changes
from demandops.ledger.ledger import Ledger
from demandops.ledger.recent_shutdowns import RecentShutdown
from demandops.subject import TopicKey


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
