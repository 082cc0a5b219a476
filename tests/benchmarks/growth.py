"""Measure the cost of a demand, by the releases, vehicles and topics that there are.

A vehicle joins and leaves: beside 100 to 10,000 releases, an application that 10 to 1,000 other
vehicles hold, or with a goal that lists 10 to 8,000 topics. The benchmark measures wall-clock time
and CPU time from ``submit`` to the receipt of a durable commit, and the time of the generator's
start. The sizes of a table take turns in one process, so that other work on the machine affects all
of them alike. Last, it asks an auditor's questions of a state repo with many commits.
"""

from __future__ import annotations

import statistics
import time
from contextlib import ExitStack, closing, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

from demandops.cli.main import run
from demandops.serve.generator import Generator

from tests.benchmarks import fleet

WARM_UP = 4
NAMES = ("join_ms", "join_cpu_ms", "leave_ms", "leave_cpu_ms")
COMMITS = 10_000
BATCH = 500


@dataclass(frozen=True)
class Case:
    size: int
    edges: int = 1
    vehicles: int = fleet.VEHICLES_PER_EDGE
    topics: int = 1


TABLES = {
    "releases": (30, [Case(size, edges=fleet.edges_for(size)) for size in (100, 10_000)]),
    "vehicles": (40, [Case(size, vehicles=size) for size in (10, 100, 200, 1_000)]),
    "topics": (3, [Case(size, topics=size) for size in (10, 1_000, 8_000)]),
}
"""For each table, how often to measure, and its sizes."""


def measure(folder: Path, rounds: int, cases: list[Case]) -> list[dict[str, float]]:
    """Return a row for each case: medians, the 99th percentile of a join, and the start."""
    generators, starts = list[Generator](), list[float]()
    costs: list[list[list[float]]] = [[] for _ in cases]
    with ExitStack() as open_ones:
        for case in cases:
            laid = fleet.lay_down(folder / f"{case.size}.git", case.edges, case.vehicles)
            start = time.perf_counter()
            made = Generator(str(laid), data=folder / f"data{case.size}")
            generators.append(open_ones.enter_context(closing(made)))
            starts.append((time.perf_counter() - start) * 1e3)
        for number in range(rounds + WARM_UP):
            for index, case in enumerate(cases):
                edge = number * 7 % case.edges
                ego = [f"/t{number}/n{topic}" for topic in range(case.topics)]
                join = fleet.goal(fleet.edge_id(edge), fleet.spare_id(edge), ego=ego)
                took = list[float]()
                for goal in (join, join | {"shutdown": True}):
                    start, worked = time.perf_counter(), time.process_time()
                    generators[index].submit(goal).future.result()
                    took += time.perf_counter() - start, time.process_time() - worked
                costs[index].append(took)
    rows = []
    for case, start, found in zip(cases, starts, costs, strict=True):
        columns = [sorted(each) for each in zip(*found[WARM_UP:], strict=True)]
        row = {"size": case.size, "start_ms": start}
        row |= {
            name: statistics.median(each) * 1e3 for name, each in zip(NAMES, columns, strict=True)
        }
        row["join_p99_ms"] = columns[0][int((rounds - 1) * 0.99)] * 1e3
        rows.append(row)
    return rows


def audit(folder: Path) -> list[dict[str, object]]:
    """Measure questions after joins and leaves at all edges in turn, each in a commit."""
    edges = fleet.edges_for(1_000)
    laid = fleet.lay_down(folder / "state-repo.git", edges)
    with fleet.no_fsync(), closing(Generator(str(laid), data=folder / "data")) as generator:
        for number in range(COMMITS):
            edge, leaves = number // 2 % edges, number % 2 == 1
            goal = fleet.goal(fleet.edge_id(edge), fleet.spare_id(edge), shutdown=leaves)
            ticket = generator.submit(goal)
            if number % BATCH == BATCH - 1:
                ticket.future.result()
    first, newcomer, rows = fleet.edge_id(0), fleet.spare_id(0), list[dict[str, object]]()
    for question in (
        "bookkeeping",
        "why od-edge00001-v00001x0",  # it is as it was at first
        f"why {first}/fusion",  # it changed often
        f"why od-{first}-{newcomer}",  # it stopped
        f"log --requester {newcomer}",
        "verify main~300..main",
        "verify main~300..main --whole",
    ):
        start = time.perf_counter()
        with redirect_stdout(StringIO()) as told:
            code = run([*question.split(), "--state-repo", str(laid)])
        seconds, lines = time.perf_counter() - start, told.getvalue().count("\n")
        rows.append({"question": question, "seconds": seconds, "lines": lines, "exit": code})
    return rows


def main() -> None:
    tables = {}
    for name, (rounds, cases) in TABLES.items():
        with fleet.workspace() as folder:
            tables[f"One more demand, by {name}"] = measure(Path(folder), rounds, cases)
    with fleet.workspace() as folder:
        tables[f"Questions after {COMMITS} commits"] = audit(Path(folder))
    fleet.report("growth", **tables)


if __name__ == "__main__":
    main()
