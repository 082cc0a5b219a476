"""``demandops reconcile``: wake the controllers of clusters, which fetch the state repo then."""

from __future__ import annotations

from pathlib import Path

import click

from demandops.base.errors import InvalidInput, suggestion
from demandops.cli.json_output import output_option, show
from demandops.cli.output import busy, errors
from demandops.cli.target import clusters_option, state_repo_option
from demandops.cluster import clusters_file
from demandops.cluster.reconcile_trigger import ReconcileTrigger
from demandops.repo import reader


@click.command()
@click.argument("cluster", required=False, metavar="[CLUSTER]")
@click.option("--all", "every", is_flag=True, help="Wake the controllers of all clusters.")
@state_repo_option
@clusters_option
@output_option
def reconcile(
    cluster: str | None, every: bool, state_repo: str, access_file: Path | None, output: str
) -> None:
    """Let Flux or Argo CD fetch now, and not at its next interval.

    The controller is woken as --clusters says: by its webhook, or by the cluster's API.

    \b
    Examples:
      demandops reconcile c-its --clusters clusters.yaml
      demandops reconcile --all --clusters clusters.yaml
    """
    if every is (cluster is not None):
        raise click.UsageError("name one CLUSTER, or give --all")
    if access_file is None:
        raise click.UsageError("give --clusters FILE, which says how to reach the clusters")
    known = clusters_file.read(access_file).clusters
    if cluster is not None and cluster not in known:
        message = f"has no cluster '{cluster}'{suggestion(cluster, known)}"
        raise InvalidInput.at("clusters", message, file=str(access_file))
    chosen = known if cluster is None else {cluster: known[cluster]}
    with reader.opened(state_repo) as repo:
        config, commit = repo.config(), repo.commit()
    # a person asks, so that also what is not woken after each push is woken
    woken = {name: access.model_copy(update={"wake": True}) for name, access in chosen.items()}
    why = dict[str, str]()
    trigger = ReconcileTrigger(woken, lambda since: (commit, None), tell=why.__setitem__)
    with busy("waking the clusters"):
        trigger(config)
        trigger.close()
    failed = {
        name: why.get(name, "its controller is busy, and fetches at its next interval")
        for name in sorted(trigger.not_woken())
    }
    rows = [{"cluster": name, "reason": failed.get(name)} for name in sorted(chosen)]
    show(output, rows, [f"{name} is woken" for name in sorted(chosen) if name not in failed])
    for name, reason in failed.items():
        errors.print(f"error: cluster '{name}' was not woken: {reason}")
    if failed:
        raise click.exceptions.Exit(1)
