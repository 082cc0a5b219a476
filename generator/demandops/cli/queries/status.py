"""``demandops status``: the state of each release on its cluster."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import click

from demandops.base.errors import suggestion
from demandops.base.runtime import REAL
from demandops.cli.json_output import Json, output_option, release_data, show, version_data
from demandops.cli.output import (
    busy,
    errors,
    in_effect,
    progress,
    read_by,
    version_lines,
    warn_of_not_rendered,
)
from demandops.cli.table import Table, column, table_of
from demandops.cli.target import clusters_option, state_repo_option
from demandops.cluster import clusters_file, rollouts
from demandops.cluster.health import ObjectSelector, health_reader
from demandops.cluster.object_cache import ObjectCache
from demandops.cluster.release_status import OldBootstrap, Orphan, old_bootstraps, orphans, statuses
from demandops.decide.planning.overrides import without_suspended
from demandops.decide.warnings import MissingInput, missing_inputs
from demandops.model.config.base_model import duration_text, seconds_of
from demandops.repo import reader
from demandops.repo.git.repository import RemoteAway
from demandops.repo.load.snapshot import Problem
from demandops.repo.reader import Reader

_PATIENCE_S = 10


@click.command()
@state_repo_option
@clusters_option
@click.option(
    "--wait",
    is_flag=True,
    help="Wait until the exit code would be 0, or until --timeout has passed.",
)
@click.option(
    "--timeout",
    metavar="DURATION",
    default="10m",
    show_default=True,
    callback=read_by(seconds_of),
    help="How long --wait waits: 90s, 10m or 1h30m.",
)
@click.option(
    "--request-timeout",
    metavar="DURATION",
    default=duration_text(_PATIENCE_S),
    show_default=True,
    callback=read_by(seconds_of),
    help="How long a cluster may take to answer. All clusters are asked at the same time.",
)
@output_option
def status(
    state_repo: str,
    access_file: Path | None,
    *,
    wait: bool,
    timeout: int,
    request_timeout: int,
    output: str,
) -> None:
    """Show the state of each release on its cluster.

    The state is the commit that the cluster has applied, and the health of the release. The state
    of a cluster without a kubeconfig in --clusters is unknown.

    \b
    The exit code is 1 if
    - a file is invalid,
    - a generator has yet to write or remove a file, or
    - a cluster with a kubeconfig does not answer, or has an old bootstrap file,
      an object that belongs to no release, or a release that is not healthy.

    \b
    Examples:
      demandops status --clusters clusters.yaml
      demandops status --wait --timeout 5m
      demandops status -o json
    """
    clusters = clusters_file.read(access_file).clusters if access_file else {}
    if wait and not any(cluster.kubeconfig for cluster in clusters.values()):
        raise click.UsageError(
            "--wait needs --clusters FILE with a kubeconfig: without one the state is unknown"
        )
    with reader.opened(state_repo) as repo:
        status = Status.of(repo, clusters, request_timeout)
        end, told = REAL.monotonic() + timeout, ""
        while wait and (amiss := status.amiss(clusters)) and REAL.monotonic() < end:
            if amiss != told:
                errors.print(f"waiting: {amiss}")
                told = amiss
            REAL.sleep(2.0)
            try:
                repo.refresh()
            except RemoteAway as error:  # then the last fetched commit is shown
                errors.print(f"warning: {error}")
            status = Status.of(repo, clusters, request_timeout)
    show(output, status.data(), status.text())
    warn_of_not_rendered(status.not_rendered)
    for application, reason in dict.fromkeys(
        (missing.application, missing.reason) for missing in status.missing_inputs
    ):
        errors.print(f"warning: application '{application}': {reason}")
    for name, reason in status.unreadable.items():
        errors.print(f"warning: cluster '{name}' cannot be read: {reason}")
    for name in sorted(clusters.keys() - status.clusters):
        errors.print(
            f"warning: --clusters: the inventory has no cluster '{name}'"
            f"{suggestion(name, status.clusters)}"
        )
    if not clusters and output == "text":
        errors.print("the state of the clusters is unknown: give --clusters FILE (docs/status.md)")
    if amiss := status.amiss(clusters):
        errors.print(f"not well: {amiss}")
        raise click.exceptions.Exit(1)


@dataclass(frozen=True, slots=True)
class Status:
    commit: str
    rows: list[Json]  # the releases
    problems: tuple[Problem, ...]
    configuration: str  # the commit whose configuration is in effect
    in_effect: str  # the same for a person, if it is not that of the commit
    clusters: frozenset[str]
    not_rendered: frozenset[str]
    old_bootstraps: tuple[OldBootstrap, ...]
    orphans: tuple[Orphan, ...]
    missing_inputs: tuple[MissingInput, ...]
    unreadable: Mapping[str, str]  # the reason, by the name of the cluster

    @classmethod
    def of(
        cls,
        repo: Reader,
        clusters: Mapping[str, clusters_file.ClusterAccess],
        patience_s: int = _PATIENCE_S,
    ) -> Status:
        with progress("reading the ledger") as report:
            snapshot = repo.snapshot(progress=report)
        commit = str(snapshot.commit)
        releases = rollouts.targets_of_state(snapshot.state)
        targets = [target for _, target in releases]
        domains = rollouts.domains_of_state(snapshot.state)
        wanted: dict[str, dict[ObjectSelector, None]] = {}
        for domain in {*domains, *(target.domain for target in targets)}:
            watched = health_reader(domain).objects_to_watch(domain)
            wanted.setdefault(domain.cluster, {}).update(dict.fromkeys(watched))
        caches = {
            name: ObjectCache(name, cluster, lambda: None)
            for name, cluster in clusters.items()
            if cluster.kubeconfig and name in wanted
        }
        threads = {
            name: REAL.start_thread(f"read-{name}", partial(cache.read_once, wanted[name]))
            for name, cache in caches.items()
        }
        # all clusters are read at the same time, so that a slow cluster does not delay the others
        end = REAL.monotonic() + patience_s
        with busy("asking the clusters"):
            for name, thread in threads.items():
                thread.join(max(0.0, end - REAL.monotonic()))
                if thread.is_alive():
                    caches[name].give_up(f"it did not answer within {duration_text(patience_s)}")
        ledger = without_suspended(snapshot.state).ledger
        rows = [
            release_data(release)
            | version_data(release, ledger)
            | {
                "seen": reported.seen or None,
                "health": reported.state,
                "since": reported.since or None,
                "failing": reported.health.failing,
                "object": reported.health.object or None,
                "reason": reported.health.reason or None,
            }
            for (release, _), reported in zip(
                releases, statuses(targets, commit, caches, repo.repository), strict=True
            )
        ]
        reasons = {name: cache.why_unknown(wanted[name]) for name, cache in caches.items()}
        return cls(
            commit,
            rows,
            repo.problems_of(snapshot),
            str(snapshot.configuration),
            in_effect(repo, snapshot) if snapshot.faults else "",
            frozenset(snapshot.state.config.clusters),
            repo.not_rendered(snapshot),
            tuple(old_bootstraps(domains, caches, repo.file_reader(commit))),
            tuple(orphans(domains, targets, commit, caches, repo.repository)),
            tuple(missing_inputs(snapshot.state)),
            {name: reason for name, reason in sorted(reasons.items()) if reason},
        )

    def amiss(self, clusters: Mapping[str, clusters_file.ClusterAccess]) -> str:
        """Return a text that counts everything that is wrong; empty if nothing is wrong."""
        # of the releases, only those on clusters with a kubeconfig count
        readable = {name for name, cluster in clusters.items() if cluster.kubeconfig}
        watched = [row for row in self.rows if row["cluster"] in readable]
        failing = sum(row["failing"] for row in watched)
        healthy = sum(row["health"] == "healthy" for row in watched)
        counts: dict[str, int | str] = {
            "problems in files": len(self.problems),
            "files that a generator has yet to write or remove": len(self.not_rendered),
            "clusters with an old bootstrap file": len(self.old_bootstraps),
            "objects that belong to no release": len(self.orphans),
            "releases failing": failing,
            "releases not healthy yet": len(watched) - failing - healthy,
            "clusters that cannot be read": ", ".join(self.unreadable),
        }
        return ", ".join(f"{what}: {count}" for what, count in counts.items() if count)

    def data(self) -> Json:
        faults = [{"code": "invalid", **problem._asdict()} for problem in self.problems]
        return {
            "commit": self.commit,
            "configuration": self.configuration,
            "releases": self.rows,
            "not_rendered": sorted(self.not_rendered),
            "old_bootstraps": [asdict(bootstrap) for bootstrap in self.old_bootstraps],
            "orphans": [asdict(orphan) | {"command": orphan.command} for orphan in self.orphans],
            "missing_inputs": [asdict(missing) for missing in self.missing_inputs],
            "unreadable": [
                {"cluster": name, "reason": why} for name, why in self.unreadable.items()
            ],
            "faults": faults,
        }

    def text(self) -> list[str | Table]:
        text: list[str | Table] = [f"  {problem}" for problem in self.problems]
        if self.problems:
            count = len(self.problems)
            text.insert(0, "1 problem:" if count == 1 else f"{count} problems:")
            text += [self.in_effect] if self.in_effect else []
        further = map(str, (*self.old_bootstraps, *self.orphans))
        return [*text, releases_table(self.rows), *further, f"desired: {self.commit}"]


_COLORS = {"failing": "red", "healthy": "green", "unknown": "yellow", "waiting": "yellow"}
_COLUMNS = (
    column("Release", "name"),
    column("Health", lambda row: "failing" if row["failing"] else row["health"]),
    column("Seen", lambda row: (row["seen"] or "")[:10], 2),
    column("Node", "node", 4),
    column(
        "Reason",
        lambda row: f"{row['object']}: {row['reason']}" if row["object"] else row["reason"] or "",
        1,
        wraps=True,
    ),
    column("Since", "since", 5),
    column("Version", version_lines, 6),
    column("What", lambda row: row["what"].partition(" on ")[0], 8),
    column("Cluster", "cluster", 7),
)


def releases_table(rows: Iterable[Json]) -> Table:
    return table_of(_COLUMNS, rows, styles=_COLORS)
