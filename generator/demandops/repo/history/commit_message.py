"""What a commit says: the form of its message, and what the generator writes there."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone

import pygit2

from demandops.base.naming import Subject, SubjectKind
from demandops.base.quoting import escaped, harmless, is_visible, one_line
from demandops.base.settings import RENDER_VERSION
from demandops.decide.booking import Drain, Restoration
from demandops.decide.decision import Decision
from demandops.decide.discovery import Discovered
from demandops.decide.state import ReleaseChange
from demandops.model.config.override import OVERRIDES_ROOT, Override, format_time
from demandops.model.demand.demand import Application, Decommission, Held
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger.claim import OVERRIDE_PREFIX, ClaimKey
from demandops.model.ledger.records import Wait

# ---- the text of messages: paragraphs of lines, and trailers in the last paragraph ----
#
# Only this module writes and reads messages. A line of a paragraph is for people: its text is
# escaped and shortened. A trailer is for programs: its value is read back exactly. A value of
# visible characters on which no forge acts is written unchanged, so ``git log
# --format='%(trailers:key=Requester)'`` shows it; any other value is written in double quotes with
# escapes like ``\u202e``. So no value can begin a line, end the message, look like a trailer or
# give a forge an order. Messages of earlier versions, which did not quote, are read the same way.

Trailers = Iterable[tuple[str, str]]

_WHY = "Why: "
_AS_WRITTEN = ("Reason",)  # the person who runs a command may close an issue with it
_KEY = re.compile(r"[A-Za-z0-9-]+")
_ESCAPE = r"\\(?:x[0-9a-f]{2}|u[0-9a-f]{4}|U00(?:0[0-9a-f]|10)[0-9a-f]{4}|[nrt\\\"])"
_ESCAPES = re.compile(_ESCAPE)
_EDGES, _SPACE = re.compile(r"\A | \Z"), r"\\x20"
# A quoted value has an escape, because values without escapes are not quoted.
_QUOTED = re.compile(rf'"(?=.*\\)(?:[^"\\]|{_ESCAPE})*"')


@dataclass(frozen=True, slots=True)
class MessageText:
    summary: str
    why: str
    trailers: dict[str, list[str]]
    body: str = ""  # the first paragraph after the summary, which people write


def compose(paragraphs: Iterable[Iterable[str]], trailers: Trailers) -> str:
    # without empty paragraphs and trailers
    last = []
    for key, value in ((key, value) for key, value in trailers if value):
        is_plain = is_visible(value) and value == value.strip() and not _QUOTED.fullmatch(value)
        if is_plain and (key in _AS_WRITTEN or harmless(value) == value):
            last.append(f"{key}: {value}")
        else:
            text = harmless(escaped(value.replace("\\", r"\\").replace('"', r"\"")))
            last.append(f'{key}: "{_EDGES.sub(_SPACE, text)}"')
    body = ("\n".join(harmless(one_line(line)) for line in lines) for lines in paragraphs)
    return "\n\n".join(text for text in (*body, "\n".join(last)) if text) + "\n"


def of_generator(paragraphs: Iterable[Iterable[str]], trailers: Trailers) -> str:
    # each commit says by which version the files at it are rendered
    return compose(paragraphs, [*trailers, ("Render-Version", str(RENDER_VERSION))])


def parse(message: str) -> MessageText:
    lines = message.split("\n")
    whys = (line.removeprefix(_WHY) for line in lines if line.startswith(_WHY))
    trailers: dict[str, list[str]] = {}
    head, _, last = message.rstrip("\n").rpartition("\n\n")
    body = next(iter(message.rstrip("\n").split("\n\n")[1:]), "")
    for line in last.split("\n") if head else ():
        key, colon, value = line.partition(": ")
        if not colon or not _KEY.fullmatch(key):
            trailers.clear()  # a paragraph with any other line is text for people
            break
        if _QUOTED.fullmatch(value):
            value = _ESCAPES.sub(
                lambda m: m[0][1] if m[0][1] in '\\"' else m[0].encode().decode("unicode_escape"),
                value[1:-1],
            )
        trailers.setdefault(key, []).append(value)
    is_text = body != last or not trailers
    return MessageText(lines[0], next(whys, ""), trailers, body if is_text else "")


# The trailer that names the branch on which a commit was proposed for approval.
PROPOSAL = "Proposal"
# The trailer with the branch and commit where the demand was proposed with other content.
REPLACES = "Replaces"
REQUIRED_BY = "Approval-Required-By"  # the trailer, repeated, with what requires the approval
APPROVED_BY = "Approved-By"  # the trailer, repeated, with a rule that lets do without a person
REJECTS = "Rejects"  # the trailer with the branch and commit of the proposal that is rejected

# The committer of every commit by a generator.
GENERATOR_NAME = "DemandOps generator"
GENERATOR_EMAIL = "generator@demandops.invalid"

# ---- messages: what changed in the desired state and why, for people and programs ----
#
# The trailers are a contract: an auditor without this program finds everything with ``git log
# --format='%(trailers:key=Requester)'``. Values from outside appear in a message only as
# :func:`compose` quotes them. :mod:`.snapshot` adds the trailer about the configuration in effect.

_SIGNS = {"start": "+", "change": "~", "stop": "-"}
_MAX_AUTHOR = 200
_LOCAL_PART = re.compile(r"[A-Za-z0-9]([A-Za-z0-9._-]{0,62}[A-Za-z0-9])?")
_MAX_SUBJECT = 90
_MOST_PROBLEMS = 20
_MOST_NODES = 50
REQUESTERS_AT = "@requester.demandops.invalid"  # no person has an address of this domain
_UNCHANGED = "Desired state: unchanged."
_UNFIT = re.compile(r"[<>\s\x00-\x1f\x7f]")
_CRUD = " .,:;\"'\\"  # Git removes these at both ends of a name, and refuses an empty name


def signature(name: str, email: str, time: datetime) -> pygit2.Signature:
    """Return an author or committer of any name and address, without what Git refuses."""
    address = one_line(_UNFIT.sub("", email), _MAX_AUTHOR).strip(_CRUD) or GENERATOR_EMAIL
    plain = one_line(name.replace("<", "(").replace(">", ")"), _MAX_AUTHOR)
    return pygit2.Signature(plain.strip(_CRUD) or "unnamed", address, int(time.timestamp()), 0)


def generator_signature(time: datetime) -> pygit2.Signature:
    return signature(GENERATOR_NAME, GENERATOR_EMAIL, time)


def author(decision: Decision, received: datetime) -> pygit2.Signature:
    request = decision.request
    if isinstance(request, Restoration):
        return signature(request.by, request.email, received)
    if isinstance(request, Decommission):
        name, _, email = request.by.removesuffix(">").rpartition(" <")
        return signature(name, email, received) if name else generator_signature(received)
    # A requester may have any name, also that of a person. So the name says that it is a
    # requester's, and the address is nobody's.
    requesters = _requesters(decision)
    who = "requester" if len(requesters) == 1 else "requesters"
    names = one_line(", ".join(requesters), _MAX_AUTHOR - len(f" ({who})"))
    claims = decision.changes.claims
    demand = claims[0].key.demand if claims else request.demand
    local = demand if _LOCAL_PART.fullmatch(demand) else claim_files.segment(demand)
    return signature(f"{names} ({who})", f"{local}{REQUESTERS_AT}", received)


def signed_off(text: str, by: str) -> str:
    # in the last paragraph if it has trailers, as `git commit --signoff`
    gap = "" if parse(text).trailers else "\n"
    return f"{text.rstrip()}\n{gap}Signed-off-by: {one_line(by)}\n"


def of_decision(
    decision: Decision, operation: str, received: datetime, more: Iterable[tuple[str, str]] = ()
) -> str:
    request, claims = decision.request, decision.changes.claims
    subjects = decision.changes.subjects()
    more = list(more)
    requesters = _requesters(decision)
    title, why, of_operation = _told(decision, requesters, received)
    replaced = "".join(value for key, value in more if key == REPLACES)
    not_held = [f"  {item}" for item in decision.changes.not_held]
    warnings = [f"  {warning}" for warning in decision.warnings]
    paragraphs = [
        [one_line(title, _MAX_SUBJECT)],
        [f"Changed: replaces {replaced}; no approval of that counts here."] if replaced else [],
        [f"Why: {why}"],
        _desired_state(decision.releases) if decision.releases or claims else [_UNCHANGED],
        ["Listed in the request, but not held by the requester:", *not_held] if not_held else [],
        ["Warnings:", *warnings] if warnings else [],
    ]
    keys = [change.key for change in claims]
    demands = dict.fromkeys((*(key.demand for key in keys), *decision.changes.waiting))
    trailers = [
        ("Operation", request.verb if isinstance(request, Decommission) else request.operation),
        ("Operation-Id", operation),
        *more,
        *of_operation,
        *(("Demand-Id", demand) for demand in demands),
        *(("Requester", requester) for requester in requesters),
        *(("Application", s.id) for s in subjects if s.kind is SubjectKind.APPLICATION),
        *(("Connection", s.id) for s in subjects if s.kind is SubjectKind.CONNECTION),
        ("Request-Id", request.id),
        *((APPROVED_BY, rule) for rule in decision.approved_by),
        *override_trailers(decision.overrides, keys),
    ]
    return of_generator(paragraphs, trailers)


def time_text(at: datetime) -> str:
    return at.astimezone(timezone.utc).strftime("%Y-%m-%d %H:%M:%S UTC")


_VERBS = {
    "join": ("Join", "asks for"),
    "shutdown": ("Release", "gives up"),
    "put": ("Put", "asks for"),
    "release": ("Release", "gives up"),
    "renew": ("Renew", "renews"),
}


def _requesters(decision: Decision) -> tuple[str, ...]:
    if named := decision.request.requesters():
        return named
    changes = decision.changes.claims
    claims = [change.after or change.before for change in changes]
    if isinstance(decision.request, Decommission):  # the requester is in the old claims only
        claims = [change.before for change in changes]
    return tuple(sorted({who for claim in claims if claim for who in claim.requesters}))


def _given_up_in_part(decision: Decision) -> dict[Subject, str]:
    # of claims that stay, because a shutdown lists only some of their topics
    def topics(held: Held) -> set[str]:
        if isinstance(held, Application):
            return {topic.topic for _, topic in held.all_inputs()}
        return {route.source for route in held.topics}

    parts = dict[Subject, str]()
    for change in decision.changes.claims if decision.request.operation == "shutdown" else ():
        if not (change.before and change.after):
            continue
        if lost := sorted(topics(change.before.held) - topics(change.after.held)):
            some = f"topic{'s' if len(lost) > 1 else ''} {', '.join(lost)}"
            parts[change.key.subject] = f"{some} of {change.key.subject.id}"
    return parts


def _told(
    decision: Decision, requesters: tuple[str, ...], received: datetime
) -> tuple[str, str, list[tuple[str, str]]]:
    # the title, the reason, and the trailers of this operation
    request, changes = decision.request, decision.changes.claims
    parts = _given_up_in_part(decision)
    kinds = Counter(each.kind for each in decision.changes.subjects() if each not in parts)
    counts = [(kinds[kind], kind.value[:-1]) for kind in SubjectKind if kinds[kind]]
    counted = (f"{count} {kind}{'s' if count > 1 else ''}" for count, kind in counts)
    what = " and ".join((*counted, *parts.values()))
    what_of_whom = f"{what} in the name of {', '.join(requesters)}"
    subjects = ", ".join(parts.get(each, each.id) for each in decision.changes.subjects())
    time = time_text(received)
    if isinstance(request, Restoration):
        to = request.to[:12]
        only = f"demand '{request.demand}'" if request.demand else ""
        only = f"application '{request.application}'" if request.application else only
        rolled = only or "the ledger"
        why = f"{request.by} rolled {rolled} back to commit {to}, which changes {what}: "
        trailers = [("Restores", request.to), ("Reason", request.reason)]
        title = " ".join(filter(None, ("Roll", only and rolled, "back to", to)))
        return title, why + request.reason, trailers
    if request.operation == "expire":
        claims = [change.before for change in changes]
        last = max(claim.lease.expires_at for claim in claims if claim and claim.lease)
        why = f"the lease of demand '{request.demand}' on {what_of_whom} ended at "
        return f"Expire {subjects}", f"{why}{time_text(last)} and was not renewed.", []
    if isinstance(request, Drain):
        moved = "".join(f" {text[0].upper()}{text[1:]}." for text in request.moved)
        why = f"'{request.id}' is drained in the inventory.{moved}"
        return f"Drain {request.id}", why, [("Node", request.id)]
    if isinstance(request, Decommission):
        by = f" by {request.by}" if request.by else ""
        reason = f" ({request.reason})" if request.reason else ""
        held = f"it held a part of {what_of_whom}" if changes else "its demands waited for room"
        done = "released" if request.verb == "release" else "decommissioned"
        why = f"'{request.id}' was {done}{by} on {time}{reason}; {held}."
        nodes, claims = request.nodes or (request.id,), [change.before for change in changes]
        needed = any(claim.held.needs(node) for claim in claims if claim for node in nodes)
        trailers = [("Node", request.id)] if needed and "node" in request.kinds else []
        trailers = [*trailers, ("Reason", request.reason)]
        return f"{request.verb.capitalize()} {request.id}", why, trailers
    if isinstance(request, Wait):
        who, reasons = ", ".join(request.requesters()), "; ".join(request.notes)
        why = f"request '{request.id}' of demand '{request.demand}' in the name of {who}, received "
        return f"Let {request.demand} wait", f"{why}{time}, waits for room: {reasons}.", []
    if not changes:
        why = f"request '{request.id}', received {time}, releases demands that waited for room."
        return f"Release {', '.join(decision.changes.waiting)}", why, []
    only_leases = all(
        change.before and change.after and change.before.booked == change.after.booked
        for change in changes
    )
    renewed = request.adds_claims and only_leases
    title, verb = _VERBS["renew" if renewed else request.operation]
    named = "" if request.is_reference else f" of demand '{request.demand}'"
    why = f"request '{request.id}'{named}, received {time}, {verb} {what_of_whom}."
    placed = "".join(f" {text[0].upper()}{text[1:]}." for text in decision.placed)
    placed += " It waited for room." if request.demand in decision.changes.waiting else ""
    return f"{title} {subjects}", why + placed, []


def of_follow(
    releases: Iterable[ReleaseChange],
    cause: str,
    since: str,
    configuration: str,
    problems: Sequence[object],
    remedy: str,
    more: Iterable[tuple[str, str]] = (),
) -> str:
    # ``cause`` is the newest commit that is carried out, and ``since`` the one whose state was in
    # effect before. ``configuration`` is the commit whose configuration stays in effect because
    # that of ``cause`` is not valid, else empty; and ``remedy`` how to mend that.
    releases = tuple(releases)
    names, after = ", ".join(release.name for release in releases), f" after commit {cause[:12]}"
    title = f"Update ledger{after}"
    if configuration:
        title = f"Keep the configuration of commit {configuration[:12]}, as the next is not valid"
    elif names:
        title = f"Update {one_line(names, _MAX_SUBJECT - len(after) - len('Update '))}{after}"
    told = [f"  {each}" for each in problems[:_MOST_PROBLEMS]]
    if len(problems) > _MOST_PROBLEMS:
        told.append(f"  and {len(problems) - _MOST_PROBLEMS} more")
    held = [
        f"Not valid at commit {cause[:12]}, so that the configuration of commit "
        f"{configuration[:12]} stays in effect, as a whole, until a commit is valid:",
        *told,
        f"To mend this, {remedy}",
    ]
    paragraphs = [
        [title],
        [f"Why: commits up to {cause[:12]} changed configuration, ledger or generated files."],
        _desired_state(releases) if releases else [],
        held if configuration else ["Put back, because not valid:", *told] if told else [],
    ]
    trailers = [
        ("Operation", "follow"),
        ("Follows", cause),
        ("Since", since),
        *more,
    ]
    return of_generator(paragraphs, trailers)


def rejection_trailers(
    branch: str, commit: str, demands: Iterable[str], requesters: Iterable[str], reason: str
) -> list[tuple[str, str]]:
    return [
        ("Operation", "reject"),
        (REJECTS, f"{branch} {commit}"),
        *(("Demand-Id", demand) for demand in demands),
        *(("Requester", requester) for requester in requesters),
        ("Reason", reason),
    ]


def of_override_end(
    override: Override,
    releases: tuple[ReleaseChange, ...],
    keys: Iterable[ClaimKey],
    more: Iterable[tuple[str, str]] = (),
) -> str:
    # ``keys`` are of the claims that this changes, of demands and of ``keep`` overrides
    end = format_time(override.end) if override.end else ""
    paragraphs = [
        [f"End override {override.name}"],
        [f"Why: {override.path} by {override.owner} ({override.reason}) expired at {end}."],
        _desired_state(releases) if releases else [_UNCHANGED],
    ]
    trailers = [
        ("Operation", "expire-override"),
        *override_trailers([override.path], keys),
        *demand_trailers(keys),
        *more,
    ]
    return of_generator(paragraphs, trailers)


def of_discovery(found: Sequence[Discovered], releases: tuple[ReleaseChange, ...]) -> str:
    names = [each.path.rpartition("/")[2].removesuffix(".yaml") for each in found]
    words = ("came", "gone", "left", "changed")
    counts = [(sum(len(getattr(each, word)) for each in found), word) for word in words]
    told = ", ".join(f"{count} {word}" for count, word in counts if count) or "as they are"
    paragraphs = [
        [one_line(f"Nodes of {', '.join(names)}: {told}", _MAX_SUBJECT)],
        [f"Why: {', '.join(names)} said so."],
    ]
    for name, each in zip(names, found, strict=True):
        signed = [("+", each.came), ("-", each.gone), ("-", each.left), ("~", each.changed)]
        lines = [f"  {sign} {line}" for sign, lines in signed for line in lines]
        more = len(lines) - _MOST_NODES
        paragraphs.append([f"{name}:", *lines[:_MOST_NODES]])
        paragraphs[-1] += [f"  and {more} more"] if more > 0 else []
    paragraphs.append(_desired_state(releases) if releases else [_UNCHANGED])
    trailers = [
        ("Operation", "discover"),
        *(("Cluster", name) for name in names),
    ]
    return of_generator(paragraphs, trailers)


def override_trailers(paths: Iterable[str], keys: Iterable[ClaimKey]) -> list[tuple[str, str]]:
    # ``keys`` are those of changed claims, among them those of ``keep`` overrides
    demands = (key.demand for key in keys if key.demand.startswith(OVERRIDE_PREFIX))
    keeping = (f"{OVERRIDES_ROOT}/{name.removeprefix(OVERRIDE_PREFIX)}.yaml" for name in demands)
    return [("Override", path) for path in sorted({*paths, *keeping})]


def demand_trailers(keys: Iterable[ClaimKey]) -> list[tuple[str, str]]:
    demands = {key.demand for key in keys if not key.demand.startswith(OVERRIDE_PREFIX)}
    return [("Demand-Id", demand) for demand in sorted(demands)]


def _desired_state(releases: tuple[ReleaseChange, ...]) -> list[str]:
    if not releases:
        return [
            "Desired state: unchanged; the releases run already, or still run for other requesters."
        ]
    lines = ["Desired state:"]
    for release in releases:
        lines.append(f"  {_SIGNS[release.change]} {release.title}")
        lines += [f"      {detail}" for detail in release.details]
    return lines
