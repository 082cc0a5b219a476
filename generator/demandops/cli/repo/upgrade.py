"""``demandops upgrade``: render with this version, or for the other GitOps controller."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from demandops.cli.json_output import Json, output_option, show
from demandops.cli.output import Progress, busy
from demandops.cli.target import dry_run_option, signing_option, writable_repo_option
from demandops.render.gitops.paths import bootstrap_path, domains_by_cluster
from demandops.runtime import REAL
from demandops.staterepo import upgrade as upgrading
from demandops.staterepo.git.signing import Signer
from demandops.staterepo.upgrade import Upgrade, UpgradeRequest

_MOST_PATHS = 50
_SWITCH = (
    "a change of controller needs steps on the clusters, before and after: docs/argocd.md, "
    "'From Flux to Argo CD, and back'"
)


@click.command()
@writable_repo_option
@click.option(
    "--gitops",
    type=click.Choice(["flux", "argocd"]),
    help="The controller that reads the state repo from now on. Default: the current one.",
)
@click.option(
    "--url",
    metavar="URL",
    help="The URL (https or ssh) from which the new controller fetches the state repo, if "
    "demandops.yaml has no section for this controller yet. Default: the URL of the current "
    "controller.",
)
@dry_run_option
@click.option(
    "--yes",
    is_flag=True,
    help="Do not ask whether the steps before a change of controller are done.",
)
@signing_option
@output_option
def upgrade(
    state_repo: str,
    gitops: str | None,
    url: str | None,
    dry_run: bool,
    yes: bool,
    signing_key: Path | None,
    output: str,
) -> None:
    """Render everything again, in one commit.

    Use this command when a new version of demandops renders differently, because a generator
    refuses a state repo of another render version. Also use it to change between Flux and Argo CD.
    Such a change needs steps on the clusters, before and after: docs/argocd.md lists them. If no
    file changes, the command makes no commit.

    \b
    Examples:
      demandops upgrade --dry-run
      demandops upgrade --gitops argocd
    """
    request = UpgradeRequest(gitops, url)
    asks = gitops is not None and not yes and output == "text" and sys.stdin.isatty()
    now = REAL.now()
    signer = Signer(signing_key) if signing_key and not dry_run else None
    if dry_run or asks:
        with _shown() as report:
            result = upgrading.plan(state_repo, request, now, report)
    if asks and not dry_run and result.switches:
        show(output, None, [_SWITCH])
        if not click.confirm("Are those before it done?"):
            raise click.ClickException("nothing was changed; do these steps first, or give --yes")
    if not dry_run:
        with _shown() as report:
            result = upgrading.upgrade(state_repo, request, now, report, signer)
    old, new = result.old.repo_settings, result.new.repo_settings
    outcome = "unchanged" if not result.files else "would-change" if dry_run else "upgraded"
    data = {
        "outcome": outcome,
        "commit": result.commit,
        "render_version": {"from": old.render_version, "to": new.render_version},
        "gitops": {"from": old.gitops, "to": new.gitops},
        "written": [path for path, text in result.files.items() if text is not None],
        "removed": [path for path, text in result.files.items() if text is None],
        "after": _steps_after(result),
    }
    show(output, data, _lines(result, dry_run))


@contextmanager
def _shown() -> Iterator[Progress]:
    with busy("reading the state repo") as say:

        def report(done: int, total: int) -> None:
            read = f"reading the ledger, {done} of {total} files"
            say(read if done < total else "rendering everything")

        yield report


def _steps_after(result: Upgrade) -> list[Json]:
    return [
        {
            "cluster": cluster,
            "what": "apply the cluster's bootstrap file again, because the file changed",
            "commands": [f"git show main:{path} | kubectl apply -f -"],
        }
        for cluster in domains_by_cluster(result.new)
        if (path := bootstrap_path(cluster)) in result.files
    ]


def _lines(result: Upgrade, dry_run: bool) -> Iterator[str]:
    old, new = result.old.repo_settings, result.new.repo_settings
    if not result.files:
        yield (
            f"nothing to do: at {result.commit}, everything is rendered for {new.gitops} with "
            f"render version {new.render_version}"
        )
        return
    written = sum(text is not None for text in result.files.values())
    done = f"would write {written} and remove" if dry_run else f"wrote {written} and removed"
    yield f"{done} {len(result.files) - written} files"
    if old.render_version != new.render_version:
        yield f"render version {old.render_version} → {new.render_version}"
    if result.switches:
        yield f"gitops {old.gitops} → {new.gitops}"
        if getattr(old, new.gitops) is None:
            yield f"{new.gitops}.url {getattr(new, new.gitops).url}"
    if not dry_run:
        yield f"in commit {result.commit}"
    for path, text in list(result.files.items())[:_MOST_PATHS] if dry_run else ():
        yield f"  {'remove' if text is None else 'write '} {path}"
    if dry_run and len(result.files) > _MOST_PATHS:
        yield f"  and {len(result.files) - _MOST_PATHS} more (--output json lists all)"
    if result.switches:
        yield f"\n{_SWITCH}"
    if steps := _steps_after(result):
        yield "\nafter the upgrade, on the clusters:"
    for step in steps:
        yield f"- {step['cluster']}: {step['what']}"
        yield from (f"      {command}" for command in step["commands"])
