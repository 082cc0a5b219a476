"""``demandops watch`` and ``demandops web``: the state repo live, on the terminal and on a page."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Mapping
from contextlib import closing
from itertools import islice
from pathlib import Path

import click

from demandops.base.errors import StateRepoError
from demandops.base.runtime import REAL
from demandops.cli.output import errors, painted, progress, read_by
from demandops.cli.queries.log import log_table
from demandops.cli.queries.status import amiss, read_status
from demandops.cli.table import Table, list_table
from demandops.cli.target import clusters_option, state_repo_option
from demandops.cluster import clusters_file
from demandops.repo import reader
from demandops.repo.reader import Reader
from demandops.serve.agenda import parse_interval
from demandops.views.kinds import HEALTH, KINDS, rows_of
from demandops.views.rows import sorted_rows
from demandops.web.follower import Follower
from demandops.web.server import WebServer

# ---- ``demandops watch``: releases, demands and the latest commits live ----


# Two lines are the title, one before each of the three parts is empty, and one at the bottom stays
# free.
_OTHER_LINES = 6


@click.command()
@state_repo_option
@clusters_option
def watch(state_repo: str, access_file: Path | None) -> None:
    """Show releases, demands and the latest commits live.

    Releases that are not healthy come first. The health is known only with --clusters. Ctrl-C ends
    the command.

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


def _screen(
    repo: Reader, clusters: Mapping[str, clusters_file.ClusterAccess], away: str
) -> list[str]:
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
    """Show the state repo on a web page.

    The page follows the state repo. It shows what is not ready and why, a map, lists, a time line,
    each release, and overrides. It changes nothing. Stop it with Ctrl-C or SIGTERM.

    \b
    Examples:
      demandops web
      demandops web --listen 127.0.0.1:8081 --clusters clusters.yaml
    """
    clusters = clusters_file.read(access_file).clusters if access_file else {}
    reader = Reader.of(state_repo)
    with progress("reading the ledger") as report:
        follower = Follower(reader, clusters, interval, progress=report)
    with closing(WebServer(listen, "--listen", follower)) as server:
        click.echo(server.url)
        try:
            REAL.event().wait()
        except KeyboardInterrupt:
            errors.print("stopped")
