"""``demandops resume``: end an override that ``demandops suspend`` made."""

from __future__ import annotations

import click

from demandops.cli.actions.override import end_override
from demandops.cli.actions.person_change import (
    Edit,
    EditOptions,
    editing,
    selecting,
    selector,
    writable,
)
from demandops.cli.actions.suspend import described, name_of, selects
from demandops.cli.name_completion import names_of
from demandops.errors import InvalidInput


@click.command()
@click.argument("name", required=False, metavar="[NAME]", shell_complete=names_of("overrides"))
@selecting
@editing
def resume(name: str | None, options: EditOptions, **selected: tuple[str, ...]) -> None:
    """Run suspended applications and connections again.

    Give the same selection as for `demandops suspend`, such as --requester vehicle00, or NAME, the
    override's name. The command ends this override.

    \b
    Examples:
      demandops resume --requester vehicle00
      demandops resume suspend-vehicle00-1c2f3a
    """
    if bool(name) == bool(selector(selected)):
        raise click.UsageError(
            "give either the options of `demandops suspend`, or the override's name"
        )
    summary = f"Resume {name or described(selected)}"
    edit = Edit(name or name_of(selected), None, summary, options.reason)
    with writable(options.state_repo, options.signing_key, dry_run=options.dry_run) as repo:
        overrides = repo.last_valid_snapshot(repo.commit()).state.config.overrides
        override = overrides.get(edit.name)
        # a person may have changed what the file selects since it was suspended
        if override and not name and not selects(override, selected):
            message = f"selects something else; to end it, run: demandops resume {edit.name}"
            raise InvalidInput.at("select", message, file=edit.path)
        end_override(repo, edit, options)
