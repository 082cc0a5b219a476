"""``demandops status``: the state of each release on its cluster."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import click
from rich.table import Table

from demandops.cli.json_output import output_option, release_data, show, version_data
from demandops.cli.output import errors, progress, state_repo_option, version_text
from demandops.cluster import access
from demandops.cluster.health import health_reader
from demandops.cluster.health.release_health import Health, History, ObjectSelector, Target
from demandops.cluster.object_cache import ObjectCache
from demandops.plan.overrides.claim_overrides import without_suspended
from demandops.runtime import REAL
from demandops.service import rollout_targets
from demandops.staterepo import reader

_SHORT = 10


@click.command()
@state_repo_option
@click.option(
    "--clusters",
    "access_file",
    envvar="DEMANDOPS_CLUSTERS",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="How to reach the clusters; see docs/status.md [env: DEMANDOPS_CLUSTERS].",
)
@output_option
def status(state_repo: str, access_file: Path | None, output: str) -> None:
    """Show the state of each release on its cluster.

    That is the commit that the cluster has applied, and the health of the release.
    """
    clusters = access.read(access_file).clusters if access_file else {}
    with reader.opened(state_repo) as repo:
        problems = repo.problems()
        with progress("reading the ledger") as report:
            snapshot = repo.snapshot(progress=report)
        targets = rollout_targets.targets_of_state(snapshot.state)
        stores = _read(clusters, [target for _, target in targets])
        commit = str(snapshot.commit)
        ledger = without_suspended(snapshot.state).ledger
        rows = [
            release_data(release)
            | version_data(release, ledger)
            | _state(target, commit, stores, repo.repository)
            for release, target in targets
        ]
    faults = [{"code": "invalid", **asdict(problem)} for problem in problems]
    text: list[str | Table] = [f"  {problem}" for problem in problems]
    if problems:
        count = "1 problem" if len(problems) == 1 else f"{len(problems)} problems"
        text.insert(0, f"{count}; of each file the last valid version is in effect:")
    text += [_table(rows), f"desired: {commit}"]
    show(output, {"commit": commit, "releases": rows, "faults": faults}, text)
    if not clusters and output == "text":
        errors.print("the state of the clusters is unknown: give --clusters FILE")


def _read(
    clusters: Mapping[str, access.ClusterAccess], targets: Iterable[Target]
) -> dict[str, ObjectCache]:
    """Read all clusters at the same time, so that an unreachable one does not delay the others."""
    wanted: dict[str, dict[ObjectSelector, None]] = {}
    for target in targets:
        watched = health_reader(target.domain).objects_to_watch(target.domain)
        wanted.setdefault(target.domain.cluster, {}).update(dict.fromkeys(watched))
    stores = {
        name: ObjectCache(name, cluster, lambda: None)
        for name, cluster in clusters.items()
        if cluster.kubeconfig and name in wanted
    }
    threads = [
        REAL.start_thread(f"read-{name}", partial(store.read_once, wanted[name]))
        for name, store in stores.items()
    ]
    for thread in threads:
        thread.join()
    return stores


def _state(
    target: Target, commit: str, stores: Mapping[str, ObjectCache], history: History
) -> dict[str, Any]:
    store, seen, when = stores.get(target.domain.cluster), "", ""
    unread = store.unread(target.domain) if store else None
    if store is None:
        health = Health("waiting", "no access to this cluster")
    elif unread:
        health = unread
    else:
        read, objects = health_reader(target.domain), store.objects()
        health = read.health(target, commit, objects, history)
        seen = read.applied_commit(target.domain, objects)
        when = read.last_transition(target, objects)
    return {
        "seen": seen or None,
        "health": health.state if seen or health.object else "unknown",
        "since": when or None,
        "failing": health.failing,
        "object": health.object or None,
        "reason": health.reason or None,
    }


def _table(rows: Iterable[dict[str, Any]]) -> Table:
    table = Table(
        "Release", "What", "Version", "Node", "Cluster", "Seen", "Health", "Since", "Reason"
    )
    for row in rows:
        reason = f"{row['object']}: {row['reason']}" if row["object"] else row["reason"] or ""
        table.add_row(
            row["name"],
            row["what"].partition(" on ")[0],
            version_text(row),
            row["node"],
            row["cluster"],
            (row["seen"] or "")[:_SHORT],
            "failing" if row["failing"] else row["health"],
            row["since"] or "",
            reason,
        )
    return table
