"""What keeps releases and demands from being ready, since when, and who can mend it and how."""

from __future__ import annotations

import re
import shlex
from collections.abc import Collection, Iterable, Iterator
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Literal

from demandops.base.quoting import count, some
from demandops.decide.planning.overrides import suspended_claims
from demandops.model.config.config import IMAGES_FILE
from demandops.model.config.override import Override
from demandops.model.ledger.claim import Claim, requesters_of
from demandops.model.ledger.records import in_turn
from demandops.model.release import Release, ServiceRelease
from demandops.repo.history.commit_message import GENERATOR_NAME
from demandops.repo.load.snapshot import Problem
from demandops.views.rows import RANKS, Row, labels_of
from demandops.views.source import Source, claims_behind, since_of, word_of

Kind = Literal["failing", "suspended", "invalid", "unread", "decision", "waiting", "starting"]

# What kubelet and the scheduler write into a pod's status, which the reason of a release quotes.
_IMAGE = re.compile(r"ImagePull|ErrImage|InvalidImage|manifest unknown|pull access denied", re.I)
_ROOM = re.compile(r"not scheduled|Insufficient|didn't match|untolerated taint|unschedulable", re.I)
_CRASH = re.compile(r"CrashLoop|exit code|OOMKilled|RunContainerError", re.I)

_MOST_LISTED = 3


@dataclass(frozen=True, slots=True)
class Cause:
    kind: Kind
    what: str  # is not ready
    why: str
    who: str  # can mend it
    how: str = ""
    command: str = ""
    since: datetime | None = None
    told: str = ""  # details, such as a cluster's message, or a person's reason
    thing: tuple[str, str] = ("", "")  # that ``what`` names, if one does: its kind and name
    cluster: str = ""  # of the releases
    releases: tuple[str, ...] = ()  # empty if the cause is not found by release
    applications: tuple[str, ...] = ()
    requesters: tuple[str, ...] = ()
    demands: tuple[str, ...] = ()

    @property
    def is_look(self) -> bool:
        # the command mends nothing, it only shows more
        looks = (" describe ", "git show ", "demandops check")
        return any(look in self.command for look in looks) and "| kubectl" not in self.command

    @property
    def row(self) -> Row:
        return Row(labels_of(asdict(self)))


def causes(source: Source) -> list[Cause]:
    """Return every cause, the worst kind first, then the oldest."""
    every = [*_unread_or_invalid(source), *_denied(source)]
    every += [*_not_ready(source), *_awaited(source)]
    every.sort(key=lambda cause: (RANKS[cause.kind], cause.since or source.now))
    return every


def _unread_or_invalid(source: Source) -> Iterator[Cause]:
    if source.unread:
        who = "the operator of the Git server or of this program"
        how = "mend what the text above names; the program tries again"
        why = "cannot be read, so this may be out of date"
        yield Cause("unread", "The state repo", why, who, how, told=source.unread)
    if source.push_denied:
        why = "takes no commit of this generator, so demands wait, and are refused after some time"
        who, how = "the operator of the Git server", "let the generator's account push to main"
        yield Cause("unread", "The state repo", why, who, how, told=source.push_denied)
    of_commits: dict[str, list[Problem]] = {}
    for problem in source.problems:
        of_commits.setdefault(problem.since or problem.file, []).append(problem)
    for problem, *others in of_commits.values():
        change = source.last_change(problem.file)
        files = [*dict.fromkeys(each.file for each in (problem, *others) if each.file)]
        what = " and ".join([*files[:_MOST_LISTED], *(["others"] if files[_MOST_LISTED:] else [])])
        field = f", {problem.field}" if problem.field and not others else ""
        held, are = str(source.snapshot.configuration)[:10], "are" if files[1:] else "is"
        yield Cause(
            "invalid",
            f"{what or 'The configuration'}{field}",
            f"{are} not valid, so the configuration of commit {held} stays in effect",
            f"{problem.author}, whose commit made it invalid"
            if problem.author
            else "the person who last changed it",
            source.remedy or "correct the file by pull request",
            f"git show {problem.since[:10]}" if problem.since else "demandops check .",
            change.time if change else None,
            "\n".join(str(each._replace(since="")) for each in (problem, *others))
            if others
            else problem.message,
        )


def _denied(source: Source) -> Iterator[Cause]:
    by_override: dict[str, tuple[Override, list[Claim]]] = {}
    for claim, override in suspended_claims(source.state):
        by_override.setdefault(override.name, (override, []))[1].append(claim)
    denials: list[tuple[Override, tuple[str, str], str, list[Claim], Iterable[str]]] = [
        (override, ("override", override.name), "", claims, _applications_with(source, claims))
        for override, claims in by_override.values()
    ]
    # the claims that need a denied release are not suspended as a whole
    for release, override in source.denied:
        claims = claims_behind(source.active.ledger, release)
        served = release.applications if isinstance(release, ServiceRelease) else ()
        thing = "release", release.name
        denials.append((override, thing, release.description, claims, served))
    for override, thing, needed, claims, applications in denials:
        change = source.last_change(override.path)
        end = f", or wait until the override ends at {override.expires}" if override.expires else ""
        yield Cause(
            "suspended",
            needed or " and ".join(dict.fromkeys(claim.subject.id for claim in claims)),
            f"{'is needed' if needed else 'is booked'}, but {override.path} denies it",
            f"{override.owner}, who owns the override",
            f"remove the file by pull request{end}",
            shlex.join(["demandops", "override", "end", override.name]),
            change.time if change else None,
            told=override.reason,
            thing=thing,
            releases=(thing[1],) if needed else (),
            applications=tuple(dict.fromkeys(applications)),
            requesters=requesters_of(claims),
            demands=tuple(dict.fromkeys(claim.demand for claim in claims)),
        )


def _applications_with(source: Source, claims: Collection[Claim]) -> Iterator[str]:
    """Yield the ids of the applications that need these claims: those of the claims' demands.

    A suspended application that others demand too runs on for them.
    """
    keys = {claim.key for claim in claims}
    for demand in dict.fromkeys(claim.demand for claim in claims):
        for claim in source.claims_of_demands.get(demand, ()):
            runs_on = claim.key in keys and source.active.ledger.claims_on(claim.subject)
            if claim.is_on_application and not runs_on:
                yield claim.subject.id


def _not_ready(source: Source) -> Iterator[Cause]:
    # One reason of several objects is one cause, with the command for the first object.
    together: dict[tuple[Kind, str, str, str, str, str], list[tuple[str, str]]] = {}
    kinds: dict[str, Kind] = {"failing": "failing", "waiting": "waiting"}
    for name, release in source.releases.items():
        health, word = source.status(name).health, word_of(source.status(name))
        if word not in ("healthy", "unknown"):
            kind, object = kinds.get(word, "starting"), health.object
            who, how, command = remedy_of(source, kind, release, object, health.reason)
            sort = object if object.startswith("cluster ") else object.partition(" ")[0]
            key = kind, sort, health.reason, release.node.cluster, who, how
            together.setdefault(key, []).append((name, command))
    for (kind, sort, reason, cluster, who, how), members in together.items():
        names = [name for name, _ in members]
        releases, several = [source.releases[name] for name in names], len(names) > 1
        fail, have, are = ("fail", "have", "are") if several else ("fails", "has", "is")
        why = fail if kind == "failing" else f"{are} starting and not ready yet"
        if kind == "waiting":
            why = f"{have} not been applied by the cluster yet"
        if sort.startswith("cluster "):
            why = f"cannot be seen, because {sort} cannot be read"
        objects = [*dict.fromkeys(source.status(name).health.object for name in names)]
        object = objects[0] + (" and others" if len(objects) > 1 else "")
        claims = [claim for name in names for claim in source.claims_of_releases[name]]
        applications: dict[str, None] = {}
        for name, release in zip(names, releases, strict=True):
            if isinstance(release, ServiceRelease):
                applications |= dict.fromkeys(release.applications)
            else:  # the applications of the demands that hold the connection need it
                behind = source.claims_of_releases[name]
                applications |= dict.fromkeys(_applications_with(source, behind))
        yield Cause(
            kind,
            f"{len(names)} releases in {cluster}" if several else releases[0].description,
            why,
            who,
            how,
            members[0][1],
            min(filter(None, (since_of(source.status(name)) for name in names)), default=None),
            told=f"{object}: {reason}" if object else reason,
            thing=("", "") if several else ("release", names[0]),
            cluster=cluster,
            releases=tuple(names),
            applications=tuple(applications),
            requesters=requesters_of(claims),
            demands=tuple(dict.fromkeys(claim.demand for claim in claims)),
        )


def remedy_of(
    source: Source, kind: Kind, release: Release, object: str, reason: str
) -> tuple[str, str, str]:
    """Return who can probably mend a release, how, and a command; the latter two may be empty.

    ``object`` names what is not ready, such as ``Deployment perception/od-edge``, or a cluster that
    cannot be read.
    """
    config, cluster, (word, _, name) = source.config, release.node.cluster, object.partition(" ")
    namespace, _, short = name.partition("/")
    describe = ["kubectl", "-n", namespace, "describe", word.lower(), short]
    command = shlex.join(describe) if short else ""
    if word == "cluster":
        how = "make its API reachable from here, and allow to read it (docs/status.md)"
        return f"the operator of cluster {cluster}", how, ""
    if kind == "waiting" or word in ("Kustomization", "GitRepository", "Application"):
        controller = f"the GitOps controller of cluster {cluster}"
        if kind == "failing":
            return f"the operator of {controller}", "", command
        return f"{controller}; if the controller fails, its operator", "", command
    if kind == "starting":
        return f"nobody yet; if this lasts, the operator of cluster {cluster}", "", command
    if release.shaping.by:
        override = release.shaping.by[-1][0]
        who = f"{override.owner}, who owns {override.path}, which changes this release"
        return who, f"correct or remove {override.path} by pull request", command
    if _ROOM.search(reason):
        who = f"the operator of node {release.node.id} in cluster {cluster}"
        return who, "make room on the node, or name another node in the demand", command

    def changed_by(*paths: str) -> str:
        changes = filter(None, map(source.last_change, paths))
        authors = dict.fromkeys(each.author for each in changes if each.author != GENERATOR_NAME)
        return f" (last changed by {', '.join(authors)})" if authors else ""

    names = [name for name in release.images if name in config.images]
    if names and _IMAGE.search(reason):
        images = [
            release.image(name, config)
            if isinstance(release, ServiceRelease)
            else release.shaping.image(name, config.images[name])
            for name in names
        ]
        files = dict.fromkeys(config.file_of(IMAGES_FILE, name) for name in names)
        who = f"the publisher of image {', '.join(image.reference() for image in images)}"
        how = f"push the image, or correct its entry in {' or '.join(files)} by pull request"
        return who, how + changed_by(*files), command
    how = "look at the log of the container" if _CRASH.search(reason) else ""
    if not isinstance(release, ServiceRelease):
        return f"the maintainer of the {release.type.word} client", how, command
    where = f"appdefs/{release.service.folder}"
    return f"the maintainer of {where}{changed_by(where)}", how, command


def _awaited(source: Source) -> Iterator[Cause]:
    for waiting in in_turn(source.state.ledger.waiting):
        yield Cause(
            "waiting",
            waiting.demand,
            "waits for room on a node",
            "the generator, as soon as a node has room; the nodes' operator can add room, or a "
            "requester can release something",
            since=waiting.since,
            thing=("demand", waiting.demand),
            requesters=waiting.requesters,
            demands=(waiting.demand,),
        )
    for proposal in source.proposals:
        yield Cause(
            "decision",
            proposal.summary,
            "awaits a person's approval",
            "a person who may merge to main",
            "merge the branch to approve the demand, or delete the branch to refuse it",
            shlex.join(["demandops", "approve", proposal.branch, "--commit", proposal.commit]),
            proposal.since,
            thing=("proposal", proposal.branch),
            requesters=proposal.requesters,
            demands=proposal.demands,
        )
    for old in source.old_bootstraps:
        yield Cause(
            "decision",
            old.file,
            f"is not applied to cluster '{old.cluster}' in the current version",
            f"an administrator of cluster {old.cluster}",
            "apply it",
            old.command,
            told=f"access domains: {', '.join(old.domains)}",
            cluster=old.cluster,
        )
    for orphan in source.orphans:
        yield Cause(
            "decision",
            orphan.object,
            f"runs on cluster '{orphan.cluster}', but belongs to no release",
            f"an administrator of cluster {orphan.cluster}",
            "delete it",
            orphan.command,
            told="the GitOps controller no longer knows that it created this object",
            cluster=orphan.cluster,
        )
    if files := sorted(source.not_rendered):
        yield Cause(
            "waiting",
            count(len(files), "generated file"),
            f"{'waits' if len(files) == 1 else 'wait'} for a generator to carry out a person's "
            "commit",
            "the operator of the generator",
            "start a generator; a running generator carries out the commit at its next fetch",
            since=source.entry.time,
            told=some(files, _MOST_LISTED),
        )
