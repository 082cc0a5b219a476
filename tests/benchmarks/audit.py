"""Measure what an auditor's questions cost on a state repo with thousands of commits.

Vehicles join and leave at all edges in turn; the generator makes a commit of each join and leave.
The benchmark prints the seconds of each question.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing, redirect_stdout
from io import StringIO
from pathlib import Path

from demandops.cli.main import run
from demandops.serve.generator import Generator

from tests.benchmarks import fleet

RELEASES = 1_000
COMMITS = 10_000
VERIFIED = 300
BATCH = 500


def lay_down(folder: Path) -> Path:
    edges = fleet.edges_for(RELEASES)
    laid = fleet.lay_down(folder / "state-repo.git", edges)
    with fleet.no_fsync(), closing(Generator(str(laid), data=folder / "data")) as generator:
        for first in range(0, COMMITS, BATCH):
            tickets = []
            for number in range(first, min(first + BATCH, COMMITS)):
                edge = number // 2 % edges
                vehicle, leaves = fleet.spare_id(edge), number % 2 == 1
                goal = fleet.goal(fleet.edge_id(edge), vehicle, shutdown=leaves)
                tickets.append(generator.submit(goal))
            for ticket in tickets:
                ticket.future.result()
    return laid


def questions() -> Iterator[str]:
    edge, newcomer = fleet.edge_id(0), fleet.spare_id(0)
    yield "bookkeeping"
    yield "why od-edge00001-v00001x0"  # it is as it was at first
    yield f"why {edge}/fusion"  # it changed often
    yield f"why od-{edge}-{newcomer}"  # it stopped
    yield f"log --requester {newcomer}"
    for whole in ("", " --whole"):
        yield f"verify main~{VERIFIED}..main{whole}"


def measure(repo: Path) -> None:
    for question in questions():
        start = time.perf_counter()
        with redirect_stdout(StringIO()) as told:
            code = run([*question.split(), "--state-repo", str(repo)])
        took, lines = time.perf_counter() - start, told.getvalue().count("\n")
        print(f"{question:<50} {took:8.2f} s, {lines} lines, exit code {code}")


def main() -> None:
    with fleet.workspace() as folder:
        measure(lay_down(Path(folder)))


if __name__ == "__main__":
    main()
