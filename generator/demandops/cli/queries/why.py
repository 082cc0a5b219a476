"""``demandops why``: what a name means, and all that explains why it runs or ran."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import click

from demandops.base.errors import StateRepoError, closest, suggestion
from demandops.base.naming import Subject, SubjectKind
from demandops.base.quoting import quoted
from demandops.base.runtime import REAL
from demandops.cli import json_output
from demandops.cli.json_output import (
    Json,
    commit_data,
    decision_text,
    override_data,
    release_data,
    time_text,
)
from demandops.cli.output import at_option, busy
from demandops.cli.queries.diff import loaded
from demandops.cli.queries.get import effect_words
from demandops.cli.target import names_of, state_repo_option
from demandops.decide.override_report import affected_releases, override_report
from demandops.decide.planning.overrides import suspended_by, without_suspended
from demandops.decide.warnings import missing_inputs
from demandops.model.config.base_model import duration_text
from demandops.model.config.config import NODES_FILE
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger.claim import Claim
from demandops.model.ledger.ledger import World
from demandops.model.release import Release
from demandops.render.gitops import path_of
from demandops.repo import reader
from demandops.repo.history.commit_log import LogEntry, PathHistory
from demandops.repo.load import ledger_files
from demandops.repo.load.snapshot import Snapshot
from demandops.repo.reader import Reader
from demandops.views import release_causes
from demandops.views.demand_lists import nodes_of

# ---- the object that has the given name ----

KINDS = (
    *("release", "application", "connection", "demand"),
    *("node", "appdef", "requester", "override"),
)
_MOST_LISTED = 8


@dataclass(frozen=True, slots=True)
class Match:
    kind: str  # one of `KINDS`, `claim` or `file`
    name: str
    path: str = ""
    release: Release | None = None
    subject: Subject | None = None


def match_of(repo: Reader, snapshot: Snapshot, name: str, kind: str | None) -> Match:
    # of a name or a path; only the history up to the commit of ``snapshot`` counts
    if name.startswith(("clusters/", "bootstrap/", f"{claim_files.LEDGER_ROOT}/")):
        return _by_path(repo, snapshot, name)
    world = snapshot.state
    matches = []
    release = release_causes.release_named(world, name)
    path = path_of(release) if release else repo.release_path(name, str(snapshot.commit))
    if path is None:  # a release that an override denies may never have run
        denied = release_causes.denied_release_named(world, name)
        path = path_of(denied[0]) if denied else None
    if path is not None:
        matches.append(Match("release", name, path, release))
    for subject in (Subject(subject_kind, name) for subject_kind in SubjectKind):
        folder = claim_files.folder_of(subject)
        if world.ledger.claims_on(subject) or _has_history(repo, snapshot, folder):
            matches.append(Match(subject.kind.value[:-1], name, folder, subject=subject))
    matches = [match for match in matches if kind in (None, match.kind)]
    matches = matches or list(_by_looser_match(repo, snapshot, name, kind))
    running = [
        match
        for match in matches
        if match.release or (match.subject and world.ledger.claims_on(match.subject))
    ]
    if len(running or matches) == 1:
        return (running or matches)[0]
    if matches:
        kinds = ", ".join(match.kind for match in matches)
        raise StateRepoError(
            f"{quoted(name)} names several things: {kinds}; choose one with --kind"
        )
    if "/" in name and _has_history(repo, snapshot, name.rstrip("/")):
        return _by_path(repo, snapshot, name)
    running_names = {release.name for release in release_causes.releases(world)}
    names = {*running_names, *repo.stopped_release_names(str(snapshot.commit))}
    names |= {id for subject_kind in SubjectKind for id in world.ledger.subjects(subject_kind)}
    names |= {*world.config.nodes, *world.config.appdefs, *world.config.overrides}
    names |= {id for kind in ("demand", "requester") for id in world.ledger.indexed_names(kind)}
    parts = {part for running_name in running_names for part in running_name.split("-")}
    close = closest(name, names | parts)  # a part of a release's name is also accepted
    names = {close} if close else names
    if kind is not None:
        remedy = "; leave out --kind" if close in (None, name) else suggestion(name, names)
        raise StateRepoError(f"no {kind} is called {quoted(name)}{remedy}")
    raise StateRepoError(
        f"nothing called {quoted(name)} runs or ran up to commit {str(snapshot.commit)[:10]}"
        f"{suggestion(name, names)}"
    )


def _by_looser_match(
    repo: Reader, snapshot: Snapshot, name: str, kind: str | None
) -> Iterator[Match]:
    # for a name that is no whole name of a release or subject
    world, commit = snapshot.state, str(snapshot.commit)
    config, index = world.config, world.ledger.index
    places = {
        "demand": "" if ("demand", name) in index else None,
        "node": config.file_of(NODES_FILE, name) if name in config.nodes else None,
        "appdef": f"appdefs/{name}/appdef.yaml" if name in config.appdefs else None,
        "override": config.overrides[name].path if name in config.overrides else None,
        "requester": "" if ("requester", name) in index else None,
    }
    for named_kind, path in places.items():
        if path is not None and kind in (None, named_kind):
            yield Match(named_kind, name, path)
            return
    # what runs or is held comes before what has ended
    if kind in (None, "release"):
        parts = {r.name: r for r in release_causes.releases(world) if name in r.name}
        if parts:
            release = parts[_the_only_name(name, [*parts])]
            yield Match("release", release.name, path_of(release), release)
            return
    if kind in (None, "demand"):
        if ids := sorted(id for id in world.ledger.indexed_names("demand") if id.startswith(name)):
            yield Match("demand", _the_only_name(name, ids, "demand ids begin with {}"))
            return
        if demand_commits(repo, snapshot, name):
            yield Match("demand", name)
            return
    if kind in (None, "release"):
        ended = sorted(part for part in repo.stopped_release_names(commit) if name in part)
        if ended:
            only = _the_only_name(name, ended)
            yield Match("release", only, repo.release_path(only, commit) or "")


def _the_only_name(
    part: str, names: list[str], what: str = "releases have {} in their name"
) -> str:
    if len(names) == 1:
        return names[0]
    listed = ", ".join(names[:_MOST_LISTED])
    more = ", …" if len(names) > _MOST_LISTED else ""
    raise StateRepoError(
        f"{len(names)} {what.format(quoted(part))}; give a longer part: {listed}{more}"
    )


def demand_commits(repo: Reader, snapshot: Snapshot, id: str) -> list[LogEntry]:
    entries = repo.log(str(snapshot.commit))  # newest first
    return [entry for entry in entries if id in entry.trailers.get("Demand-Id", ())]


def _by_path(repo: Reader, snapshot: Snapshot, path: str) -> Match:
    path = path.rstrip("/")
    text = repo.file_reader(str(snapshot.commit))(path)
    if (claim := ledger_files.claim_in(path, snapshot.state.ledger)) is not None:
        return Match("claim", claim.demand, path, subject=claim.subject)
    name = path.rsplit("/", 1)[-1].removesuffix(".yaml")
    release = release_causes.release_named(snapshot.state, name)
    if release is not None and path_of(release) == path:
        return Match("release", name, path, release)
    if text is None and not _has_history(repo, snapshot, path):
        raise StateRepoError(
            f"{quoted(path)} is not in the state repo at commit {str(snapshot.commit)[:10]} and "
            "never was before; correct the path"
        )
    if text is not None or not path.startswith(("clusters/", "ledger/")):
        return Match("file", path, path)
    return Match("claim" if claim_files.kind_of(path) else "release", name, path)


def _has_history(repo: Reader, snapshot: Snapshot, path: str) -> bool:
    history = repo.history(path, str(snapshot.commit), 0)
    return bool(history.started or history.stopped)


# ---- the answer of ``demandops why`` as text ----

_OF_RELEASES = {"node": "runs", "appdef": "runs", "override": "applies to"}


def lines_of(answer: Json) -> Iterator[str]:
    runs = answer["runs"]
    yield f"{answer['kind']} {answer['name']} {_state(answer)} at {answer['commit'][:10]}"
    if runs or answer["kind"] in ("node", "appdef", "override"):
        yield f"  what        {answer['what']}"
    if runs and "node" in answer:
        yield (
            f"  where       node {answer['node']}, cluster {answer['cluster']}, namespace "
            f"{answer['namespace']}, access domain {answer['domain']}"
        )
    if answer["file"]:
        yield f"  file        {answer['file']}"
    for reason in answer["missing_inputs"]:
        yield f"  missing     {reason}"
    for path in answer["not_rendered"]:
        yield f"  pending     a generator has yet to write or remove {path}"
    if answer.get("denied_by"):
        yield f"  denied by   {_override_text(answer['denied_by'])}"
    for release in answer.get("releases", ()) if runs else ():
        word = _OF_RELEASES.get(answer["kind"], "needs")
        yield f"  {word:11} {release['name']} on {release['node']} ({release['file']})"
    if answer.get("claims"):
        yield from _claim_lines(answer["claims"])
    if answer.get("shaped_by"):
        yield "configured by"
        for place in answer["shaped_by"]:
            at = f" {place['entry']}" if place["entry"] else ""
            yield f"  {place['file']}{at}: {place['what']}"
    if answer.get("overrides"):
        yield "overridden by"
        yield from (f"  {_override_text(override)}" for override in answer["overrides"])
    yield from _history_lines(answer)


def _state(answer: Json) -> str:
    runs, kind = answer["runs"], answer["kind"]
    if kind in ("file", "claim") and not runs:
        return "no longer exists" if answer["stopped"] else "exists"
    if kind in ("demand", "requester"):
        return "holds claims" if runs else "is suspended" if answer["claims"] else "holds nothing"
    if kind == "node":
        return "is used" if runs else "is not used"
    if kind == "override":
        nothing = answer["state"] == "matches nothing"
        return "has no effect now" if nothing else f"is {answer['state']}"
    return "runs" if runs else "does not run"


def _claim_lines(claims: list[Json]) -> Iterator[str]:
    yield "requested by"
    for claim in claims:
        lease, subject = claim["lease"], f"{claim['subject']['kind']} '{claim['subject']['id']}'"
        until = f", lease of {duration_text(lease['seconds'])}" if lease else ""
        if lease:
            until += f" until {time_text(lease['until'])}" if lease["until"] else ", not started"
        until += (
            ", which has passed; a generator has yet to release the claim"
            if claim["overdue"]
            else ""
        )
        version = f", version {claim['version']}" if claim["version"] else ""
        yield f"  {', '.join(claim['requesters'])} since {time_text(claim['since'])}, for {subject}"
        yield f"    demand {claim['demand']}, request '{claim['request']}'{version}{until}"
        yield f"    {claim['file']}"
        if claim["place"] is not None:
            required = ", ".join(f"{name} {value}" for name, value in claim["place"].items())
            yield f"    the demand requires of the application's node: {required or 'nothing'}"
        if claim["services"]:
            nodes = ", ".join(f"{name} on {node}" for name, node in claim["services"].items())
            yield f"    services on nodes of their own: {nodes}"
        for id, outputs in claim["reads"].items():
            yield f"    reads {', '.join(outputs)} of application '{id}'"
        for id, outputs in claim["held_for"].items():
            yield f"    held for application '{id}', which reads {', '.join(outputs)} of it"
        if claim["suspended_by"]:
            yield f"    suspended by {_override_text(claim['suspended_by'])}"
        if claim["kept_by"]:
            yield f"    kept by {_override_text(claim['kept_by'])}"
            yield f"    to release it: {claim['release_by']} by pull request"
        else:
            yield (
                f"    to release it: {claim['release_by']}, or delete the claim's file by pull "
                "request"
            )


def _override_text(override: Json) -> str:
    until = f", until {time_text(override['until'])}" if override["until"] else ""
    return (
        f"{override['file']}: {', '.join(override['effects'])} (priority "
        f"{override['priority']}{until}), of {override['owner']}: {override['reason']}"
    )


def _history_lines(answer: Json) -> Iterator[str]:
    if answer["stopped"]:
        yield "stopped by"
        yield from _commit_lines(answer["stopped"], why=True)
    if answer["changes"]:
        yield "changed by"
        for entry in answer["changes"]:
            yield from _commit_lines(entry, why=False)
    if answer["more_changes"]:
        git_log = f", or run git log -- {answer['file']}" if answer["file"] else ""
        yield f"  and {answer['more_changes']} earlier commits; to see them, raise -n{git_log}"
    if answer["started"]:
        yield "started by"
        yield from _commit_lines(answer["started"], why=True)


def _commit_lines(entry: Json, *, why: bool) -> Iterator[str]:
    when, word = time_text(entry["time"]), entry["operation"] or "by hand"
    yield f"  {entry['commit'][:10]} {when}  {word}, {entry['author']}: {entry['summary']}"
    if why and entry["why"]:
        yield f"    {entry['why']}"
    if entry["decision"]:
        yield f"    {decision_text(entry['decision'])}"
    for each in entry["carries_out"]:
        yield f"    carries out commit {each['commit'][:10]} of {each['author']}: {each['summary']}"


# ---- the command ----


@click.command()
@click.argument(
    "name",
    metavar="NAME|PATH",
    shell_complete=names_of(
        *("releases", "applications", "connections", "demands", "nodes"),
        *("appdefs", "requesters", "overrides"),
    ),
)
@state_repo_option
@at_option
@click.option(
    "--kind",
    type=click.Choice(KINDS),
    help="The kind of the object, if several objects have the name.",
)
@click.option(
    "-n",
    "--max-count",
    "most",
    type=click.IntRange(0),
    default=10,
    show_default=True,
    help="List at most this many of the commits that changed the object.",
)
@json_output.output_option
def why(
    name: str, state_repo: str, at: str | None, kind: str | None, most: int, output: str
) -> None:
    """Explain why something runs or ran.

    The command shows the requesters, the configuration and overrides that apply, and the commits.
    NAME is the name of a release, application definition or override, or the id of an application,
    connection, demand, node or requester. A part of a release's name or the start of a demand's id
    is enough if no other release or demand has it. PATH is a file in a folder of the state repo,
    such as clusters/ or ledger/. If something no longer runs, the command shows the commit that
    stopped it.

    \b
    Examples:
      demandops why od-edge-vehicle00
      demandops why fusion
      demandops why vehicle00/edge --at 14:03
      demandops why edge --kind node
    """
    with reader.opened(state_repo) as repo:
        snapshot = loaded(repo, at)
        with busy("looking through the commits"):
            match = match_of(repo, snapshot, name, kind)
            answer: Json = {
                "commit": str(snapshot.commit),
                "kind": match.kind,
                "name": match.name,
                **_described(snapshot.state, match),
            }
            claim_files = {claim["file"] for claim in answer.get("claims", ())}
            reasons = (
                f"application '{missing.application}': {missing.reason}"
                for missing in missing_inputs(snapshot.state)
                if missing.file in claim_files
            )
            answer["missing_inputs"] = list(dict.fromkeys(reasons))
            files = {match.path, *(release["file"] for release in answer.get("releases", ()))}
            not_rendered = [] if at else sorted(files & repo.not_rendered(snapshot))
            if not_rendered and answer.get("state") == "in force":
                answer["state"] = "not rendered yet"
            answer["not_rendered"] = not_rendered
            answer |= {"file": match.path or None, **_commits(repo, snapshot, match, most)}
    json_output.show(output, answer, lines_of(answer))


def _described(world: World, match: Match) -> Json:
    name, config = match.name, world.config
    if match.release is not None:
        release = match.release
        claims = release_causes.claims_behind(without_suspended(world).ledger, release)
        return {
            "runs": True,
            **json_output.place_data(release),
            **_claims(claims, world),
            "shaped_by": [
                {"file": file, "entry": entry or None, "what": what}
                for file, entry, what in release_causes.shaping_files(release, config)
            ],
            "overrides": [override_data(*each) for each in release.shaping.by],
        }
    if match.subject is not None:
        claims = sorted(world.ledger.claims_on(match.subject), key=lambda claim: claim.booked)
        what = str(match.subject)
        if claims and not claims[0].is_on_application:
            connection = claims[0].connection
            word = connection.type.word.upper() if connection.type else ""
            what = f"{word} {what} from {connection.source} to {connection.target}".lstrip()
        releases = release_causes.releases(world, match.subject)
        return {
            "runs": any(suspended_by(claim, world) is None for claim in claims),
            "what": what,
            "subject": json_output.subject_data(match.subject),
            **_claims(claims, world),
            "releases": [release_data(release) for release in releases],
        }
    if match.kind == "release":  # it does not run; perhaps an override denies it
        file_name = match.path.rsplit("/", 1)[-1].removesuffix(".yaml")
        if (denied := release_causes.denied_release_named(world, file_name)) is None:
            return {"runs": False}
        release, override = denied
        return {
            "runs": False,
            **json_output.place_data(release),
            "denied_by": override_data(override, ("deny",)),
        }
    if match.kind == "demand":
        return _held(world, f"demand '{name}'", lambda claim: claim.demand == name)
    if match.kind == "requester":
        return _held(world, f"requester '{name}'", lambda claim: name in claim.requesters)
    if match.kind == "appdef":
        return _held(
            world,
            config.appdefs[name].description,
            lambda claim: claim.is_on_application and claim.application.appdef == name,
        )
    if match.kind == "node":
        node, domain = config.nodes[name], config.domain_of.get(name)
        claims = [claim for claim in world.ledger if name in nodes_of(claim)]
        claims.sort(key=lambda claim: (str(claim.subject), claim.demand))
        running = [release for release in release_causes.releases(world) if release.node.id == name]
        return {
            "runs": bool(running or claims),
            "what": f"{node.type} in cluster {node.cluster}, access domain "
            f"{domain.name if domain else 'none'}{', drained' if node.drained else ''}",
            **_claims(claims, world),
            "releases": [release_data(release) for release in running],
        }
    if match.kind == "override":
        override = config.overrides[name]
        report = override_report(world, REAL.now())
        (entry,) = (entry for entry in report if entry.override == override)
        effects = ", ".join(effect_words(override_data(override)))
        return {
            "runs": entry.state == "in force",
            "state": entry.state,
            "what": f"{effects}, of {override.owner}: {override.reason}",
            **_claims([*entry.claims], world),
            "releases": [release_data(release) for release in affected_releases(entry, world)],
        }
    return {"runs": False}


def _held(world: World, what: str, is_held: Callable[[Claim], bool]) -> Json:
    claims = sorted(
        filter(is_held, world.ledger), key=lambda claim: (str(claim.subject), claim.demand)
    )
    needed = {
        release.name: release
        for claim in claims
        for release in release_causes.releases(world, claim.subject)
    }
    return {
        "runs": any(suspended_by(claim, world) is None for claim in claims),
        "what": what,
        **_claims(claims, world),
        "releases": [release_data(release) for _, release in sorted(needed.items())],
    }


def _claims(claims: list[Claim], world: World) -> Json:
    rows = []
    for claim in claims:
        suspended = suspended_by(claim, world)
        kept = world.config.overrides.get(claim.keeping_override or "")
        rows.append(
            json_output.claim_data(claim)
            | {
                "release_by": release_causes.how_to_release(claim),
                "overdue": claim.lease is not None and claim.lease.has_ended(REAL.now()),
                "kept_by": override_data(kept, ("keep",)) if kept else None,
                "suspended_by": override_data(suspended, ("deny",)) if suspended else None,
            }
        )
    return {
        "requesters": sorted({who for claim in claims for who in claim.requesters}),
        "claims": rows,
    }


def _commits(repo: Reader, snapshot: Snapshot, match: Match, most: int) -> Json:
    history = PathHistory(None, (), 0, None)
    if match.kind == "demand":
        if about := demand_commits(repo, snapshot, match.name):  # else the history was made anew
            *newer, first = about
            held = ("demand", match.name) in snapshot.state.ledger.index
            stopped = None if held or not newer else newer.pop(0)
            more = max(len(newer) - most, 0)
            history = PathHistory(first, tuple(newer[:most]), more, stopped)
    elif match.kind not in ("node", "requester"):  # `demandops log` lists their commits
        history = repo.history(match.path, str(snapshot.commit), most)

    def row(entry: LogEntry | None) -> Json | None:
        if entry is None:
            return None
        behind = repo.person_commits_behind(entry, most=5)
        return commit_data(entry) | {"carries_out": [commit_data(commit) for commit in behind]}

    return {
        "started": row(history.started),
        "changes": [row(entry) for entry in history.newest],
        "more_changes": history.more,
        "stopped": row(history.stopped),
    }
