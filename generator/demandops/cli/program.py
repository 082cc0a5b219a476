"""Commands about the program itself: ``version``, ``completion`` and ``config``."""

from __future__ import annotations

import platform
import shutil
import subprocess
from pathlib import Path

import click
from click.shell_completion import get_completion_class

from demandops import __version__
from demandops.base import settings
from demandops.base.runtime import REAL
from demandops.cli import target
from demandops.cli.formats import Table, output_option, show
from demandops.cli.output import print_lines
from demandops.cli.target import context_names
from demandops.model.config.base_model import parse
from demandops.views.rows import Column

# ---- ``demandops version`` ----


@click.command()
@output_option
def version(output: str) -> None:
    """The render version says how the program renders the files in `clusters/`. A generator refuses
    a state repo of another render version. If the repo's version is older, run `demandops upgrade`;
    if it is newer, update the generator.

    \b
    Examples:
      demandops version
      demandops version -o json
    """
    git = None
    if shutil.which("git"):
        told = subprocess.run(["git", "--version"], capture_output=True, text=True, check=False)
        git = told.stdout.strip().removeprefix("git version ") or None
    data = {
        "version": __version__,
        "render_version": settings.RENDER_VERSION,
        "api_version": settings.API_VERSION,
        "ledger_api_version": settings.LEDGER_API_VERSION,
        "python": platform.python_version(),
        "git": git,
    }
    words = {name: "demandops" if name == "version" else name.replace("_", " ") for name in data}
    show(output, data, [f"{words[name]:18} {value}" for name, value in data.items()])


# ---- ``demandops completion`` ----

VARIABLE = "_DEMANDOPS_COMPLETE"


@click.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]), metavar="bash|zsh|fish")
def completion(shell: str) -> None:
    """The script completes commands, options, and names in the state repo, such as those of
    demands, nodes, releases, requesters, proposals and overrides. The names come from the state
    repo on which the completed command would work. If this state repo is behind a URL, the script
    fetches nothing, but reads the commit that was fetched last.

    \b
    Examples:
      demandops completion bash > /etc/bash_completion.d/demandops
      demandops completion zsh > ~/.zfunc/_demandops
      demandops completion fish > ~/.config/fish/completions/demandops.fish
    """
    root = click.get_current_context().find_root().command
    completion_class = get_completion_class(shell)
    assert completion_class is not None  # noqa: S101 - click has these three
    maker = completion_class(root, {}, "demandops", VARIABLE)
    code = maker.source_template % maker.source_vars()  # source() would start bash
    print_lines(code.rstrip("\n").split("\n"))


# ---- ``demandops config``: the contexts in the user's config folder ----

_name = click.argument("name", metavar="NAME", shell_complete=context_names)


@click.group()
def config() -> None:
    """A context names a state repo, the access to its clusters and a signing key, so that commands
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
    data = target.read_contexts().model_dump(by_alias=True, include={"current", "contexts"})
    columns = [Column("current", ""), Column("name", "Context"), Column("stateRepo", "State repo")]
    columns += [Column("clusters", "Clusters", 1), Column("signingKey", "Signing key", 2)]
    contexts = [
        {"name": name, "current": "*" if name == data["current"] else "", **context}
        for name, context in data["contexts"].items()
    ]
    empty = "no contexts; see demandops config set"
    cells = [[column.texts(each, REAL.now()) for column in columns] for each in contexts]
    show(output, data, [Table(columns, cells, empty=empty)])


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
    content = target.read_contexts()
    options = {"stateRepo": state_repo, "clusters": clusters, "signingKey": signing_key}
    data = content.model_dump(by_alias=True, exclude_none=True)
    given = {field: _absolute(value) for field, value in options.items() if value is not None}
    data["contexts"][name] = {**data["contexts"].get(name, {}), **given}
    if "stateRepo" not in data["contexts"][name]:
        raise click.UsageError(f"the context '{name}' is new, so give --state-repo")
    data.setdefault("current", name)
    target.write_contexts(parse(target.ContextsFile, data, str(target.contexts_file())))
    show("text", None, [f"context '{name}' set in {target.contexts_file()}"])


def _absolute(place: str) -> str:
    # other text, such as a URL, stays as it is
    path = Path(place).expanduser()
    return str(path.resolve()) if path.exists() else place


@config.command("use")
@_name
def use_context(name: str) -> None:
    """Choose the current context.

    \b
    Examples:
      demandops config use fleet
    """
    target.context_named(name)
    target.write_contexts(target.read_contexts().model_copy(update={"current": name}))
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
    target.context_named(name)
    content = target.read_contexts()
    others = {key: context for key, context in content.contexts.items() if key != name}
    current = None if content.current == name else content.current
    target.write_contexts(content.model_copy(update={"contexts": others, "current": current}))
    show("text", None, [f"context '{name}' deleted"])
