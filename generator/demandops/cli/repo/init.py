"""``demandops init``: the state repo itself."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

import click

from demandops.cli.output import console, output_option, print_json, signing_option
from demandops.staterepo import new_repo
from demandops.staterepo.git.signing import Signer


@click.command()
@click.argument("directory", type=click.Path(path_type=Path), metavar="DIR")
@click.option(
    "--gitops",
    type=click.Choice(["flux", "argocd"]),
    default="flux",
    show_default=True,
    help="The controller that reads the state repo.",
)
@click.option(
    "--bare",
    is_flag=True,
    help="Make a bare repository, which `serve` and `request` use in place. Without it DIR has the "
    "files checked out, ready to be pushed to a Git server.",
)
@click.option(
    "--url",
    default="",
    metavar="URL",
    help="Where the clusters will fetch the state repo from (https or ssh); it stands in "
    "demandops.yaml and can be changed there.",
)
@signing_option
@output_option
def init(
    directory: Path, gitops: str, bare: bool, url: str, signing_key: Path | None, output: str
) -> None:
    """Lay down a new state repo: the skeleton, the application definitions and a first commit.

    To make a cluster follow it, with Flux or Argo CD installed there (docs/flux.md,
    docs/argocd.md say how):

        git -C DIR show main:bootstrap/CLUSTER.yaml | kubectl apply -f -
    """
    commit = new_repo.init(
        directory,
        datetime.now(timezone.utc),
        bare=bare,
        gitops=gitops,
        url=url,
        signer=Signer(signing_key) if signing_key else None,
    )
    if output == "json":
        print_json({"directory": str(directory), "commit": commit, "gitops": gitops, "bare": bare})
        return
    out = console()
    out.print(f"state repo in {directory}, first commit {commit[:10]} on main")
    out.print(
        f"a cluster follows it after: git -C {directory} show main:bootstrap/c-its.yaml | "
        "kubectl apply -f -"
    )
    if bare:
        out.print(f"next: demandops serve --state-repo {directory}")
        out.print(f"to see or edit its files: git clone {directory}")
    else:
        out.print("next: edit inventory/ and policy/, commit, push it to your Git server, and run")
        out.print("      demandops serve --state-repo URL")
