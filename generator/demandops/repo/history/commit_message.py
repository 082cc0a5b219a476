"""What a commit says, and who made it."""

from __future__ import annotations

import getpass
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from datetime import datetime
from functools import cache
from typing import NamedTuple

import git
import pygit2
from pygit2 import Commit, Oid, Repository

from demandops.base.errors import Fault
from demandops.base.naming import SubjectKind
from demandops.base.quoting import one_line
from demandops.base.settings import GENERATED_ROOTS, NOTES_ROOT, RENDER_VERSION
from demandops.decide.booking import Drain
from demandops.decide.changeset import ReleaseChange
from demandops.decide.decision import Decision
from demandops.decide.rollback import Restoration
from demandops.model.config.config import CONFIG_ROOTS
from demandops.model.config.override import OVERRIDES_ROOT, Override, format_time
from demandops.model.demand.demand import Decommission
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger.claim import LEDGER_ROOT, OVERRIDE_PREFIX, ClaimKey
from demandops.model.ledger.records import Wait
from demandops.repo.git import tree as trees
from demandops.repo.history import commit_log, revisions
from demandops.repo.history.commit_log import GENERATOR_EMAIL, GENERATOR_NAME, REPLACES, compose

# ---- messages: what changed in the desired state and why, for people and programs ----
#
# The trailers are a contract: an auditor without this program finds everything with ``git log
# --format='%(trailers:key=Requester)'``. Values from outside appear in a message only as
# :mod:`.commit_log` quotes them. :mod:`.state_in_effect` adds the trailers about quarantined files.

_SIGNS = {"start": "+", "change": "~", "stop": "-"}
_MAX_AUTHOR = 200
_LOCAL_PART = re.compile(r"[A-Za-z0-9]([A-Za-z0-9._-]{0,62}[A-Za-z0-9])?")
_MAX_SUBJECT = 90
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
    # requester's, and the address is nobody's: no person has one of its domain.
    requesters = _requesters(decision)
    who = "requester" if len(requesters) == 1 else "requesters"
    names = one_line(", ".join(requesters), _MAX_AUTHOR - len(f" ({who})"))
    claims = decision.changes.claims
    demand = claims[0].key.demand if claims else request.demand
    local = demand if _LOCAL_PART.fullmatch(demand) else claim_files.segment(demand)
    return signature(f"{names} ({who})", f"{local}@requester.demandops.invalid", received)


def of_decision(
    decision: Decision, operation: str, received: datetime, more: Iterable[tuple[str, str]] = ()
) -> str:
    request, claims = decision.request, decision.changes.claims
    subjects = decision.changes.subjects()
    more = list(more)
    title, why = _title_and_why(decision, received)
    replaced = "".join(value for key, value in more if key == REPLACES)
    paragraphs = [
        [one_line(title, _MAX_SUBJECT)],
        [f"Changed: replaces {replaced}; no approval of that counts here."] if replaced else [],
        [f"Why: {why}"],
        _desired_state(decision.releases) if decision.releases or claims else [_UNCHANGED],
        _list("Listed in the request, but not held by the requester:", decision.changes.not_held),
        _list("Warnings:", decision.warnings),
    ]
    keys = [change.key for change in claims]
    demands = dict.fromkeys((*(key.demand for key in keys), *decision.changes.waiting))
    trailers = [
        ("Operation", request.operation),
        ("Operation-Id", operation),
        *more,
        *_operation_trailers(decision),
        *(("Demand-Id", demand) for demand in demands),
        *(("Requester", requester) for requester in _requesters(decision)),
        *(("Application", s.id) for s in subjects if s.kind is SubjectKind.APPLICATION),
        *(("Connection", s.id) for s in subjects if s.kind is SubjectKind.CONNECTION),
        ("Request-Id", request.id),
        *override_trailers([*decision.overrides, *keep_override_paths(keys)]),
        ("Render-Version", str(RENDER_VERSION)),
    ]
    return compose(paragraphs, trailers)


def _list(head: str, items: Iterable[object]) -> list[str]:
    lines = [f"  {item}" for item in items]
    return [head, *lines] if lines else []


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


def _title_and_why(decision: Decision, received: datetime) -> tuple[str, str]:
    request, changes = decision.request, decision.changes.claims
    kinds = Counter(subject.kind for subject in decision.changes.subjects())
    counts = [(kinds[kind], kind.value[:-1]) for kind in SubjectKind if kinds[kind]]
    what = " and ".join(f"{count} {kind}{'s' if count > 1 else ''}" for count, kind in counts)
    what_of_whom = f"{what} in the name of {', '.join(_requesters(decision))}"
    subjects = ", ".join(subject.id for subject in decision.changes.subjects())
    time = revisions.format_time(received)
    if isinstance(request, Restoration):
        to = request.to[:12]
        return f"Roll back to {to}", (
            f"{request.by} rolled the ledger back to commit {to}, which changes {what}: "
            f"{request.reason}"
        )
    if request.operation == "expire":
        claims = [change.before for change in changes]
        last = max(claim.lease.expires_at for claim in claims if claim and claim.lease)
        return f"Expire {subjects}", (
            f"the lease of demand '{request.demand}' on {what_of_whom} ended at "
            f"{revisions.format_time(last)} and was not renewed."
        )
    if isinstance(request, Drain):
        moved = "".join(f" {text[0].upper()}{text[1:]}." for text in request.moved)
        return f"Drain {request.id}", f"'{request.id}' is drained in the inventory.{moved}"
    if isinstance(request, Decommission):
        by = f" by {request.by}" if request.by else ""
        reason = f" ({request.reason})" if request.reason else ""
        held = f"it held a part of {what_of_whom}" if changes else "its demands waited for room"
        return f"Decommission {request.id}", (
            f"'{request.id}' was decommissioned{by} on {time}{reason}; {held}."
        )
    if isinstance(request, Wait):
        who, reasons = ", ".join(request.requesters()), "; ".join(request.reasons)
        return f"Let {request.demand} wait", (
            f"request '{request.id}' of demand '{request.demand}' in the name of {who}, received "
            f"{time}, waits for room: {reasons}."
        )
    if not changes:
        return f"Release {', '.join(decision.changes.waiting)}", (
            f"request '{request.id}', received {time}, releases demands that waited for room."
        )
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
    return f"{title} {subjects}", why + placed


def _operation_trailers(decision: Decision) -> list[tuple[str, str]]:
    request = decision.request
    if isinstance(request, Restoration):
        return [("Restores", request.to), ("Reason", request.reason)]
    if isinstance(request, Drain):
        return [("Node", request.id)]
    if not isinstance(request, Decommission):
        return []
    reason = [("Reason", request.reason)]
    claims = [change.before for change in decision.changes.claims]
    nodes = request.nodes or (request.id,)
    needed = any(claim.held.needs(node) for claim in claims if claim for node in nodes)
    return ([("Node", request.id)] if needed and "node" in request.kinds else []) + reason


def of_follow(
    releases: Iterable[ReleaseChange],
    cause: str,
    since: str,
    problems: Iterable[Fault],
    more: Iterable[tuple[str, str]] = (),
    *,
    reports: bool = True,
) -> str:
    # ``cause`` is the newest commit whose changes are rendered, and ``since`` the one whose state
    # was in effect before them. ``reports`` says whether the problem report changes.
    problems, releases = list(problems), tuple(releases)
    names, after = ", ".join(release.name for release in releases), f" after commit {cause[:12]}"
    title = f"Update ledger{after}"
    if names:
        title = f"Update {one_line(names, _MAX_SUBJECT - len(after) - len('Update '))}{after}"
    elif reports:
        title = "Report invalid files" if problems else "Report that all files are valid"
    paragraphs = [
        [title],
        [f"Why: commits up to {cause[:12]} changed configuration, ledger or generated files."],
        _desired_state(releases) if releases else [],
        _list("Not applied, because not valid:", problems),
    ]
    trailers = [
        ("Operation", "follow"),
        ("Follows", cause),
        ("Since", since),
        *more,
        ("Render-Version", str(RENDER_VERSION)),
    ]
    return compose(paragraphs, trailers)


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
        *override_trailers([override.path, *keep_override_paths(keys)]),
        *demand_trailers(keys),
        *more,
        ("Render-Version", str(RENDER_VERSION)),
    ]
    return compose(paragraphs, trailers)


def override_trailers(paths: Iterable[str]) -> list[tuple[str, str]]:
    return [("Override", path) for path in sorted(set(paths))]


def keep_override_paths(keys: Iterable[ClaimKey]) -> list[str]:
    demands = (key.demand for key in keys if key.demand.startswith(OVERRIDE_PREFIX))
    return [f"{OVERRIDES_ROOT}/{demand.removeprefix(OVERRIDE_PREFIX)}.yaml" for demand in demands]


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
        lines.append(f"  {_SIGNS[release.change]} {release.name} ({release.what})")
        lines += [f"      {detail}" for detail in release.details]
    return lines


# ---- authors: who made a commit or caused a follow commit, and who runs this program ----
#
# A follow commit is made by the generator, and renders what people committed. Its trailers name
# people's commits, and its author names these people. A commit is by a person if no generator on
# any machine made it, or if it is of a proposal (:mod:`.commit_log`).

_ROOTS = (*CONFIG_ROOTS, LEDGER_ROOT, *GENERATED_ROOTS, NOTES_ROOT)
_MOST_NAMED = 20
_NO_ADDRESS = "@demandops.invalid"


class Person(NamedTuple):
    name: str
    email: str

    @property
    def is_known(self) -> bool:
        # if git knows no address, it is ``<login>@demandops.invalid``
        return not self.email.endswith(_NO_ADDRESS)

    def __str__(self) -> str:
        return f"{self.name} <{self.email}>"


def person_commits_since(repo: Repository, known: Oid, to: Oid) -> list[Commit]:
    commits = commit_log.person_commits(repo, to, known)
    return [commit for commit in commits if _touches(commit, _ROOTS)]


def fault_origin(repo: Repository, known: Oid, to: Oid) -> Callable[[str], tuple[str, str] | None]:
    # A fault is caused by the last person's commit that changed its file, else by the last one that
    # changed any file of the generator. The function returns the commit's id and author.

    @cache  # the commits are read only when needed: most problems are already in the report
    def commits() -> list[Commit]:
        return list(commit_log.person_commits(repo, to, known))

    def origin(path: str) -> tuple[str, str] | None:
        for paths in ((path,) if path else (), _ROOTS):
            for commit in commits():
                if _touches(commit, paths):
                    return str(commit.id), str(author_of(commit))
        return None

    return origin


def _touches(commit: Commit, paths: Iterable[str]) -> bool:
    return trees.differ(trees.parent_tree(commit), commit.tree, paths)


def author_of(commit: Commit) -> Person:
    plain = signature(*commit_log.author_of(commit), commit_log.time_of(commit))
    return Person(plain.name, plain.email)


def caused_by_trailers(causes: Sequence[Commit]) -> list[tuple[str, str]]:
    # of the newest causes, whose newest is first, in time's order
    named = reversed(causes[:_MOST_NAMED])
    return [("Caused-By", f"{commit.id} {author_of(commit)}") for commit in named]


def follow_author(causes: Sequence[Commit], now: datetime) -> pygit2.Signature:
    if not causes:
        return generator_signature(now)
    people = list(dict.fromkeys(author_of(commit) for commit in reversed(causes)))
    names = ", ".join(dict.fromkeys(person.name for person in people))
    # one person's own address, so that `git log --author` finds the follow commit too
    email = people[0].email if len(people) == 1 else commit_log.GENERATOR_EMAIL
    return signature(names, email, commit_log.time_of(causes[0]))


def operator(folder: str | None = None) -> Person:
    try:
        login = getpass.getuser()
    except (KeyError, OSError):  # a container's user has no passwd entry
        login = "unknown"

    def configured(variable: str, key: str) -> str:
        setting = git.Git(folder).config("--get", key, with_exceptions=False)
        return os.environ.get(variable) or str(setting)

    name = configured("GIT_AUTHOR_NAME", "user.name") or login
    email = configured("GIT_AUTHOR_EMAIL", "user.email") or f"{login}{_NO_ADDRESS}"
    return Person(name, email)
