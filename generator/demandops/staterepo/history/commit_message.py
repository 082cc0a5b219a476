"""Commit messages: what changed in the desired state and why, for people and for programs.

The trailers are a contract: an auditor without this program finds everything by
``git log --format='%(trailers:key=Requester)'``. Ids hold no line breaks, so none can forge one.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import datetime, timezone

import pygit2

from demandops.config.override import OVERRIDES_ROOT, Override, format_time
from demandops.decision import Decision
from demandops.demand.claim import ClaimKey, SubjectKind
from demandops.demand.demand_request import OVERRIDE_PREFIX, DemandRequest, Operation
from demandops.errors import Fault
from demandops.ledger import claim_file
from demandops.ledger.operations.decommission import needs_node
from demandops.ledger.operations.restoration import Restoration
from demandops.render.changes.changeset import ReleaseChange
from demandops.settings import RENDER_VERSION

GENERATOR_NAME = "DemandOps generator"
GENERATOR_EMAIL = "generator@demandops.invalid"

PROPOSAL = "Proposal"
"""The trailer of a commit that awaits approval, or did: the branch that it was proposed on."""

_SIGNS = {"start": "+", "change": "~", "stop": "-"}
_MAX_AUTHOR = 200
_LOCAL_PART = re.compile(r"[A-Za-z0-9]([A-Za-z0-9._-]{0,62}[A-Za-z0-9])?")
_MAX_SUBJECT = 90


def is_generators(message: str) -> bool:
    """Tell whether a commit is the generator's, so that its files fit its books.

    A proposal is merged by a person, perhaps onto others' changes: its files are looked at anew.
    """
    return "\nRender-Version: " in message and f"\n{PROPOSAL}: " not in message


def generator_signature(moment: datetime) -> pygit2.Signature:
    """Return the committer of all that the generator commits."""
    return pygit2.Signature(GENERATOR_NAME, GENERATOR_EMAIL, int(moment.timestamp()), 0)


def author(decision: Decision, received: datetime) -> pygit2.Signature:
    """Return the requesters as the author, at the time when the demand was received.

    Of a rollback and where something leaves it is the person who asked for it.
    """
    request, leaving = decision.request, decision.request.decommission_target
    if isinstance(request, Restoration):
        email = re.sub(r"[<>\s]", "", request.email) or GENERATOR_EMAIL
        return pygit2.Signature(_name(request.by), email, int(received.timestamp()), 0)
    if leaving is not None:
        return _operator(leaving.by, received)
    names = ", ".join(_requesters(decision))
    demand = decision.changes.claims[0].key.demand
    local = demand if _LOCAL_PART.fullmatch(demand) else claim_file.segment(demand)
    email = f"{local}@demandops.invalid"
    return pygit2.Signature(_name(names), email, int(received.timestamp()), 0)


def _name(names: str) -> str:
    """Return a name as git takes it: without angle brackets, or these characters at its ends."""
    plain = _clipped(names.replace("<", "(").replace(">", ")"), _MAX_AUTHOR)
    return plain.strip(" .,:;\"'\\") or "unnamed"


def _operator(by: str, received: datetime) -> pygit2.Signature:
    """Return who had the generator do something, the generator itself where nobody is known."""
    name, _, email = by.removesuffix(">").rpartition(" <")
    try:
        return pygit2.Signature(name, email, int(received.timestamp()), 0)
    except (ValueError, pygit2.GitError):
        return generator_signature(received)


def of_decision(
    decision: Decision, operation: str, received: datetime, settled: Iterable[tuple[str, str]] = ()
) -> str:
    """Return the message of a demand's commit; ``settled``: demands just before it, as trailers."""
    request = decision.request
    subjects = decision.changes.subjects()
    body = [_clipped(_title(decision), _MAX_SUBJECT), "", _why(decision, received), ""]
    body += _desired_state(decision.releases)
    if decision.changes.not_held:
        body += ["", "Listed, but not held:", *(f"  {item}" for item in decision.changes.not_held)]
    if decision.warnings:
        body += ["", "Warnings:", *(f"  {warning}" for warning in decision.warnings)]
    claims = decision.changes.claims
    trailers = [
        ("Operation", request.operation.value),
        ("Operation-Id", operation),
        *settled,
        *_of_rollback(request),
        *_leaving(decision),
        *(("Demand-Id", demand) for demand in dict.fromkeys(c.key.demand for c in claims)),
        *(("Requester", requester) for requester in _requesters(decision)),
        *(("Application", s.id) for s in subjects if s.kind is SubjectKind.APPLICATION),
        *(("Connection", s.id) for s in subjects if s.kind is SubjectKind.CONNECTION),
        ("Request-Id", request.id),
        *_overrides(decision),
        ("Render-Version", str(RENDER_VERSION)),
    ]
    return "\n".join([*body, "", *_trailers(trailers)]) + "\n"


_VERBS = {
    Operation.JOIN: ("Join", "asks for"),
    Operation.SHUTDOWN: ("Release", "gives up"),
    Operation.PUT: ("Put", "asks for"),
    Operation.RELEASE: ("Release", "gives up"),
    Operation.RENEW: ("Renew", "renews"),
}


def _requesters(decision: Decision) -> tuple[str, ...]:
    """Return in whose name a demand changed something; of one that ended, in whose it stood."""
    changes = decision.changes.claims
    claims = [change.after or change.before for change in changes]
    if decision.request.decommission_target is not None:  # whose name goes is concerned as well
        claims = [change.before for change in changes]
    stood = sorted({who for claim in claims if claim for who in claim.requesters})
    return decision.request.requesters() or tuple(stood)


def _leaving(decision: Decision) -> list[tuple[str, str]]:
    """Return the trailer of a node that is decommissioned; a requester's stands there already."""
    leaving, befores = (
        decision.request.decommission_target,
        [c.before for c in decision.changes.claims],
    )
    if leaving is None or "node" not in leaving.kinds:
        return []
    held = any(needs_node(before, leaving.name) for before in befores if before)
    return [("Node", leaving.name)] if held else []


def _title(decision: Decision) -> str:
    subjects = ", ".join(subject.id for subject in decision.changes.subjects())
    operation, leaving = decision.request.operation, decision.request.decommission_target
    if leaving is not None:
        return f"Decommission {leaving.name}"
    if operation is Operation.EXPIRE:
        return f"Expire {subjects}"
    if isinstance(decision.request, Restoration):
        return f"Roll back to {decision.request.to[:12]}"
    renewed = operation.adds_claims and _only_leases(decision)
    return f"{_VERBS[Operation.RENEW if renewed else operation][0]} {subjects}"


def _why(decision: Decision, received: datetime) -> str:
    request = decision.request
    moment = received.astimezone(timezone.utc).strftime("%Y-%m-%d %H:%M:%S UTC")
    who = ", ".join(_requesters(decision))
    what = _counted(decision)
    if isinstance(request, Restoration):
        return (
            f"Why: {request.by} rolled the books back to commit {request.to[:12]}, which changes "
            f"{what}: {request.reason}"
        )
    if request.operation is Operation.EXPIRE:
        ends = [
            c.before.lease.expires_at
            for c in decision.changes.claims
            if c.before and c.before.lease
        ]
        last = max(ends).astimezone(timezone.utc).strftime("%Y-%m-%d %H:%M:%S UTC")
        return (
            f"Why: the lease of demand '{request.demand}' on {what} in the name of {who} ended "
            f"at {last} and was not renewed."
        )
    if request.decommission_target is not None:
        by = f" by {request.decommission_target.by}" if request.decommission_target.by else ""
        return (
            f"Why: '{request.decommission_target.name}' leaves for good, told{by} on "
            f"{moment}; it held a part of {what} in the name of {who}."
        )
    verb = _VERBS[request.operation][1]
    if request.operation.adds_claims and _only_leases(decision):
        verb = _VERBS[Operation.RENEW][1]
    named = "" if request.operation.is_reference else f" of demand '{request.demand}'"
    return (
        f"Why: request '{request.id}'{named}, received {moment}, {verb} {what} in the name of "
        f"{who}."
    )


def _of_rollback(request: DemandRequest) -> list[tuple[str, str]]:
    """Return the trailers that only a rollback has: where it went back to, and why."""
    if not isinstance(request, Restoration):
        return []
    return [("Restores", request.to), ("Reason", request.reason)]


def _only_leases(decision: Decision) -> bool:
    """Tell whether a demand changed nothing but how long its claims hold."""
    return all(
        change.before and change.after and change.before.booked == change.after.booked
        for change in decision.changes.claims
    )


def of_follow(
    releases: Iterable[ReleaseChange],
    cause: str,
    since: str,
    problems: Iterable[Fault],
    more: Iterable[tuple[str, str]] = (),
) -> str:
    """Return the message of a commit that carries out what people changed in the state repo."""
    problems, releases = list(problems), tuple(releases)
    why = f"Why: commits up to {cause[:12]} changed what is configured or booked."
    title = "Carry out changes made in the state repo"
    if not releases:
        title = "Report what is not valid in the state repo"
        title = title if problems else "Report that all of the state repo is valid again"
    body = [title, "", why]
    body += ["", *_desired_state(releases)] if releases else []
    if problems:
        body += ["", "Not taken in, for it is not valid:", *(f"  {found}" for found in problems)]
    trailers = [
        ("Operation", "follow"),
        ("Follows", cause),
        ("Since", since),
        *more,
        ("Render-Version", str(RENDER_VERSION)),
    ]
    return "\n".join([*body, "", *_trailers(trailers)]) + "\n"


def of_ended(
    override: Override,
    releases: tuple[ReleaseChange, ...],
    kept: Iterable[ClaimKey],
    more: Iterable[tuple[str, str]] = (),
) -> str:
    """Return the message of the commit that ends an override at the time that it names.

    ``kept`` are the claims of overrides' own that changed with it.
    """
    body = [
        f"End override {override.name}",
        "",
        f"Why: {override.path} of {override.owner} ({override.reason}) expired at "
        f"{format_time(override.end) if override.end else ''}.",
        "",
        *(_desired_state(releases) if releases else ["Desired state: unchanged."]),
    ]
    trailers = [
        ("Operation", "expire-override"),
        *of_overrides([override.path, *keeping(kept)]),
        *more,
        ("Render-Version", str(RENDER_VERSION)),
    ]
    return "\n".join([*body, "", *_trailers(trailers)]) + "\n"


def of_overrides(paths: Iterable[str]) -> list[tuple[str, str]]:
    """Return the trailers that name overrides."""
    return [("Override", path) for path in sorted(set(paths))]


def _overrides(decision: Decision) -> list[tuple[str, str]]:
    """Return the trailers that name the overrides that shaped a demand's commit."""
    keys = (change.key for change in decision.changes.claims)
    return of_overrides([*decision.overrides, *keeping(keys)])


def keeping(keys: Iterable[ClaimKey]) -> list[str]:
    """Return the files of the overrides whose own claims these are."""
    demands = (key.demand for key in keys if key.demand.startswith(OVERRIDE_PREFIX))
    return [f"{OVERRIDES_ROOT}/{demand.removeprefix(OVERRIDE_PREFIX)}.yaml" for demand in demands]


def _trailers(pairs: Iterable[tuple[str, str]]) -> list[str]:
    return [f"{key}: {value}" for key, value in pairs if value]


def _counted(decision: Decision) -> str:
    kinds = [subject.kind for subject in decision.changes.subjects()]
    parts = []
    for kind in SubjectKind:
        count = kinds.count(kind)
        if count:
            parts.append(f"{count} {kind.value[:-1]}{'s' if count > 1 else ''}")
    return " and ".join(parts)


def _desired_state(releases: tuple[ReleaseChange, ...]) -> list[str]:
    if not releases:
        return ["Desired state: unchanged; what is asked runs already, or still for others."]
    lines = ["Desired state:"]
    for release in releases:
        lines.append(f"  {_SIGNS[release.change]} {release.name} ({release.description})")
        lines += [f"      {detail}" for detail in release.details]
    return lines


def _clipped(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 1].rstrip() + "…"
