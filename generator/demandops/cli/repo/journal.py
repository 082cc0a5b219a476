"""``demandops journal``: accepted demands that generators on this machine have yet to publish."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import click

from demandops import settings
from demandops.cli.json_output import output_option, show
from demandops.cli.output import errors
from demandops.cli.target import writable_repo_option
from demandops.errors import fault
from demandops.runtime import REAL
from demandops.staterepo.write.slot import FoundJournal, find_journals


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
    now = REAL.now()
    found = list(find_journals(settings.data_home(state_repo), now, set_aside=set_aside))
    show(output, [_row(each) for each in found], _lines(found))
    damages = [each.damage for each in found if each.damage and not each.set_aside]
    for damage in damages:
        errors.print(f"error: {damage}")
    if damages:
        raise click.exceptions.Exit(1)


def _row(found: FoundJournal) -> dict[str, Any]:
    return {
        "file": str(found.file),
        "faults": [asdict(fault("", found.damage))] if found.damage else [],
        "set_aside": str(found.set_aside) if found.set_aside else None,
        "demands": [
            {"operation_id": each.operation, "received": each.received, "goal": each.goal}
            for each in found.demands
        ],
    }


def _lines(found: list[FoundJournal]) -> Iterator[str]:
    for each in found:
        for entry in each.demands:
            yield f"{entry.operation}  received {entry.received}"
        if each.set_aside:
            yield f"the damaged journal {each.file} is now called {each.set_aside}"
    number = sum(len(each.demands) for each in found)
    yield f"{number} {'demand is' if number == 1 else 'demands are'} accepted and not published"
