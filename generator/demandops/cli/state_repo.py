"""Commands about a state repo as a whole: ``init``, ``upgrade``, ``verify`` and ``journal``."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import click

from demandops.base import settings
from demandops.base.errors import StateRepoError, fault
from demandops.base.runtime import REAL
from demandops.cli import target
from demandops.cli.authoring import schema
from demandops.cli.formats import output_option, show
from demandops.cli.output import busy, done, errors
from demandops.render.gitops import bootstrap_path, domains_by_cluster
from demandops.repo import new_repo, reader
from demandops.repo import upgrade as upgrading
from demandops.repo.git.signing import Signer
from demandops.repo.upgrade import Upgrade
from demandops.serve.journal import drop as drop_demand
from demandops.serve.journal import find_journals
from demandops.templating.evaluator import processor_time
from demandops.views.vocabulary import Json

# ---- ``demandops init``: a new state repo ----


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
    help="Create a bare repository, for `serve` and `demand` on this machine. Without this "
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
@target.signing_option
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
    """The first commit has the files that people edit, with the fleet that --example names. To make
    a cluster follow the state repo, install Flux or Argo CD on the cluster (docs/flux.md,
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
    done.append(f"state repo in {directory}")
    data = {"directory": str(directory), "commit": commit, "gitops": gitops, "bare": bare}
    lines = [f"state repo in {directory}, first commit {commit[:10]} on main"]
    if not url:
        way = "set the url for the clusters in demandops.yaml"
        lines.append(f"no cluster can follow the state repo yet: {way}")
    else:
        file = f"bootstrap/{'c-its' if example == 'experiment' else 'CLUSTER'}.yaml"
        way = f"git -C {directory} show main:{file} | kubectl apply -f -"
        lines.append(f"to make a cluster follow the state repo: {way}")
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


# ---- ``demandops upgrade``: render everything again ----

_MOST_PATHS = 50
_SWITCH = (
    "a change of controller needs steps on the clusters, before and after: docs/argocd.md, "
    "'From Flux to Argo CD, and back'"
)


@click.command()
@target.writable_repo_option
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
@target.dry_run_option
@click.option(
    "--yes",
    is_flag=True,
    help="Do not ask whether the steps before a change of controller are done.",
)
@target.signing_option
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
    """Use this command when a new version of demandops renders differently, because a generator
    refuses a state repo of another render version. Also use it to change between Flux and Argo CD.
    Such a change needs steps on the clusters, before and after: docs/argocd.md lists them. If no
    file changes, the command makes no commit.

    \b
    Examples:
      demandops upgrade --dry-run
      demandops upgrade --gitops argocd
    """
    asks = gitops is not None and not yes and output == "text" and sys.stdin.isatty()
    now = REAL.now()
    signer = Signer(signing_key) if signing_key and not dry_run else None
    if dry_run or asks:
        with busy("reading the ledger") as report:
            result = upgrading.plan(state_repo, gitops, url, now, report)
    if asks and not dry_run and result.switches:
        show(output, None, [_SWITCH])
        if not click.confirm("Are those before it done?"):
            raise click.ClickException("nothing was changed; do these steps first, or give --yes")
    if not dry_run:
        with busy("reading the ledger") as report:
            result = upgrading.upgrade(state_repo, gitops, url, now, report, signer)
            done.extend([f"upgraded in {result.commit}"] if result.files else [])
    old, new = result.old.repo_settings, result.new.repo_settings
    outcome = "unchanged" if not result.files else "would-change" if dry_run else "upgraded"
    data: Json = {
        "outcome": outcome,
        "commit": result.commit,
        "render_version": {"from": old.render_version, "to": new.render_version},
        "gitops": {"from": old.gitops, "to": new.gitops},
        "written": [path for path, text in result.files.items() if text is not None],
        "removed": [path for path, text in result.files.items() if text is None],
        "after": [
            {
                "cluster": cluster,
                "what": "apply the cluster's bootstrap file again, because the file changed",
                "commands": [f"git show main:{path} | kubectl apply -f -"],
            }
            for cluster in domains_by_cluster(result.new)
            if (path := bootstrap_path(cluster)) in result.files
        ],
    }
    show(output, data, _upgrade_lines(result, data["after"], dry_run))


def _upgrade_lines(result: Upgrade, steps: list[Json], dry_run: bool) -> Iterator[str]:
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
    if steps:
        yield "\nafter the upgrade, on the clusters:"
    for step in steps:
        yield f"- {step['cluster']}: {step['what']}"
        yield from (f"      {command}" for command in step["commands"])


# ---- ``demandops verify``: render commits again and compare ----


@click.command()
@click.argument("revisions", required=False, metavar="[REV|A..B]")
@target.state_repo_option
@click.option(
    "--whole",
    is_flag=True,
    help="Load and render each commit completely. Without this option, each commit between the "
    "first and the last is verified by its differences from the commit before it.",
)
@output_option
def verify(revisions: str | None, state_repo: str, whole: bool, output: str) -> None:
    """REV names one commit, A..B the commits after A up to B; default: the newest commit. REV, A
    and B are commits or times. Once the state repo has policy/allowed-signers, each further commit
    of the generator must have a good signature. The version of this file in the commit's parent
    must list the signing key (docs/audit.md). People's commits are skipped: nothing proves who made
    them, unless they are signed. The exit code is 1 if a commit fails, or if none is verified.

    \b
    Examples:
      demandops verify
      demandops verify 1d..main
      demandops verify main --whole
    """
    # what was rendered once must not fail here because this machine is slower
    with (
        processor_time(each=60),
        reader.opened(state_repo) as repo,
        busy("rendering again") as report,
    ):
        verdicts = repo.verify(repo.revisions(revisions), whole=whole, progress=report)
    rows, lines = list[Json](), list[str]()
    for verdict in verdicts:
        row = {name: None if value == "" else value for name, value in asdict(verdict).items()}
        message = row.pop("fault")
        rows.append(row | {"faults": [asdict(fault("", message))] if message else []})
        word = "skipped" if verdict.skipped else "verified"
        if not verdict.holds:
            differs = verdict.fault or verdict.differing or verdict.touched
            word = "DIFFERS" if differs else "UNSIGNED"
        note = f" ({verdict.skipped})" if verdict.skipped else ""
        lines.append(f"{verdict.commit[:10]} {word}{note}  {verdict.summary}")
        if message:
            lines.append(f"    the ledger of this commit can no longer be rendered: {message}")
        lines += (f"    {path}" for path in verdict.differing)
        lines += (f"    {path} (this commit must not change it)" for path in verdict.touched)
        if verdict.signature:
            lines.append(f"    it {verdict.signature}")
    skipped = sum(bool(verdict.skipped and verdict.holds) for verdict in verdicts)
    verified = sum(verdict.holds for verdict in verdicts) - skipped
    note = f", {skipped} skipped" if skipped else ""
    number = verified or (skipped and "NONE")  # which must not look like success
    lines.append(f"{number} of {len(verdicts)} commits are verified{note}")
    good = sum(bool(verdict.signer) for verdict in verdicts)
    if signed := sum(verdict.signed for verdict in verdicts):
        listed = f", {good} by keys that policy/allowed-signers lists" if good else ""
        lines.append(f"{signed} of {len(verdicts)} are signed{listed}")
    if verdicts and good < len(verdicts):
        lines.append(
            f"not proven: who made {len(verdicts) - good} of them, whose signatures are not "
            "checked; to see at the next audit that none was rewritten: "
            f"git merge-base --is-ancestor {verdicts[-1].commit} main"
        )
    show(output, rows, lines)
    if not all(verdict.holds for verdict in verdicts) or (verdicts and not verified):
        raise click.exceptions.Exit(1)


# ---- ``demandops journal``: accepted demands that are yet to be published ----

# How long a running generator is waited for, which gives up a demand.
_DROP_S = 15.0


@click.command()
@target.writable_repo_option
@click.option(
    "--set-aside",
    is_flag=True,
    help="Rename journals that are damaged, so that the generator starts without them. A journal "
    "that a running generator uses keeps its name.",
)
@click.option(
    "--drop",
    metavar="ID",
    help="Give up the demand with this operation id. If a generator runs, it answers the demand's "
    "requester.",
)
@output_option
def journal(state_repo: str, set_aside: bool, drop: str | None, output: str) -> None:
    """A generator on this machine accepted these demands. If it still runs, it carries them out.
    Otherwise the next generator that starts here for the state repo does. If a journal is damaged,
    no generator starts, because the journal may lack demands. In this case, use --set-aside, and
    send again the listed demands that are still needed. --output json prints their goals. A demand
    that shall not be carried out is given up with --drop.

    \b
    Examples:
      demandops journal
      demandops journal --set-aside
      demandops journal --drop 5e0c1b0e-6d7f-4a39-9d4f-0f6f0c1f7a52
    """
    folder = settings.data_home(state_repo)
    if drop is not None:
        request, end = drop_demand(folder, drop), REAL.monotonic() + _DROP_S
        while request and request.exists() and REAL.monotonic() < end:
            REAL.sleep(0.1)
        outcome = "dropped" if not request else "requested" if request.exists() else "answered"
        text = {
            "dropped": "is given up; if its generator died after the push, it is booked, which "
            "`demandops log` shows",
            "answered": "has its answer from the generator that runs, whose log has it too",
            "requested": "is given up by the generator that runs as soon as the state repo shows "
            "that no push of it has arrived",
        }
        data = {"operation_id": drop, "outcome": outcome}
        show(output, data, [f"demand {drop} {text[outcome]}"])
        return
    journals = list(find_journals(folder, REAL.now(), set_aside=set_aside))
    rows, lines = [], []
    for each in journals:
        row: Json = {
            "file": str(each.file),
            "faults": [asdict(fault("", each.damage))] if each.damage else [],
            "set_aside": str(each.set_aside) if each.set_aside else None,
            "demands": [],
        }
        rows.append(row)
        for ticket in each.demands:
            of_ticket = {"operation_id": ticket.operation, "received": ticket.received.isoformat()}
            row["demands"].append(of_ticket | {"goal": ticket.demand.goal})
            lines.append("{operation_id}  received {received}".format(**of_ticket))
        if each.set_aside:
            lines.append(f"the damaged journal {each.file} is now called {each.set_aside}")
        elif each.damage:
            errors.print(f"error: {each.damage}")
    number = sum(len(each.demands) for each in journals)
    what = "demand is" if number == 1 else "demands are"
    show(output, rows, [*lines, f"{number} {what} accepted and not published"])
    if any(each.damage and not each.set_aside for each in journals):
        raise click.exceptions.Exit(1)
