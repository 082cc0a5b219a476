"""``demandops why``: the requesters, configuration, overrides and commits behind what runs."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import click

from demandops.cli.json_output import (
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
from demandops.plan.release import Release
from demandops.plan.views import release_causes
from demandops.plan.views.demand_list import nodes_of
from demandops.plan.views.missing_inputs import missing_inputs
from demandops.plan.views.override_report import affected_releases, override_report
from demandops.runtime import REAL
from demandops.staterepo import reader
from demandops.staterepo.history.commit_log import LogEntry, PathHistory
from demandops.staterepo.load.snapshot import Snapshot
from demandops.staterepo.reader import Reader
from demandops.subject import Subject

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
            answer = _answer(repo, snapshot, match_of(repo, snapshot, name, kind), at, most)
    show(output, answer, why_text.lines_of(answer))


def _answer(
    repo: Reader, snapshot: Snapshot, match: Match, at: str | None, most: int
) -> dict[str, Any]:
    """Return the explanation as JSON data; ``most`` limits the list of changes."""
    answer: dict[str, Any] = {
        "commit": str(snapshot.commit),
        "kind": match.kind,
        "name": match.name,
    }
    if match.release is not None:
        answer |= _of_release(snapshot.state, match.release)
    elif match.subject is not None:
        answer |= _of_subject(snapshot.state, match.subject)
    elif match.kind in _DESCRIBED:
        answer |= _DESCRIBED[match.kind](snapshot.state, match.name)
    else:
        answer |= {"runs": False, **_denied(snapshot.state, match)}
    answer |= {"missing_inputs": _missing(snapshot.state, answer)}
    answer |= {"not_rendered": _not_rendered(repo, snapshot, answer, match) if not at else []}
    answer |= {"file": match.path or None, **_commits(repo, snapshot, match, most)}
    return answer


def _missing(world: World, answer: dict[str, Any]) -> list[str]:
    """Return the reasons why inputs of the applications in ``answer`` do not arrive."""
    files = {one["file"] for one in answer.get("claims", ())}
    found = (one for one in missing_inputs(world) if one.file in files)
    return list(dict.fromkeys(f"application '{one.application}': {one.reason}" for one in found))


def _not_rendered(
    repo: Reader, snapshot: Snapshot, answer: dict[str, Any], match: Match
) -> list[str]:
    """Return those files of ``answer`` that a generator has yet to write or remove.

    If there are such files, change the state ``in force`` in ``answer`` to ``not rendered yet``.
    """
    files = {match.path, *(one["file"] for one in answer.get("releases", ()))}
    found = sorted(files & repo.not_rendered(snapshot))
    if found and answer.get("state") == "in force":
        answer["state"] = "not rendered yet"
    return found


def _of_release(world: World, running: Release) -> dict[str, Any]:
    claims = release_causes.claims_behind(without_suspended(world).ledger, running)
    return {
        "runs": True,
        **place_data(running),
        **_claims(claims, world),
        "shaped_by": [
            {"file": file, "entry": entry or None, "what": what}
            for file, entry, what in release_causes.shaping_files(running, world.config)
        ],
        "overrides": [override_data(*each) for each in running.shaping.by],
    }


def _denied(world: World, match: Match) -> dict[str, Any]:
    """Return as JSON data which override denies a release, and where the release would run.

    Return an empty mapping if no override denies it.
    """
    if match.kind != "release":
        return {}
    name = match.path.rsplit("/", 1)[-1].removesuffix(".yaml")
    stopped = release_causes.denied_release_named(world, name)
    if stopped is None:
        return {}
    return {**place_data(stopped[0]), "denied_by": override_data(stopped[1], ("deny",))}


def _of_subject(world: World, claimed: Subject) -> dict[str, Any]:
    claims = sorted(world.ledger.claims_on(claimed), key=lambda claim: claim.booked)
    return {
        "runs": any(suspended_by(claim, world) is None for claim in claims),
        "what": _subject_text(claimed, claims),
        "subject": subject_data(claimed),
        **_claims(claims, world),
        "releases": [release_data(each) for each in release_causes.releases(world, claimed)],
    }


def _of_demand(world: World, id: str) -> dict[str, Any]:
    return _held(world, f"demand '{id}'", (one for one in world.ledger if one.demand == id))


def _of_requester(world: World, id: str) -> dict[str, Any]:
    return _held(world, f"requester '{id}'", (one for one in world.ledger if id in one.requesters))


def _of_appdef(world: World, name: str) -> dict[str, Any]:
    claims = (
        one for one in world.ledger if one.is_on_application and one.application.appdef == name
    )
    return _held(world, world.config.appdefs[name].description, claims)


def _of_override(world: World, name: str) -> dict[str, Any]:
    override = world.config.overrides[name]
    (entry,) = (one for one in override_report(world, REAL.now()) if one.override == override)
    return {
        "runs": entry.state == "in force",
        "state": entry.state,
        "what": f"{', '.join(effect_words(override_data(override)))}, of {override.owner}: "
        f"{override.reason}",
        **_claims([*entry.claims], world),
        "releases": [release_data(one) for one in affected_releases(entry, world)],
    }


def _held(world: World, what: str, held: Iterable[Claim]) -> dict[str, Any]:
    """Return JSON data on claims, and on the releases that these claims need."""
    claims = sorted(held, key=lambda claim: (str(claim.subject), claim.demand))
    needed = {
        one.name: one for claim in claims for one in release_causes.releases(world, claim.subject)
    }
    return {
        "runs": any(suspended_by(claim, world) is None for claim in claims),
        "what": what,
        **_claims(claims, world),
        "releases": [release_data(one) for _, one in sorted(needed.items())],
    }


def _of_node(world: World, id: str) -> dict[str, Any]:
    node, domain = world.config.nodes[id], world.config.domain_of.get(id)
    claims = [claim for claim in world.ledger if id in nodes_of(claim)]
    running = [one for one in release_causes.releases(world) if one.node.id == id]
    return {
        "runs": bool(running or claims),
        "what": f"{node.type} in cluster {node.cluster}, access domain "
        f"{domain.name if domain else 'none'}{', drained' if node.drained else ''}",
        **_claims(sorted(claims, key=lambda claim: (str(claim.subject), claim.demand)), world),
        "releases": [release_data(one) for one in running],
    }


_DESCRIBED = {
    "demand": _of_demand,
    "node": _of_node,
    "appdef": _of_appdef,
    "requester": _of_requester,
    "override": _of_override,
}


def _subject_text(subject: Subject, claims: list[Claim]) -> str:
    if not claims or claims[0].is_on_application:
        return str(subject)
    first = claims[0].connection
    word = first.type.word.upper() if first.type else ""
    return f"{word} {subject} from {first.source} to {first.target}".lstrip()


def _claims(claims: list[Claim], world: World) -> dict[str, Any]:
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


def _commits(repo: Reader, snapshot: Snapshot, match: Match, most: int) -> dict[str, Any]:
    """Return the commits that started, changed and stopped the object of ``match``.

    Return no commits for a node, a requester, and a demand that no commit names.
    """
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
    left = max(len(newer) - most, 0)
    return _history(repo, PathHistory(first, tuple(newer[:most]), left, stopped))


def _history(repo: Reader, history: PathHistory) -> dict[str, Any]:
    """Return commits as JSON data, each with the people's commits that it carries out."""

    def row(entry: LogEntry | None) -> dict[str, Any] | None:
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
