"""``demandops web``: the web page, without ROS."""

from __future__ import annotations

import signal
from contextlib import closing
from pathlib import Path

import click

from demandops.base.runtime import REAL
from demandops.cli.output import errors, progress, read_by
from demandops.cli.target import clusters_option, state_repo_option
from demandops.cluster import clusters_file
from demandops.repo.reader import Reader
from demandops.serve.timing.timers import parse_interval
from demandops.web.follower import Follower
from demandops.web.server import WebServer

_INTERVAL = "5s"


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
    default=_INTERVAL,
    show_default=True,
    callback=read_by(parse_interval),
    metavar="DURATION",
    help="How often to fetch a state repo behind a URL. A state repo on this disk is always "
    "current.",
)
def web(state_repo: str, listen: str, access_file: Path | None, interval: float) -> None:
    """Show the state repo on a web page.

    The page follows the state repo. It shows what is not ready and why, a map, lists, a time line,
    each release, overrides and rates. It changes nothing. Stop it with Ctrl-C or SIGTERM.

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
        # SIGTERM acts like Ctrl-C, so that the server and its follower are closed
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        click.echo(server.url)
        try:
            REAL.event().wait()
        except KeyboardInterrupt:
            errors.print("stopped")
