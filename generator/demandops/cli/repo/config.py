"""``demandops config``: the contexts in the user's config folder."""

from __future__ import annotations

from pathlib import Path

import click

from demandops.cli import contexts
from demandops.cli.json_output import output_option, show
from demandops.cli.table import Column, Table
from demandops.cli.target import context_names
from demandops.config.base_model import parse

_name = click.argument("name", metavar="NAME", shell_complete=context_names)


@click.group()
def config() -> None:
    """List, set and choose contexts: the fleets that you work with.

    A context names a state repo, the access to its clusters and a signing key, so that commands
    need no options. The contexts are in ~/.config/demandops/contexts.yaml. $XDG_CONFIG_HOME
    replaces ~/.config.

    \b
    Examples:
      demandops config set fleet --state-repo https://git.example/fleet.git
      demandops config use fleet
      demandops config list
    """


@config.command("list")
@output_option
def list_contexts(output: str) -> None:
    """List the contexts.

    \b
    Examples:
      demandops config list
    """
    content = contexts.read()
    rows = [
        (
            "*" if name == content.current else "",
            name,
            context.state_repo,
            context.clusters or "",
            context.signing_key or "",
        )
        for name, context in content.contexts.items()
    ]
    columns = (
        Column(""),
        Column("Context"),
        Column("State repo"),
        Column("Clusters", 1),
        Column("Signing key", 2),
    )
    data = content.model_dump(by_alias=True, include={"current", "contexts"})
    show(output, data, [Table(columns, rows, empty="no contexts; see demandops config set")])


@config.command("set")
@_name
@click.option("--state-repo", metavar="URL_OR_DIR", help="The state repo.")
@click.option(
    "--clusters",
    metavar="FILE",
    help="The file that says how to reach the clusters (docs/status.md).",
)
@click.option("--signing-key", metavar="FILE", help="The key that signs commits (docs/audit.md).")
def set_context(
    name: str, state_repo: str | None, clusters: str | None, signing_key: str | None
) -> None:
    """Add or change a context.

    If there is no current context, this one becomes the current context. Options that you leave out
    keep their values. Paths that exist become absolute.

    \b
    Examples:
      demandops config set fleet --state-repo ssh://git@git.example/fleet.git
      demandops config set fleet --clusters clusters.yaml
    """
    content = contexts.read()
    options = {
        "stateRepo": _absolute(state_repo),
        "clusters": _absolute(clusters),
        "signingKey": _absolute(signing_key),
    }
    data = content.model_dump(by_alias=True, exclude_none=True)
    given = {field: value for field, value in options.items() if value is not None}
    data["contexts"][name] = {**data["contexts"].get(name, {}), **given}
    if "stateRepo" not in data["contexts"][name]:
        raise click.UsageError(f"the context '{name}' is new, so give --state-repo")
    data.setdefault("current", name)
    contexts.write(parse(contexts.ContextsFile, data, str(contexts.path())))
    show("text", None, [f"context '{name}' set in {contexts.path()}"])


def _absolute(place: str | None) -> str | None:
    """Return the absolute form of a path that exists; return other text, such as a URL, as is."""
    if place is None or not Path(place).expanduser().exists():
        return place
    return str(Path(place).expanduser().resolve())


@config.command("use")
@_name
def use_context(name: str) -> None:
    """Choose the current context.

    \b
    Examples:
      demandops config use fleet
    """
    contexts.named(name)
    contexts.write(contexts.read().model_copy(update={"current": name}))
    show("text", None, [f"the current context is '{name}'"])


@config.command("delete")
@_name
def delete_context(name: str) -> None:
    """Delete a context; nothing happens to its state repo.

    If it is the current context, there is no current context afterwards.

    \b
    Examples:
      demandops config delete old-fleet
    """
    contexts.named(name)
    content = contexts.read()
    others = {key: context for key, context in content.contexts.items() if key != name}
    current = None if content.current == name else content.current
    contexts.write(content.model_copy(update={"contexts": others, "current": current}))
    show("text", None, [f"context '{name}' deleted"])
