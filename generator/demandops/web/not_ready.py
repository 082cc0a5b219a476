"""Which applications are not ready, why and since when, and who can fix the causes."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from demandops.cluster.release_status import ReleaseStatus
from demandops.decide.planning.overrides import suspended_claims
from demandops.model.config.config import IMAGES_FILE, Config
from demandops.model.config.override import Override
from demandops.model.ledger.claim import Claim, requesters_of
from demandops.model.ledger.records import in_turn
from demandops.model.release import Release, ServiceRelease
from demandops.repo.history.commit_log import LogEntry
from demandops.repo.history.commit_message import GENERATOR_NAME
from demandops.views import release_causes
from demandops.views.source import Source, since_of, word_of, worst_word
from demandops.web.lists import Cell, Filter, Part, Row, cell, exactly

# ---- who can probably fix a release that is not ready ----

Kind = Literal["failing", "suspended", "invalid", "unread", "decision", "waiting", "starting"]

# The color of each kind of cause, in the order in which the view lists the kinds.
KINDS: dict[str, str] = {
    **dict.fromkeys(("unread", "failing", "invalid", "suspended"), "bad"),
    **dict.fromkeys(("decision", "waiting", "starting"), "busy"),
}

# A function that returns the newest commit that changed a file or folder, or None.
LastChange = Callable[[str], "LogEntry | None"]


# Who can fix a cause, how, and a command; the latter two may be empty.
Remedy = tuple[str, str, str]

# What kubelet and the scheduler write into a pod's status, which the reason of a release quotes.
_IMAGE = re.compile(r"ImagePull|ErrImage|InvalidImage|manifest unknown|pull access denied", re.I)
_ROOM = re.compile(r"not scheduled|Insufficient|didn't match|untolerated taint|unschedulable", re.I)
_CRASH = re.compile(r"CrashLoop|exit code|OOMKilled|RunContainerError", re.I)


def remedy_of(
    kind: Kind, release: Release, config: Config, object: str, reason: str, last_change: LastChange
) -> Remedy:
    # ``object`` names what is not ready: an object, such as ``Deployment perception/od-edge``, or a
    # cluster that cannot be read.
    cluster, (word, _, name) = release.node.cluster, object.partition(" ")
    namespace, _, short = name.partition("/")
    describe = ["kubectl", "-n", namespace, "describe", word.lower(), short]
    command = shlex.join(describe) if short else ""
    if word == "cluster":
        how = "make its API reachable from here, and let this page read it (docs/status.md)"
        return f"the operator of cluster {cluster}", how, ""
    if kind == "waiting" or word in ("Kustomization", "GitRepository", "Application"):
        who = f"the operator of the GitOps controller of cluster {cluster}"
        if kind != "failing":
            who = (
                f"the GitOps controller of cluster {cluster}; if the controller fails, its operator"
            )
        return who, "", command
    if kind == "starting":
        who = f"nobody yet; if this lasts, the operator of cluster {cluster}"
        return who, "", command
    if release.shaping.by:
        override = release.shaping.by[-1][0]
        return (
            f"{override.owner}, who owns {override.path}, which changes this release",
            f"correct or remove {override.path} by pull request",
            command,
        )
    if _ROOM.search(reason):
        return (
            f"the operator of node {release.node.id} in cluster {cluster}",
            "make room on the node, or name another node in the demand",
            command,
        )
    names = [name for name in release.images if name in config.images]
    if names and _IMAGE.search(reason):
        images = [
            release.image(name, config)
            if isinstance(release, ServiceRelease)
            else release.shaping.image(name, config.images[name])
            for name in names
        ]
        files = dict.fromkeys(config.file_of(IMAGES_FILE, name) for name in names)
        by = _changed_by(files, last_change)
        return (
            f"the publisher of image {', '.join(image.reference() for image in images)}",
            f"push the image, or correct its entry in {' or '.join(files)} by pull request{by}",
            command,
        )
    how = "look at the log of the container" if _CRASH.search(reason) else ""
    if not isinstance(release, ServiceRelease):
        return f"the maintainer of the {release.type.word} client", how, command
    where = f"appdefs/{release.service.folder}"
    by = _changed_by([where], last_change)
    return f"the maintainer of {where}{by}", how, command


def _changed_by(paths: Iterable[str], last_change: LastChange) -> str:
    changes = filter(None, map(last_change, paths))
    people = dict.fromkeys(change.author for change in changes if change.author != GENERATOR_NAME)
    return f" (last changed by {', '.join(people)})" if people else ""


# ---- the causes, and the applications that they keep from being ready ----

_MOST_LISTED = 3


@dataclass(frozen=True, slots=True)
class Cause:
    kind: Kind
    what: Part
    why: str
    who: str  # can fix it
    how: str = ""
    command: str = ""
    since: datetime | None = None
    told: str = ""  # details, such as a cluster's message, or a person's reason
    releases: tuple[str, ...] = ()  # empty if the cause is not found by release
    applications: tuple[str, ...] = ()
    requesters: tuple[str, ...] = ()
    demands: tuple[str, ...] = ()

    @property
    def is_look(self) -> bool:
        # the command mends nothing, it only shows more
        looks = (" describe ", "git show ", "demandops check")
        return any(look in self.command for look in looks) and "| kubectl" not in self.command

    def row(self) -> Row:
        texts = {
            "release": self.releases,
            "application": self.applications,
            "requester": self.requesters,
            "demand": self.demands,
        }
        return Row({"what": Cell((self.what,)), "why": cell(self.why, self.told)}, texts)


@dataclass(frozen=True, slots=True)
class Ready:
    application: str
    word: str  # for a health, or the kind of the first cause
    causes: tuple[Cause, ...]


def causes(now: Source, wanted: Filter) -> list[Cause]:
    """Return every cause that matches the filter, the worst kind first, then the oldest."""
    all_causes = [
        *_unread_or_invalid(now),
        *_overridden(now),
        *_of_releases(now),
        *_awaited(now, sorted(now.not_rendered)),
    ]
    places = {kind: place for place, kind in enumerate(KINDS)}
    latest = now.now.timestamp()
    all_causes.sort(
        key=lambda cause: (places[cause.kind], cause.since.timestamp() if cause.since else latest)
    )
    return [cause for cause in all_causes if wanted.matches(cause.row())]


def applications(now: Source, causes: Iterable[Cause], wanted: Filter) -> list[Ready]:
    by_application: dict[str, list[Cause]] = {}
    for cause in causes:
        for application in cause.applications:
            by_application.setdefault(application, []).append(cause)
    statuses: dict[str, list[ReleaseStatus]] = {}
    claims_of: dict[str, list[Claim]] = {}
    for name, release in now.releases.items():
        for application in release.applications if isinstance(release, ServiceRelease) else ():
            statuses.setdefault(application, []).append(now.status(name))
    for claim in now.state.ledger:
        if claim.is_on_application:
            claims_of.setdefault(claim.subject.id, []).append(claim)
    shown = []
    for application, claims in sorted(claims_of.items()):
        texts = {"requester": requesters_of(claims), "demand": [claim.demand for claim in claims]}
        row = Row({"application": cell(application)}, texts)
        if wanted.matches(row):
            its_causes = tuple(by_application.get(application, ()))
            word = worst_word(statuses.get(application, ()))
            # what runs well may still be denied or invalid; then the cause says more
            if its_causes and word in ("healthy", "unknown"):
                word = its_causes[0].kind
            shown.append(Ready(application, word, its_causes))
    return sorted(shown, key=lambda ready: (not ready.causes, ready.application))


def _unread_or_invalid(now: Source) -> Iterator[Cause]:
    if now.unread:
        yield Cause(
            "unread",
            Part("The state repo"),
            "cannot be read, so this page may be out of date",
            "the operator of the Git server or of this page",
            "mend what the text above names; the page tries again",
            told=now.unread,
        )
    if now.push_denied:
        yield Cause(
            "unread",
            Part("The state repo"),
            "takes no commit of this generator, so demands wait, and are refused after some time",
            "the operator of the Git server",
            "let the generator's account push to main",
            told=now.push_denied,
        )
    for problem in now.problems:
        change = now.last_change(problem.file)
        who = "the person who last changed it"
        if problem.author:
            who = f"{problem.author}, whose commit made it invalid"
        field = f", {problem.field}" if problem.field else ""
        held = now.snapshot.configuration
        yield Cause(
            "invalid",
            Part(f"{problem.file or 'The configuration'}{field}"),
            f"is not valid, so the configuration of commit {str(held)[:10]} stays in effect",
            who,
            now.remedy or "correct the file by pull request",
            f"git show {problem.since[:10]}" if problem.since else "demandops check .",
            told=problem.message,
            since=change.time if change else None,
        )


def _overridden(now: Source) -> Iterator[Cause]:
    def denial(
        override: Override,
        what: Part,
        state: str,
        claims: Sequence[Claim],
        applications: Iterable[str],
        releases: tuple[str, ...] = (),
    ) -> Cause:
        ends = f", or wait until the override ends at {override.expires}"
        change = now.last_change(override.path)
        return Cause(
            "suspended",
            what,
            f"{state}, but {override.path} denies it",
            f"{override.owner}, who owns the override",
            f"remove the file by pull request{ends if override.expires else ''}",
            shlex.join(["git", "rm", override.path]),
            told=override.reason,
            releases=releases,
            applications=tuple(dict.fromkeys(applications)),
            requesters=requesters_of(claims),
            demands=tuple(dict.fromkeys(claim.demand for claim in claims)),
            since=change.time if change else None,
        )

    by_override: dict[str, tuple[Override, list[Claim]]] = {}
    for claim, override in suspended_claims(now.state):
        by_override.setdefault(override.name, (override, []))[1].append(claim)
    for override, suspended in by_override.values():
        names = dict.fromkeys(claim.subject.id for claim in suspended)
        what = Part(" and ".join(names), "overrides")
        applications = _applications_with(now, suspended)
        yield denial(override, what, "is booked", suspended, applications)
    # the claims that need a denied release are not suspended as a whole
    for release, override in now.denied:
        needing = release_causes.claims_behind(now.active.ledger, release)
        what = Part(release.description, "release", {"name": release.name})
        served = release.applications if isinstance(release, ServiceRelease) else ()
        yield denial(override, what, "is needed", needing, served, (release.name,))


def _awaited(now: Source, not_rendered: list[str]) -> Iterator[Cause]:
    for waiting in in_turn(now.state.ledger.waiting):
        yield Cause(
            "waiting",
            Part(waiting.demand, "demands", {"q": exactly("demand", waiting.demand)}),
            "waits for room on a node",
            "the generator, as soon as a node has room; the nodes' operator can add room, or a "
            "requester can release something",
            since=waiting.since,
            requesters=waiting.requesters,
            demands=(waiting.demand,),
        )
    for proposal in now.proposals:
        yield Cause(
            "decision",
            Part(proposal.summary, "overrides"),
            "awaits a person's approval",
            "a person who may merge to main",
            "merge the branch to approve the demand, or delete the branch to refuse it",
            shlex.join(["demandops", "approve", proposal.branch, "--commit", proposal.commit]),
            since=proposal.since,
            requesters=proposal.requesters,
            demands=proposal.demands,
        )
    for old in now.old_bootstraps:
        yield Cause(
            "decision",
            Part(old.file),
            f"is not applied to cluster '{old.cluster}' in the current version",
            f"an administrator of cluster {old.cluster}",
            "apply it",
            old.command,
            told=f"access domains: {', '.join(old.domains)}",
        )
    for orphan in now.orphans:
        yield Cause(
            "decision",
            Part(orphan.object),
            f"runs on cluster '{orphan.cluster}', but belongs to no release",
            f"an administrator of cluster {orphan.cluster}",
            "delete it",
            orphan.command,
            told="the GitOps controller no longer knows that it created this object",
        )
    if not_rendered:
        count = len(not_rendered)
        more = f" and {count - _MOST_LISTED} more" if count > _MOST_LISTED else ""
        yield Cause(
            "waiting",
            Part("1 generated file" if count == 1 else f"{count} generated files"),
            f"{'waits' if count == 1 else 'wait'} for a generator to carry out a person's commit",
            "the operator of the generator",
            "start a generator; a running generator carries out the commit at its next fetch",
            told=", ".join(not_rendered[:_MOST_LISTED]) + more,
            since=now.entry.time,
        )


def _of_releases(now: Source) -> Iterator[Cause]:
    # One reason of several objects is one cause, with the command for the first object.
    together: dict[tuple[Kind, str, str, str, str, str], list[tuple[str, str]]] = {}
    kinds: dict[str, Kind] = {"failing": "failing", "waiting": "waiting"}
    for name, release in now.releases.items():
        health, word = now.status(name).health, word_of(now.status(name))
        if word not in ("healthy", "unknown"):
            kind, reason = kinds.get(word, "starting"), health.reason
            who, how, command = remedy_of(
                kind, release, now.config, health.object, reason, now.last_change
            )
            is_cluster = health.object.startswith("cluster ")
            sort = health.object if is_cluster else health.object.partition(" ")[0]
            key = kind, sort, reason, release.node.cluster, who, how
            together.setdefault(key, []).append((name, command))
    for (kind, sort, reason, cluster, who, how), members in together.items():
        names = [name for name, _ in members]
        releases, several = [now.releases[name] for name in names], len(names) > 1
        what = Part(releases[0].description, "release", {"name": names[0]})
        if several:
            query = f"{exactly('cluster', cluster)} {exactly('health', kind)}"
            what = Part(f"{len(names)} releases in {cluster}", "services", {"q": query})
        fail, have, are = ("fail", "have", "are") if several else ("fails", "has", "is")
        why = fail if kind == "failing" else f"{are} starting and not ready yet"
        if kind == "waiting":
            why = f"{have} not been applied by the cluster yet"
        objects = dict.fromkeys(now.status(name).health.object for name in names)
        object = next(iter(objects)) + (" and others" if len(objects) > 1 else "")
        if sort.startswith("cluster "):
            why = f"cannot be seen, because {sort} cannot be read"
        claims = [claim for name in names for claim in now.claims_of_releases[name]]
        applications: dict[str, None] = {}
        for name, release in zip(names, releases, strict=True):
            # a connection is needed by the applications of the demands that hold it
            applications |= dict.fromkeys(
                release.applications
                if isinstance(release, ServiceRelease)
                else _applications_with(now, now.claims_of_releases[name])
            )
        times = filter(None, (since_of(now.status(name)) for name in names))
        yield Cause(
            kind,
            what,
            why,
            who,
            how,
            members[0][1],
            since=min(times, default=None),
            told=f"{object}: {reason}" if object else reason,
            releases=tuple(names),
            applications=tuple(applications),
            requesters=requesters_of(claims),
            demands=tuple(dict.fromkeys(claim.demand for claim in claims)),
        )


def _applications_with(now: Source, claims: Iterable[Claim]) -> Iterator[str]:
    """Yield the ids of all applications of the demands to which these claims belong."""
    for demand in dict.fromkeys(claim.demand for claim in claims):
        held = now.claims_of_demands.get(demand, ())
        yield from (claim.subject.id for claim in held if claim.is_on_application)
