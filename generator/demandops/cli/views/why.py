"""``demandops why``: the requesters, configuration, overrides and commits behind what runs."""

from __future__ import annotations

from collections.abc import Callable

import click

from demandops.cli.json_output import (
    Json,
    claim_data,
    commit_data,
    output_option,
    override_data,
    place_data,
    release_data,
    show,
    subject_data,
)
from demandops.cli.name_completion import names_of
from demandops.cli.output import at_option, busy
from demandops.cli.target import state_repo_option
from demandops.cli.views import why_text
from demandops.cli.views.diff import loaded
from demandops.cli.views.kinds import effect_words
from demandops.cli.views.name_match import KINDS, Match, demand_commits, match_of
from demandops.demand.claim import Claim
from demandops.ledger.world import World
from demandops.plan.overrides.claim_overrides import suspended_by, without_suspended
from demandops.plan.views import release_causes
from demandops.plan.views.demand_list import nodes_of
from demandops.plan.views.missing_inputs import missing_inputs
from demandops.plan.views.override_report import affected_releases, override_report
from demandops.runtime import REAL
from demandops.staterepo import reader
from demandops.staterepo.history.commit_log import LogEntry, PathHistory
from demandops.staterepo.load.snapshot import Snapshot
from demandops.staterepo.reader import Reader

_MOST_CARRIED_OUT = 5


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
@output_option
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
    show(output, answer, why_text.lines_of(answer))


def _described(world: World, match: Match) -> Json:
    """Return as JSON data what the object of ``match`` is, and who needs it."""
    name, config = match.name, world.config
    if match.release is not None:
        release = match.release
        claims = release_causes.claims_behind(without_suspended(world).ledger, release)
        return {
            "runs": True,
            **place_data(release),
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
            "subject": subject_data(match.subject),
            **_claims(claims, world),
            "releases": [release_data(release) for release in releases],
        }
    if match.kind == "release":  # it does not run; perhaps an override denies it
        file_name = match.path.rsplit("/", 1)[-1].removesuffix(".yaml")
        denied = release_causes.denied_release_named(world, file_name)
        if denied is None:
            return {"runs": False}
        release, override = denied
        return {
            "runs": False,
            **place_data(release),
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
        running = [each for each in release_causes.releases(world) if each.node.id == name]
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
            claim_data(claim)
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
    if match.kind in ("node", "requester"):  # `demandops log` lists their commits
        return _history(repo, PathHistory(None, (), 0, None))
    if match.kind != "demand":
        return _history(repo, repo.history(match.path, str(snapshot.commit), most))
    about = demand_commits(repo, snapshot, match.name)
    if not about:  # the history was made anew
        return _history(repo, PathHistory(None, (), 0, None))
    *newer, first = about
    held = ("demand", match.name) in snapshot.state.ledger.index
    stopped = None if held or not newer else newer.pop(0)
    more = max(len(newer) - most, 0)
    return _history(repo, PathHistory(first, tuple(newer[:most]), more, stopped))


def _history(repo: Reader, history: PathHistory) -> Json:
    """Return commits as JSON data, each with the people's commits that it carries out."""

    def row(entry: LogEntry | None) -> Json | None:
        if entry is None:
            return None
        behind = repo.person_commits_behind(entry, _MOST_CARRIED_OUT)
        return commit_data(entry) | {"carries_out": [commit_data(each) for each in behind]}

    return {
        "started": row(history.started),
        "changes": [row(entry) for entry in history.newest],
        "more_changes": history.more,
        "stopped": row(history.stopped),
    }
