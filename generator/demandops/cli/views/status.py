"""``demandops status``: the state of each release on its cluster."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import click

from demandops.cli.json_output import Json, output_option, release_data, show, version_data
from demandops.cli.output import (
    busy,
    duration,
    errors,
    progress,
    version_lines,
    warn_of_not_rendered,
)
from demandops.cli.table import Column, Table
from demandops.cli.target import clusters_option, state_repo_option
from demandops.cluster import access
from demandops.cluster.bootstrap_status import OldBootstrap, old_bootstraps
from demandops.cluster.health import health_reader
from demandops.cluster.health.release_health import ClusterDomain, ObjectSelector
from demandops.cluster.object_cache import ObjectCache
from demandops.cluster.release_status import ReleaseStatus, statuses
from demandops.errors import suggestion
from demandops.plan.overrides.claim_overrides import without_suspended
from demandops.plan.views.missing_inputs import MissingInput, missing_inputs
from demandops.runtime import REAL
from demandops.service import rollout_targets
from demandops.staterepo import reader
from demandops.staterepo.load.problem_report import Problem
from demandops.staterepo.reader import Reader

_SHORT = 10


_POLL_S = 2.0


@click.command()
@state_repo_option
@clusters_option
@click.option(
    "--wait",
    is_flag=True,
    help="Wait until every release is healthy and no file is invalid, or --timeout has passed.",
)
@click.option(
    "--timeout",
    metavar="DURATION",
    default="10m",
    show_default=True,
    callback=duration,
    help="How long --wait waits: 90s, 10m or 1h30m.",
)
@output_option
def status(
    state_repo: str, access_file: Path | None, wait: bool, timeout: int, output: str
) -> None:
    """Show the state of each release on its cluster.

    That is the commit that the cluster has applied, and the health of the release. The exit code
    is 1 if a file is invalid or waits for a generator, or if a cluster with a kubeconfig in
    --clusters has an old bootstrap file or a release that is not healthy. A cluster without one is
    unknown, which is no fault.

    \b
    Examples:
      demandops status --clusters clusters.yaml
      demandops status --wait --timeout 5m
      demandops status -o json
    """
    clusters = access.read(access_file).clusters if access_file else {}
    if wait and not any(cluster.kubeconfig for cluster in clusters.values()):
        raise click.UsageError(
            "--wait needs --clusters FILE with a kubeconfig: without one the state is unknown"
        )
    with reader.opened(state_repo) as repo:
        found = Status.of(repo, clusters)
        if wait:
            found = _healthy(repo, clusters, found, timeout)
    show(output, found.data(), found.text())
    warn_of_not_rendered(found.not_rendered)
    for missing in dict.fromkeys((one.application, one.reason) for one in found.missing_inputs):
        errors.print(f"warning: application '{missing[0]}': {missing[1]}")
    for name in clusters.keys() - found.clusters:
        errors.print(
            f"warning: --clusters: no release runs on a cluster '{name}'"
            f"{suggestion(name, found.clusters)}"
        )
    if not clusters and output == "text":
        errors.print("the state of the clusters is unknown: give --clusters FILE (docs/status.md)")
    if amiss := found.amiss(clusters):
        errors.print(f"not well: {amiss}")
        raise click.exceptions.Exit(1)


def _healthy(
    repo: Reader, clusters: Mapping[str, access.ClusterAccess], found: Status, timeout: int
) -> Status:
    """Wait until all releases are healthy or the time has passed; return the last status."""
    end, told = REAL.monotonic() + timeout, ""
    while (amiss := found.amiss(clusters)) and REAL.monotonic() < end:
        if amiss != told:
            errors.print(f"waiting: {amiss}")
            told = amiss
        REAL.sleep(_POLL_S)
        repo.refresh()
        found = Status.of(repo, clusters)
    return found


@dataclass(frozen=True, slots=True)
class Status:
    """What clusters and generator report at one commit; ``rows`` are the releases as JSON."""

    commit: str
    rows: list[Json]
    problems: tuple[Problem, ...]
    clusters: frozenset[str]
    not_rendered: frozenset[str]
    old_bootstraps: tuple[OldBootstrap, ...]
    missing_inputs: tuple[MissingInput, ...]

    @classmethod
    def of(cls, repo: Reader, clusters: Mapping[str, access.ClusterAccess]) -> Status:
        """Return the current status of all releases."""
        problems = repo.problems()
        with progress("reading the ledger") as report:
            snapshot = repo.snapshot(progress=report)
        targets = rollout_targets.targets_of_state(snapshot.state)
        domains = rollout_targets.domains_of_state(snapshot.state)
        stores = _read(clusters, {*domains, *(target.domain for _, target in targets)})
        old = tuple(old_bootstraps(domains, stores, repo.file_reader(str(snapshot.commit))))
        commit = str(snapshot.commit)
        ledger = without_suspended(snapshot.state).ledger
        found = statuses([target for _, target in targets], commit, stores, repo.repository)
        rows = [
            release_data(release) | version_data(release, ledger) | _state(each)
            for (release, _), each in zip(targets, found, strict=True)
        ]
        missing = tuple(missing_inputs(snapshot.state))
        known = frozenset(snapshot.state.config.clusters)
        return cls(commit, rows, problems, known, repo.not_rendered(snapshot), old, missing)

    def amiss(self, clusters: Mapping[str, access.ClusterAccess]) -> str:
        """Return how many problems and unhealthy releases there are, as text; empty if none."""
        readable = {name for name, cluster in clusters.items() if cluster.kubeconfig}
        watched = [row for row in self.rows if row["cluster"] in readable]
        failing = sum(row["failing"] for row in watched)
        healthy = sum(row["health"] == "healthy" for row in watched)
        counts = {
            "problems in files": len(self.problems),
            "files that a generator has yet to write": len(self.not_rendered),
            "clusters with an old bootstrap file": len(self.old_bootstraps),
            "releases failing": failing,
            "releases not healthy yet": len(watched) - failing - healthy,
        }
        return ", ".join(f"{what}: {count}" for what, count in counts.items() if count)

    def data(self) -> Json:
        """Return the status as JSON data."""
        faults = [{"code": "invalid", **asdict(problem)} for problem in self.problems]
        return {
            "commit": self.commit,
            "releases": self.rows,
            "not_rendered": sorted(self.not_rendered),
            "old_bootstraps": [asdict(each) for each in self.old_bootstraps],
            "missing_inputs": [asdict(each) for each in self.missing_inputs],
            "faults": faults,
        }

    def text(self) -> list[str | Table]:
        """Return the status as text and a table."""
        text: list[str | Table] = [f"  {problem}" for problem in self.problems]
        if self.problems:
            count = len(self.problems)
            title = "1 problem" if count == 1 else f"{count} problems"
            text.insert(0, f"{title}; of each file the last valid version is in effect:")
        old = map(str, self.old_bootstraps)
        return [*text, releases_table(self.rows), *old, f"desired: {self.commit}"]


def _read(
    clusters: Mapping[str, access.ClusterAccess], domains: Iterable[ClusterDomain]
) -> dict[str, ObjectCache]:
    """Return the objects of each cluster; read all at once, so that none delays the others."""
    wanted: dict[str, dict[ObjectSelector, None]] = {}
    for domain in domains:
        watched = health_reader(domain).objects_to_watch(domain)
        wanted.setdefault(domain.cluster, {}).update(dict.fromkeys(watched))
    stores = {
        name: ObjectCache(name, cluster, lambda: None)
        for name, cluster in clusters.items()
        if cluster.kubeconfig and name in wanted
    }
    threads = [
        REAL.start_thread(f"read-{name}", partial(store.read_once, wanted[name]))
        for name, store in stores.items()
    ]
    with busy("asking the clusters"):
        for thread in threads:
            thread.join()
    return stores


def _state(found: ReleaseStatus) -> Json:
    return {
        "seen": found.seen or None,
        "health": found.state,
        "since": found.since or None,
        "failing": found.health.failing,
        "object": found.health.object or None,
        "reason": found.health.reason or None,
    }


_COLORS = {"failing": "red", "healthy": "green", "unknown": "yellow", "waiting": "yellow"}
_COLUMNS = (
    Column("Release"),
    Column("Health", 0),
    Column("Seen", 2),
    Column("Node", 4),
    Column("Reason", 1, wraps=True),
    Column("Since", 5),
    Column("Version", 6),
    Column("What", 8),
    Column("Cluster", 7),
)


def releases_table(rows: Iterable[Json]) -> Table:
    """Return releases, given as JSON data, as a table."""
    cells = [
        (
            row["name"],
            "failing" if row["failing"] else row["health"],
            (row["seen"] or "")[:_SHORT],
            row["node"],
            f"{row['object']}: {row['reason']}" if row["object"] else row["reason"] or "",
            row["since"] or "",
            version_lines(row),
            row["what"].partition(" on ")[0],
            row["cluster"],
        )
        for row in rows
    ]
    return Table(_COLUMNS, cells, styles=_COLORS)
