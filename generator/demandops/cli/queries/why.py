"""``demandops why``: all that explains why something runs or ran; ``may``: and whether it may."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import asdict

import click

from demandops.base.errors import suggestion
from demandops.base.naming import Subject, SubjectKind
from demandops.base.runtime import REAL
from demandops.cli.formats import output_formats, output_option, show
from demandops.cli.output import at_option, busy, errors, fitted, terminal_width
from demandops.cli.queries.commits import loaded
from demandops.cli.target import name_options, names_of, state_repo_option
from demandops.decide.decision import may_demand
from demandops.model.config.base_model import duration_text
from demandops.repo import reader
from demandops.repo.write.proposal_branch import pending_proposals
from demandops.views.source import Source
from demandops.views.vocabulary import Json, decision_text, time_text
from demandops.views.why import KINDS, explain, find

# What a state means, in a sentence about the thing.
_STATES = {
    **{"runs": "runs", "denied": "does not run", "held": "holds claims"},
    **{"waiting": "waits for room", "proposed": "awaits approval", "rejected": "was rejected"},
    **{"used": "is used", "unused": "is not used", "approved": "was approved"},
    **{"exists": "exists", "matches nothing": "has no effect now"},
}
_GONE = {
    **dict.fromkeys(("release", "application", "connection"), "does not run"),
    **{"demand": "holds nothing", "requester": "has left"},
    **dict.fromkeys(("file", "claim"), "no longer exists"),
}
_OF_RELEASES = {"demand": "needs", "requester": "needs", "override": "applies to"}


def lines_of(answer: Json) -> Iterator[str]:  # noqa: PLR0912 - a part each
    kind, state = answer["kind"], answer["state"]
    phrase = _STATES.get(state, f"is {state}")
    phrase = _GONE.get(kind, phrase) if state == "gone" else phrase
    yield f"{kind} {answer['name']} {phrase} at {answer['commit'][:10]}"
    for also in answer["also"]:
        yield f"  also        {also} {answer['name']}: --kind {also}"
    if answer.get("what") and state != "gone":
        yield f"  what        {answer['what']}"
    if state in ("gone", "rejected") and (last := answer["stopped"]):
        yield f"  since       {time_text(last['time'])}, by {last['author']}: {last['summary']}"
        held = [f"application {id}" for id in last["applications"]]
        held += [f"connection {id}" for id in last["connections"]]
        if held and state == "gone":
            yield f"  held        {', '.join(held)}"
    for proposal in answer["proposals"]:
        yield f"  proposed    {proposal['branch']}: {proposal['summary']}"
        reasons = ", ".join(proposal["required_by"])
        since = f"since {time_text(proposal['since'])} by {proposal['author']}"
        yield f"    {since}{f'; approval is required by {reasons}' if reasons else ''}"
        yield f"    to answer it: demandops approve|reject {proposal['branch']} -m REASON"
    if answer["runs"] and "node" in answer:
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
    for release in answer.get("releases", ()):
        word = _OF_RELEASES.get(answer["kind"], "runs")
        yield f"  {word:11} {release['name']} on {release['node']}"
    if answer.get("claims"):
        yield "requested by"
        yield from (line for claim in answer["claims"] for line in _claim_lines(claim))
    if answer.get("shaped_by"):
        yield "configured by"
        for place in answer["shaped_by"]:
            at = f" {place['entry']}" if place["entry"] else ""
            yield f"  {place['file']}{at}: {place['what']}"
    if answer.get("overrides"):
        yield "overridden by"
        yield from (f"  {_override_text(override)}" for override in answer["overrides"])
    if answer["stopped"]:
        yield "rejected by" if answer["state"] == "rejected" else "stopped by"
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


def _claim_lines(claim: Json) -> Iterator[str]:
    lease, subject = claim["lease"], f"{claim['subject']['kind']} '{claim['subject']['id']}'"
    until = f", lease of {duration_text(lease['seconds'])}" if lease else ""
    if lease:
        until += f" until {time_text(lease['until'])}" if lease["until"] else ", not started"
    if claim["state"] == "overdue":
        until += ", which has passed; a generator has yet to release the claim"
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
        # the requester's way, and a person's
        command = shlex.join(["demandops", "release", claim["demand"]])
        yield f"    to release it: {claim['release_by']}, or run: {command}"


def _override_text(override: Json) -> str:
    until = f", until {time_text(override['until'])}" if override["until"] else ""
    return (
        f"{override['file']}: {', '.join(override['effects'])} (priority "
        f"{override['priority']}{until}), of {override['owner']}: {override['reason']}"
    )


def _commit_lines(entry: Json, *, why: bool) -> Iterator[str]:
    when, word = time_text(entry["time"]), entry["operation"] or "by hand"
    yield f"  {entry['commit'][:10]} {when}  {word}, {entry['author']}: {entry['summary']}"
    if entry["why"] and (why or not entry["operation"]):  # a person's reason is nowhere else
        yield f"    {entry['why']}"
    if entry["decision"]:
        yield f"    {decision_text(entry['decision'])}"
    for each in entry["carries_out"]:
        yield f"    carries out commit {each['commit'][:10]} of {each['author']}: {each['summary']}"


# ---- the commands ----


@click.command()
@click.argument(
    "name", metavar="NAME|PATH", shell_complete=names_of(*(f"{kind}s" for kind in KINDS))
)
@state_repo_option
@at_option
@click.option(
    "--kind",
    type=click.Choice(KINDS),
    metavar="KIND",
    help=f"The kind of the thing, if several have the name: {', '.join(KINDS)}.",
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
@output_formats("text", "json", "yaml", "jsonpath=…")
def why(
    name: str, state_repo: str, at: str | None, kind: str | None, most: int, output: str
) -> None:
    """The command shows the requesters, the configuration and overrides that apply, open proposals,
    who approved or rejected, and the commits. NAME is the name of a thing of any kind that --kind
    lists. A part of a release's name or the start of a demand's id is enough if no other release or
    demand has it. PATH is a file in a folder of the state repo, such as clusters/ or ledger/. If
    something is gone, the command shows since when, who ended it, and what it held.

    \b
    Examples:
      demandops why od-edge-vehicle00
      demandops why fusion
      demandops why vehicle00/edge --at 14:03
      demandops why edge --kind node
    """
    with reader.opened(state_repo) as repo:
        snapshot = loaded(repo, at)
        proposals = () if at else tuple(pending_proposals(repo.repository))
        source = Source.read(repo, snapshot, is_newest=not at, proposals=proposals)
        with busy("looking through the commits"):
            answer = explain(source, find(source, name, kind), most)
    show(output, answer, (fitted(line, terminal_width()) for line in lines_of(answer)))


@click.command()
@click.argument("requester", metavar="REQUESTER", shell_complete=names_of("requesters"))
@click.argument("verb", type=click.Choice(["demand"]), metavar="demand")
@click.argument("application", metavar="APPLICATION", shell_complete=names_of("appdefs"))
@name_options({"node": "On this node. Default: on any."}, metavar="NODE", default="")
@click.option("--version", metavar="VERSION", default="", help="In this version.")
@state_repo_option
@output_option
def may(
    requester: str,
    verb: str,
    application: str,
    node: str,
    version: str,
    state_repo: str,
    output: str,
) -> None:
    """APPLICATION is an application definition, or an application that is demanded now. The answer
    is that of policy, quotas and overrides; it does not look for room on the node. The exit code is
    0 for yes, and 1 for no.

    \b
    Examples:
      demandops may vehicle07 demand object-detection-fusion
      demandops may vehicle07 demand object-detection-fusion --node edge
    """
    with reader.opened(state_repo) as repo:
        state = repo.snapshot().state
    appdef = application
    claimed = state.ledger.first_claim(Subject(SubjectKind.APPLICATION, application))
    if claimed and application not in state.config.appdefs:
        appdef, node = claimed.application.appdef, node or claimed.application.node
    answer = may_demand(requester, appdef, node, version, state, REAL.now())
    what = f"{requester} may {verb} {application} on {answer.node}"
    if answer.faults:
        lines = [f"no: {each.message}" for each in answer.faults]
    elif answer.approval:
        lines = [f"yes, once a person approves it: {what}"]
        lines += [f"  {reason} requires the approval" for reason in answer.approval]
    else:
        lines = [f"yes: {what}"]
        for rule in answer.rules:
            alone = "; without it, a person would have to approve"
            lines.append(f"  {rule} allows it{alone if rule in answer.approved_by else ''}")
    known = {*state.config.nodes, *state.ledger.indexed_names("requester")}
    if requester not in known and not state.config.has_node(requester):
        unknown = f"no node is called '{requester}', and nobody of this name demands anything now"
        errors.print(f"note: {unknown}{suggestion(requester, known)}")
    data = {"requester": requester, "application": application, "allowed": not answer.faults}
    faults = [asdict(each) for each in answer.faults]
    show(output, data | asdict(answer) | {"faults": faults}, lines)
    if answer.faults:
        raise click.exceptions.Exit(1)
