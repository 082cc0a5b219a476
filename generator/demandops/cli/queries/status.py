"""What runs: ``demandops status``, ``reconcile``, ``watch`` on a terminal and ``web`` on a page."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict
from functools import partial
from itertools import islice
from pathlib import Path

import click

from demandops.base.errors import InvalidInput, StateRepoError, fault, suggestion
from demandops.base.quoting import count
from demandops.base.runtime import REAL
from demandops.cli.formats import Table, list_table, output_formats, output_option, show
from demandops.cli.output import busy, errors, painted, read_by, warn_of_not_rendered
from demandops.cli.queries.commits import in_effect, log_table
from demandops.cli.target import clusters_option, state_repo_option
from demandops.cluster import clusters_file
from demandops.cluster.clusters_file import ClusterAccess
from demandops.cluster.reconcile_trigger import ReconcileTrigger
from demandops.cluster.watches import ObjectCache
from demandops.decide.warnings import missing_inputs
from demandops.model.config.base_model import duration_text, seconds_of
from demandops.repo import reader
from demandops.repo.git.repository import RemoteAway
from demandops.repo.reader import Reader
from demandops.serve.agenda import parse_interval
from demandops.views.kinds import HEALTH, KINDS, rows_of
from demandops.views.rows import sorted_rows
from demandops.views.source import Source
from demandops.views.vocabulary import Json

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
@output_formats("text", "wide", "json")
def status(
    state_repo: str,
    access_file: Path | None,
    *,
    wait: bool,
    timeout: int,
    request_timeout: int,
    output: str,
) -> None:
    """The state is the commit that the cluster has applied, and the health of the release. The
    state of a cluster without a kubeconfig in --clusters is unknown.

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
        message = "--wait needs --clusters FILE with a kubeconfig: without one the state is unknown"
        raise click.UsageError(message)
    with reader.opened(state_repo) as repo:
        source = read_status(repo, clusters, request_timeout)
        end, told = REAL.monotonic() + timeout, ""
        while wait and (wrong := amiss(source, clusters)) and REAL.monotonic() < end:
            if wrong != told:
                errors.print(f"waiting: {wrong}")
                told = wrong
            REAL.sleep(2.0)
            try:
                repo.refresh()
            except RemoteAway as error:  # then the last fetched commit is shown
                errors.print(f"warning: {error}")
            source = read_status(repo, clusters, request_timeout)
        lacking = missing_inputs(source.state)
        data = {
            "commit": source.commit,
            "configuration": str(source.snapshot.configuration),
            "releases": [row.item for row in rows_of(source, "releases")],
            "not_rendered": sorted(source.not_rendered),
            "old_bootstraps": [asdict(bootstrap) for bootstrap in source.old_bootstraps],
            "orphans": [asdict(orphan) | {"command": orphan.command} for orphan in source.orphans],
            "missing_inputs": [asdict(missing) for missing in lacking],
            "unreadable": [{"cluster": c, "reason": why} for c, why in source.unreadable.items()],
            "faults": [{"code": "invalid", **problem._asdict()} for problem in source.problems],
        }
        text: list[str | Table] = [f"  {problem}" for problem in source.problems]
        if text:
            text.insert(0, f"{count(len(text), 'problem')}:")
        if source.snapshot.faults:
            text.append(in_effect(repo, source.snapshot))
    rows = rows_of(source, "releases")
    text.append(list_table(KINDS["releases"], rows, source.now, wide=output == "wide"))
    text += map(str, (*source.old_bootstraps, *source.orphans))
    show(output, data, [*text, f"desired: {source.commit}"])
    warn_of_not_rendered(source.not_rendered)
    for reason in dict.fromkeys(map(str, lacking)):
        errors.print(f"warning: {reason}")
    for name, reason in source.unreadable.items():
        errors.print(f"warning: cluster '{name}' cannot be read: {reason}")
    unwatched = ", ".join(f"'{name}'" for name in source.unwatched)
    if unwatched and output != "json":
        way = "give --clusters FILE (docs/status.md)"
        errors.print(f"the state of cluster {unwatched} is unknown: {way}")
    if wrong := amiss(source, clusters):
        errors.print(f"not well: {wrong}")
        raise click.exceptions.Exit(1)


def read_status(
    repo: Reader, clusters: Mapping[str, ClusterAccess], patience_s: int = _PATIENCE_S
) -> Source:
    with busy("reading the ledger") as report:
        snapshot = repo.snapshot(progress=report)
    return ask_clusters(Source.read(repo, snapshot), repo, clusters, patience_s)


def ask_clusters(
    source: Source,
    repo: Reader,
    clusters: Mapping[str, ClusterAccess],
    patience_s: int = _PATIENCE_S,
) -> Source:
    known = source.config.clusters
    if unknown := sorted(clusters.keys() - known.keys()):
        texts = (f"the inventory has no cluster '{n}'{suggestion(n, known)}" for n in unknown)
        raise InvalidInput(fault("--clusters", text) for text in texts)
    caches = {
        name: ObjectCache(name, cluster, lambda: None)
        for name, cluster in clusters.items()
        if cluster.kubeconfig and name in source.watched_objects
    }
    if not caches:
        return source
    # all clusters are read at the same time, so that a slow cluster does not delay the others
    reads = {name: partial(c.read_once, source.watched_objects[name]) for name, c in caches.items()}
    threads = {name: REAL.start_thread(f"read-{name}", read) for name, read in reads.items()}
    end = REAL.monotonic() + patience_s
    with busy("asking the clusters"):
        for name, thread in threads.items():
            thread.join(max(0.0, end - REAL.monotonic()))
            if thread.is_alive():
                caches[name].give_up(f"it did not answer within {duration_text(patience_s)}")
    return source.with_reports(caches, repo.repository, lambda seen, commit: None)


def amiss(source: Source, clusters: Mapping[str, ClusterAccess]) -> str:
    """Return a text that counts everything that is wrong; empty if nothing is wrong."""
    # of the releases, only those on clusters with a kubeconfig count
    readable = {name for name, cluster in clusters.items() if cluster.kubeconfig}
    items: list[Json] = [row.item for row in rows_of(source, "releases")]
    watched = [item for item in items if item["cluster"] in readable]
    failing = sum(item["failing"] for item in watched)
    healthy = sum(item["health"] == "healthy" for item in watched)
    counts: dict[str, int | str] = {
        "problems in files": len(source.problems),
        "files that a generator has yet to write or remove": len(source.not_rendered),
        "clusters with an old bootstrap file": len(source.old_bootstraps),
        "objects that belong to no release": len(source.orphans),
        "releases failing": failing,
        "releases not healthy yet": len(watched) - failing - healthy,
        "clusters that cannot be read": ", ".join(source.unreadable),
    }
    return ", ".join(f"{what}: {count}" for what, count in counts.items() if count)


# ---- ``demandops reconcile`` ----


@click.command()
@click.argument("cluster", required=False, metavar="[CLUSTER]")
@click.option("--all", "every", is_flag=True, help="Wake the controllers of all clusters.")
@state_repo_option
@clusters_option
@output_option
def reconcile(
    cluster: str | None, every: bool, state_repo: str, access_file: Path | None, output: str
) -> None:
    """The controller is woken as --clusters says: by its webhook, or by the cluster's API.

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


# ---- ``demandops watch``: releases, demands and the latest commits live ----

# Two lines are the title, one before each of the three parts is empty, and one at the bottom stays
# free.
_OTHER_LINES = 6


@click.command()
@state_repo_option
@clusters_option
def watch(state_repo: str, access_file: Path | None) -> None:
    """Releases that are not healthy come first. The health is known only with --clusters. Ctrl-C
    ends the command.

    \b
    Examples:
      demandops watch
      demandops watch --clusters clusters.yaml
    """
    if not sys.stdout.isatty():
        raise click.UsageError("watch needs a terminal; use `demandops get KIND --watch` instead")
    from rich.live import Live  # noqa: PLC0415 - only here
    from rich.text import Text  # noqa: PLC0415

    clusters = clusters_file.read(access_file).clusters if access_file else {}
    try:
        with reader.opened(state_repo) as repo, Live(screen=True, auto_refresh=False) as live:
            away = ""
            while True:
                shown = _screen(repo, clusters, away)
                live.update(Text.from_ansi("\n".join(shown), no_wrap=True), refresh=True)
                REAL.sleep(2.0)
                try:
                    repo.refresh()
                    away = ""
                except StateRepoError as error:
                    away = str(error)
    except KeyboardInterrupt:
        return


def _screen(repo: Reader, clusters: Mapping[str, ClusterAccess], away: str) -> list[str]:
    width, height = shutil.get_terminal_size()
    source = read_status(repo, clusters)
    now, releases = source.now, rows_of(source, "releases")
    demands = rows_of(source, "demands")
    wrong = "; ".join(filter(None, (amiss(source, clusters), away)))
    health = painted(f"not well: {wrong}", "red") if wrong else painted("all is well", "green")
    if not clusters and not wrong:
        health = "the health is unknown: give --clusters FILE"
    head = f"{repo.repository.address} at {source.commit[:10]}, {now:%H:%M:%S} UTC"
    counts = f"{len(releases)} releases, {len(demands)} demands"
    releases = sorted_rows(releases, HEALTH, now)
    commits = log_table(islice(repo.log(), 6), now)
    last = _part("Latest commits", commits, width, height // 3)
    room = height - _OTHER_LINES - len(last)
    running = list_table(KINDS["releases"], releases, now)
    first = _part("Releases", running, width, room * 2 // 3)
    middle = _part("Demands", list_table(KINDS["demands"], demands, now), width, room - len(first))
    title = [painted(head, "bold"), f"{counts}; {health}"]
    return [*title, "", *first, "", *middle, "", *last][: height - 1]


def _part(title: str, table: Table, width: int, room: int) -> list[str]:
    lines = [painted(title, "bold"), *table.lines(width, painted)]
    if len(lines) <= room:
        return lines
    kept = max(room - 1, 1)
    return [*lines[:kept], painted(f"… {len(lines) - kept} more lines", "dim")]


# ---- ``demandops web``: the web page, without ROS ----


@click.command()
@state_repo_option
@click.option(
    "--listen",
    default="127.0.0.1:8080",
    show_default=True,
    metavar="HOST:PORT",
    help="The page's address. Everybody who reaches it can read the page; see docs/page.md.",
)
@clusters_option
@click.option(
    "--fetch-interval",
    "interval",
    default="5s",
    show_default=True,
    callback=read_by(parse_interval),
    metavar="DURATION",
    help="How often to fetch a state repo behind a URL. A state repo on this disk is always "
    "current.",
)
def web(state_repo: str, listen: str, access_file: Path | None, interval: float) -> None:
    """The page follows the state repo. It shows what is not ready and why, a map, lists, a time
    line, each release, and overrides. It changes nothing. Stop it with Ctrl-C or SIGTERM.

    \b
    Examples:
      demandops web
      demandops web --listen 127.0.0.1:8081 --clusters clusters.yaml
    """
    from demandops.web.follower import Follower  # noqa: PLC0415 - slow, and only here
    from demandops.web.server import WebServer  # noqa: PLC0415

    clusters = clusters_file.read(access_file).clusters if access_file else {}
    with busy("reading the ledger") as report:
        follower = Follower(Reader.of(state_repo), clusters, interval, progress=report)
    with closing(WebServer(listen, "--listen", follower)) as server:
        click.echo(server.url)
        try:
            REAL.event().wait()
        except KeyboardInterrupt:
            errors.print("stopped")
