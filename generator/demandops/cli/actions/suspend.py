"""``demandops suspend``: stop applications and connections by an override that denies them."""

from __future__ import annotations

import click

from demandops import naming
from demandops.cli.actions.override import create_override, ends_at, new_override
from demandops.cli.actions.person_change import (
    Edit,
    EditOptions,
    editing,
    selecting,
    selector,
    writable,
)
from demandops.config.override import Override


def name_of(selected: dict[str, tuple[str, ...]]) -> str:
    """Return the name of the override for a selection; equal selections get the same name."""
    chosen = sorted((kind, sorted(values)) for kind, values in selector(selected).items())
    words = "-".join(value for _, values in chosen for value in values)
    return "suspend-" + naming.slug_with_hash(words, repr(chosen), 6)


def selects(override: Override, selected: dict[str, tuple[str, ...]]) -> bool:
    """Return whether an override has this selection, and not another one with the same name."""
    selectors = [each.model_dump(exclude_none=True) for each in override.select]
    return [{kind: {*values} for kind, values in each.items()} for each in selectors] == [
        {kind: {*values} for kind, values in selector(selected).items()}
    ]


@click.command()
@selecting
@click.option(
    "--expires",
    metavar="TIME",
    help="When the suspension ends: 2h, 3d, or a time like 2027-01-31T18:00:00Z.",
)
@editing
def suspend(expires: str | None, options: EditOptions, **selected: tuple[str, ...]) -> None:
    """Stop applications and connections; their claims stay booked.

    Nothing runs for these claims, and new demands that match the options are refused. To end the
    suspension, give `demandops resume` the same selection, such as --requester vehicle00. The
    command creates an override with `deny` in your own name.

    \b
    Examples:
      demandops suspend --requester vehicle00 -m "In the workshop"
      demandops suspend --application 'edge/*' --expires 2h -m "Service"
      demandops suspend --connection vehicle00/edge -m "Too much data" --propose
    """
    effect = {"expires": ends_at(expires), "deny": True}
    with writable(options.state_repo, options.signing_key, dry_run=options.dry_run) as repo:
        name = name_of(selected)
        text = new_override(repo, name, options, selected, effect)
        edit = Edit(name, text, f"Suspend {described(selected)}", options.reason)
        create_override(repo, edit, options)


def described(selected: dict[str, tuple[str, ...]]) -> str:
    """Return a selection as text, such as ``node edge, requester vehicle00``."""
    return ", ".join(
        f"{kind.removesuffix('s')} {value}"
        for kind, values in selector(selected).items()
        for value in values
    )
