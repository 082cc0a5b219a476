"""Commit messages: what changed in the desired state and why, for people and for programs.

The trailers are a contract: an auditor without this program finds everything by
``git log --format='%(trailers:key=Requester)'``. Ids hold no line breaks, so none can forge one.
"""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime, timezone

import pygit2

from generator.decision import Decision
from generator.demand.claim import SubjectKind
from generator.demand.request import Operation
from generator.errors import Fault
from generator.render.changeset import ReleaseChange
from generator.settings import RENDER_VERSION

GENERATOR_NAME = "DemandOps generator"
GENERATOR_EMAIL = "generator@demandops.invalid"

_SIGNS = {"start": "+", "change": "~", "stop": "-"}
_MAX_AUTHOR = 200
_MAX_SUBJECT = 90


def is_generators(message: str) -> bool:
    """Tell whether a commit is the generator's, so that its files fit its books."""
    return "\nRender-Version: " in message


def generator_signature(moment: datetime) -> pygit2.Signature:
    """Return the committer of all that the generator commits."""
    return pygit2.Signature(GENERATOR_NAME, GENERATOR_EMAIL, int(moment.timestamp()), 0)


def author(decision: Decision, received: datetime) -> pygit2.Signature:
    """Return the requesters as the author, at the time when the demand was received."""
    names = ", ".join(decision.request.requesters())
    # git takes no angle brackets in a name and strips these characters from its ends
    name = _clipped(names.replace("<", "(").replace(">", ")"), _MAX_AUTHOR).strip(" .,:;\"'\\")
    demand = decision.changes.claims[0].key.demand
    email = f"{demand}@demandops.invalid"
    return pygit2.Signature(name or "unnamed", email, int(received.timestamp()), 0)


def of_decision(
    decision: Decision, operation: str, received: datetime, settled: Iterable[tuple[str, str]] = ()
) -> str:
    """Return the message of a demand's commit; ``settled``: demands just before it, as trailers."""
    request = decision.request
    joining = request.operation is Operation.JOIN
    subjects = decision.changes.subjects()
    who = ", ".join(request.requesters())
    verb = "Join" if joining else "Release"
    subject = f"{verb} {', '.join(item.id for item in subjects)}"
    moment = received.astimezone(timezone.utc).strftime("%Y-%m-%d %H:%M:%S UTC")
    why = (
        f"Why: request '{request.id}', received {moment}, "
        f"{'asks for' if joining else 'gives up'} {_counted(decision)} in the name of {who}."
    )
    body = [_clipped(subject, _MAX_SUBJECT), "", why, "", *_desired_state(decision.releases)]
    if decision.changes.not_held:
        body += ["", "Listed, but not held:", *(f"  {item}" for item in decision.changes.not_held)]
    if decision.warnings:
        body += ["", "Warnings:", *(f"  {warning}" for warning in decision.warnings)]
    claims = decision.changes.claims
    trailers = [
        ("Operation", request.operation.value),
        ("Operation-Id", operation),
        *settled,
        *(("Demand-Id", demand) for demand in dict.fromkeys(c.key.demand for c in claims)),
        *(("Requester", requester) for requester in request.requesters()),
        *(("Application", s.id) for s in subjects if s.kind is SubjectKind.APPLICATION),
        *(("Connection", s.id) for s in subjects if s.kind is SubjectKind.CONNECTION),
        ("Request-Id", request.id),
        ("Render-Version", str(RENDER_VERSION)),
    ]
    return "\n".join([*body, "", *_trailers(trailers)]) + "\n"


def of_follow(
    releases: Iterable[ReleaseChange],
    cause: str,
    since: str,
    problems: Iterable[Fault],
    more: Iterable[tuple[str, str]] = (),
) -> str:
    """Return the message of a commit that carries out what people changed in the state repo."""
    problems = list(problems)
    body = [
        "Carry out changes made in the state repo",
        "",
        f"Why: commits up to {cause[:12]} changed what is configured or booked.",
        "",
        *_desired_state(tuple(releases)),
    ]
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
        lines.append(f"  {_SIGNS[release.change]} {release.name} ({release.what})")
        lines += [f"      {detail}" for detail in release.details]
    return lines


def _clipped(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 1].rstrip() + "…"
