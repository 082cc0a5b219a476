"""``demandops init`` and ``verify``: the state repo itself."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

import click

from generator.cli.output import (
    console,
    output_option,
    print_json,
    progress,
    state_repo_option,
)
from generator.staterepo import layout, reader


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
@output_option
def init(directory: Path, gitops: str, bare: bool, url: str, output: str) -> None:
    """Lay down a new state repo: the skeleton, the application definitions and a first commit.

    To make a cluster follow it, with Flux or Argo CD installed there (docs/flux.md,
    docs/argocd.md say how):

        git -C DIR show main:bootstrap/CLUSTER.yaml | kubectl apply -f -
    """
    commit = layout.init(directory, datetime.now(timezone.utc), bare=bare, gitops=gitops, url=url)
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


@click.command()
@click.argument("revisions", required=False, metavar="[REV|A..B]")
@state_repo_option
@output_option
def verify(revisions: str | None, state_repo: str, output: str) -> None:
    """Render the ledger of commits again and compare the bytes with what was committed."""
    verdicts = []
    with reader.opened(state_repo) as repo, progress("rendering again") as tell:
        commits = repo.revisions(revisions)
        for done, commit in enumerate(commits):
            tell(done, len(commits))
            verdicts.append(repo.verify(commit))
    broken = [verdict for verdict in verdicts if not verdict.holds]
    if output == "json":
        print_json(
            [
                {
                    "commit": verdict.commit,
                    "summary": verdict.summary,
                    "holds": verdict.holds,
                    "skipped": verdict.skipped or None,
                    "fault": verdict.fault or None,
                    "differing": list(verdict.differing),
                }
                for verdict in verdicts
            ]
        )
    else:
        out = console()
        for verdict in verdicts:
            word = "skipped" if verdict.skipped else "holds" if verdict.holds else "DIFFERS"
            note = f" ({verdict.skipped})" if verdict.skipped else ""
            out.print(f"{verdict.commit[:10]} {word}{note}  {verdict.summary}")
            if verdict.fault:
                out.print(f"    its books cannot be rendered any more: {verdict.fault}")
            for path in verdict.differing:
                out.print(f"    {path}")
        skipped = sum(bool(verdict.skipped) for verdict in verdicts)
        hold = len(verdicts) - len(broken) - skipped
        note = f", {skipped} skipped" if skipped else ""
        out.print(f"{hold} of {len(verdicts)} commits hold{note}")
    if broken:
        click.get_current_context().exit(1)
