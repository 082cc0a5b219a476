"""``demandops may``: may a requester demand an application, and what decides?"""

from __future__ import annotations

from dataclasses import asdict

import click

from demandops.base.naming import Subject, SubjectKind
from demandops.base.runtime import REAL
from demandops.cli.json_output import output_option, show
from demandops.cli.target import names_of, state_repo_option
from demandops.decide.decision import may_demand
from demandops.repo import reader


@click.command()
@click.argument("requester", metavar="REQUESTER", shell_complete=names_of("requesters"))
@click.argument("verb", type=click.Choice(["demand"]), metavar="demand")
@click.argument("application", metavar="APPLICATION", shell_complete=names_of("appdefs"))
@click.option(
    "--node",
    metavar="NODE",
    default="",
    shell_complete=names_of("nodes"),
    help="On this node. Default: on any.",
)
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
    """Say whether a requester may demand an application, and why.

    APPLICATION is an application definition, or an application that is demanded now. The answer is
    that of policy, quotas and overrides; it does not look for room on the node. The exit code is 0
    for yes, and 1 for no.

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
        lines += [f"  {rule} allows it" for rule in answer.rules]
    data = {"requester": requester, "application": application, "allowed": not answer.faults}
    faults = [asdict(each) for each in answer.faults]
    show(output, data | asdict(answer) | {"faults": faults}, lines)
    if answer.faults:
        raise click.exceptions.Exit(1)
