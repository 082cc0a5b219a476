"""``demandops journal``: accepted demands that generators on this machine have yet to publish."""

from __future__ import annotations

from dataclasses import asdict

import click

from demandops.base import settings
from demandops.base.errors import fault
from demandops.base.runtime import REAL
from demandops.cli.json_output import output_option, show
from demandops.cli.output import errors
from demandops.cli.target import writable_repo_option
from demandops.repo.write.journal import find_journals


@click.command()
@writable_repo_option
@click.option(
    "--set-aside",
    is_flag=True,
    help="Rename journals that are damaged, so that the generator starts without them. A journal "
    "that a running generator uses keeps its name.",
)
@output_option
def journal(state_repo: str, set_aside: bool, output: str) -> None:
    """List the accepted demands that are not published.

    A generator on this machine accepted these demands. If it still runs, it carries them out.
    Otherwise the next generator that starts here for the state repo does. If a journal is damaged,
    no generator starts, because the journal may lack demands. In this case, use --set-aside, and
    send again the listed demands that are still needed. --output json prints their goals.

    \b
    Examples:
      demandops journal
      demandops journal --set-aside
    """
    folder = settings.data_home(state_repo)
    journals = list(find_journals(folder, REAL.now(), set_aside=set_aside))
    rows, lines = [], []
    for each in journals:
        demands = [
            {"operation_id": demand.operation, "received": demand.received, "goal": demand.goal}
            for demand in each.demands
        ]
        rows.append(
            {
                "file": str(each.file),
                "faults": [asdict(fault("", each.damage))] if each.damage else [],
                "set_aside": str(each.set_aside) if each.set_aside else None,
                "demands": demands,
            }
        )
        lines += [f"{demand.operation}  received {demand.received}" for demand in each.demands]
        if each.set_aside:
            lines.append(f"the damaged journal {each.file} is now called {each.set_aside}")
    number = sum(len(each.demands) for each in journals)
    what = "demand is" if number == 1 else "demands are"
    show(output, rows, [*lines, f"{number} {what} accepted and not published"])
    damages = [each.damage for each in journals if each.damage and not each.set_aside]
    for damage in damages:
        errors.print(f"error: {damage}")
    if damages:
        raise click.exceptions.Exit(1)
