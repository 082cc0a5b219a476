"""``demandops init``: a new state repo."""

from __future__ import annotations

from pathlib import Path

import click

from demandops.base.errors import StateRepoError
from demandops.base.runtime import REAL
from demandops.cli.json_output import output_option, show
from demandops.cli.output import busy
from demandops.cli.repo import schema
from demandops.cli.target import signing_option
from demandops.repo import new_repo
from demandops.repo.git.signing import Signer


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
    help="Create a bare repository, for `serve` and `request` on this machine. Without this "
    "option, the files are checked out in DIR, so that you can push them to a Git server.",
)
@click.option(
    "--url",
    default="",
    metavar="URL",
    help="The URL (https or ssh, or git@host:path) from which the clusters fetch the state repo. "
    "The command writes this URL to demandops.yaml, where you can change it. Without a URL, no "
    "cluster can follow the state repo yet.",
)
@click.option(
    "--example",
    type=click.Choice(["experiment", "none"]),
    default="experiment",
    show_default=True,
    help="The fleet to begin with: the paper's experiment with its application, or none.",
)
@signing_option
@output_option
def init(
    directory: Path,
    *,
    gitops: str,
    bare: bool,
    url: str,
    example: str,
    signing_key: Path | None,
    output: str,
) -> None:
    """Create a state repo.

    The first commit has the files that people edit, with the fleet that --example names.
    To make a cluster follow the state repo, install Flux or Argo CD on the cluster (docs/flux.md,
    docs/argocd.md) and run:

        git -C DIR show main:bootstrap/CLUSTER.yaml | kubectl apply -f -

    \b
    Examples:
      demandops init fleet.git --bare
      demandops init fleet --gitops argocd --url https://git.example/fleet.git
    """
    if gitops == "argocd" and not url:
        raise StateRepoError(
            "--gitops argocd needs --url, because all manifests for Argo CD name the URL from "
            "which the clusters fetch the state repo: --url https://HOST/PATH or "
            "--url git@HOST:PATH"
        )
    with busy("creating the state repo"):
        commit = new_repo.init(
            directory,
            REAL.now(),
            bare=bare,
            gitops=gitops,
            url=url,
            example=example == "experiment",
            schemas={name: schema.text(name) for name in schema.SCHEMAS},
            signer=Signer(signing_key) if signing_key else None,
        )
    data = {"directory": str(directory), "commit": commit, "gitops": gitops, "bare": bare}
    lines = [f"state repo in {directory}, first commit {commit[:10]} on main"]
    if not url:
        lines.append(
            "no cluster can follow the state repo yet: "
            "set the url for the clusters in demandops.yaml"
        )
    else:
        cluster = "c-its" if example == "experiment" else "CLUSTER"
        lines.append(
            f"to make a cluster follow the state repo: git -C {directory} show "
            f"main:bootstrap/{cluster}.yaml | kubectl apply -f -"
        )
    if bare:
        lines.append(f"to see or edit the files of the state repo: git clone {directory}")
    if example == "none":
        where = ", in the clone" if bare else ""
        lines += [
            f"to add a fleet{where}: edit the files in inventory/, and run",
            "      demandops new application (--help has examples); then check, commit and push",
        ]
    if bare:
        lines.append(f"next: demandops serve --state-repo {directory}")
    else:
        lines += [
            "next: edit inventory/ and policy/, commit, push to your Git server, and run",
            "      demandops serve --state-repo URL",
        ]
    show(output, data, lines)
