"""Try the rules of both actions against a server; print for each whether it holds.

Without --server, our own node is started on a fresh fleet, in a ROS domain of its own. A server
that is named must have the nodes of a fresh fleet: vehicle00 to vehicle03, station00, edge, cloud.
The exit code is 1 if a rule fails.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

from demandops.base.settings import DEFAULT_ACTION_NAME, DEFAULT_DEMAND_ACTION_NAME

from tests.conformance.suite import Servers, orders, verdicts
from tests.kit.repo import NO_GIT_CONFIG, init
from tests.kit.ros import Servers as Nodes
from tests.kit.ros import reserved

BOOKKEEPING = "/demandops/get_bookkeeping"


@contextmanager
def own_node() -> Iterator[Servers]:
    with tempfile.TemporaryDirectory() as name, reserved() as domain:
        folder = Path(name)
        nodes = Nodes(folder, domain, DEMANDOPS_DATA_HOME=str(folder / "home"), **NO_GIT_CONFIG)
        nodes.start(str(init(folder / "state.git")))
        try:
            actions = (DEFAULT_ACTION_NAME, DEFAULT_DEMAND_ACTION_NAME)
            with closing(Servers(domain, *actions, BOOKKEEPING)) as servers:
                yield servers
        finally:
            nodes.kill()


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.conformance", description=__doc__)
    add = parser.add_argument
    add("--server", metavar="ACTION", default="", help="the name of a DeploymentRequest action")
    add("--demand-server", metavar="ACTION", default="", help="the name of a Demand action")
    add("--bookkeeping", metavar="SERVICE", default="", help="where to ask who requests what")
    add("--domain", type=int, default=int(os.environ.get("ROS_DOMAIN_ID", "0")))
    add("--reference", action="store_true", help="it is the reference; its differences are known")
    add("--all", action="store_true", help="play all 576 orders of joining and leaving")
    add("--seed", type=int, default=0, help="choose what is played at random")
    given = parser.parse_args(arguments)
    names = (given.server, given.demand_server, given.bookkeeping)
    with closing(Servers(given.domain, *names)) if given.server else own_node() as servers:
        if not servers.are_asked:
            print("only answers are compared; --bookkeeping says who requests what")
        failed = 0
        played = orders(given.seed, every=given.all)
        for verdict in verdicts(servers, played, given.seed, is_reference=given.reference):
            print(verdict, flush=True)
            failed += verdict.word == "fails"
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
