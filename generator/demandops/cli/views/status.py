"""``demandops status``: what the clusters have made of the desired state."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click
from rich.table import Table

from demandops.cli.output import (
    console,
    errors,
    output_option,
    print_json,
    progress,
    state_repo_option,
)
from demandops.cluster import access
from demandops.cluster.health import Health, Target, Watched, reading
from demandops.cluster.object_cache import ObjectCache
from demandops.plan.release import Release, ServiceRelease
from demandops.service import rollout_targets
from demandops.staterepo import reader
from demandops.staterepo.load.problem_report import Problem
from demandops.staterepo.reader import Reader

_SHORT = 10


@click.command()
@state_repo_option
@click.option(
    "--clusters",
    "access_file",
    envvar="DEMANDOPS_CLUSTERS",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="How the clusters are reached; see docs/status.md [env: DEMANDOPS_CLUSTERS].",
)
@output_option
def status(state_repo: str, access_file: Path | None, output: str) -> None:
    """Show for each release what is desired, what its cluster has seen, and how it is."""
    clusters = access.read(access_file).clusters if access_file else {}
    with reader.opened(state_repo) as repo:
        problems = repo.problems()
        with progress("reading the ledger") as tell:
            snapshot = repo.snapshot(progress=tell)
        found = rollout_targets.targets_of_state(snapshot.state)
        stores = _read(clusters, [target for _, target in found])
        commit = str(snapshot.commit)
        rows = [_row(release, target, commit, stores, repo) for release, target in found]
    if output == "json":
        told = [asdict(problem) for problem in problems]
        print_json({"commit": commit, "releases": rows, "problems": told})
        return
    _print_problems(problems)
    console().print(_table(rows))
    console().print(f"desired: {commit}")
    if not clusters:
        errors.print("no access to the clusters, so nothing is known of them: give --clusters FILE")


def _print_problems(problems: Iterable[Problem]) -> None:
    """Print what is not valid in the state repo, as the generator reported it there."""
    lines = [f"  {problem}" for problem in problems]
    if lines:
        console().print(f"{_counted(len(lines))}; of each file the last valid version is in force:")
    for line in lines:
        console().print(line, soft_wrap=True)


def _counted(number: int) -> str:
    return f"{number} problem{'s' if number > 1 else ''}"


def _read(
    clusters: Mapping[str, access.ClusterAccess], found: Iterable[Target]
) -> dict[str, ObjectCache]:
    """Read all clusters at once: one that is away holds up no other."""
    wanted: dict[str, dict[Watched, None]] = {}
    for target in found:
        watched = reading(target.place).watched(target.place)
        wanted.setdefault(target.place.cluster, {}).update(dict.fromkeys(watched))
    stores = {
        name: ObjectCache(name, reached, lambda: None)
        for name, reached in clusters.items()
        if reached.kubeconfig and name in wanted
    }
    with ThreadPoolExecutor(max(len(stores), 1)) as pool:
        list(pool.map(lambda store: store.read(wanted[store.name]), stores.values()))
    return stores


def _row(
    release: Release,
    target: Target,
    commit: str,
    stores: Mapping[str, ObjectCache],
    repo: Reader,
) -> dict[str, Any]:
    health, seen, when = _seen(target, commit, stores, repo)
    return {
        "release": target.name,
        "what": _what(release),
        "node": release.node.id,
        "cluster": target.place.cluster,
        "domain": target.place.domain,
        "seen": seen or None,
        "health": health.state if seen or health.object else "unknown",
        "since": when or None,
        "failing": health.failing,
        "object": health.object or None,
        "reason": health.reason or None,
    }


def _seen(
    target: Target, commit: str, stores: Mapping[str, ObjectCache], repo: Reader
) -> tuple[Health, str, str]:
    store = stores.get(target.place.cluster)
    if store is None:
        return Health("waiting", "no access to this cluster"), "", ""
    read = reading(target.place)
    unread = store.unread(read.watched(target.place))
    if unread:
        reason = f"cannot be read: {unread}"
        return Health("waiting", reason, f"cluster {store.name}"), "", ""
    objects = store.objects()
    health = read.of_place(target.place, commit, objects, repo)
    if health.state != "waiting":
        health = read.of_target(target, commit, objects, repo)
    return health, read.applied(target.place, objects), read.since(target, objects)


def _what(release: Release) -> str:
    if isinstance(release, ServiceRelease):
        return release.key.service
    return "connection"


def _table(rows: Iterable[dict[str, Any]]) -> Table:
    table = Table("Release", "What", "Node", "Cluster", "Seen", "Health", "Since", "Reason")
    for row in rows:
        reason = f"{row['object']}: {row['reason']}" if row["object"] else row["reason"] or ""
        table.add_row(
            row["release"],
            row["what"],
            row["node"],
            row["cluster"],
            (row["seen"] or "")[:_SHORT],
            "failing" if row["failing"] else row["health"],
            row["since"] or "",
            reason,
        )
    return table
