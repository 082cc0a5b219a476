"""``demandops completion``: a script with which a shell completes commands, options and names."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

from demandops.cli.output import print_lines

VARIABLE = "_DEMANDOPS_COMPLETE"


@click.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]), metavar="bash|zsh|fish")
def completion(shell: str) -> None:
    """Print the completion script for a shell.

    The script completes commands, options, and names in the state repo, such as those of demands,
    nodes, releases, requesters, proposals and overrides. The names come from the state repo on
    which the completed command would work. If this state repo is behind a URL, the script fetches
    nothing, but reads the commit that was fetched last.

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
