"""Measure how many demands per second `demandops request` books.

300 vehicles join at 30 intersections. One command reads all joins from a file, and each join
becomes a commit. A second command books a single demand, which shows what the start costs. The two
commands take turns, each on a fresh repo.
"""

from __future__ import annotations

import os
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path

import yaml

from tests.benchmarks import fleet
from tests.kit.repo import NO_GIT_CONFIG, commits

INTERSECTIONS, VEHICLES = 30, 10
ROUNDS = 5


def _seconds(folder: Path, demands: int) -> tuple[float, float]:
    laid = fleet.lay_down_idle(folder / "state-repo.git", INTERSECTIONS, VEHICLES)
    goals = [
        fleet.goal(fleet.edge_id(edge), fleet.vehicle_id(edge, vehicle))
        for vehicle in range(VEHICLES)
        for edge in range(INTERSECTIONS)
    ]
    file = folder / "joins.yaml"
    file.write_text(yaml.safe_dump_all(goals[:demands]))
    command = [str(Path(sys.executable).with_name("demandops")), "request", str(file)]
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(
        [*command, "--state-repo", str(laid.path)],
        env=os.environ | NO_GIT_CONFIG | {"DEMANDOPS_DATA_HOME": str(folder / "data")},
        stdout=subprocess.DEVNULL,
        check=True,
    )
    seconds, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    worked = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    booked = len(commits(laid.path))
    if booked != demands:
        raise SystemExit(f"{demands} demands became {booked} commits")
    return seconds, worked


def main() -> None:
    sizes = (1, INTERSECTIONS * VEHICLES)
    times: dict[int, list[tuple[float, float]]] = {size: [] for size in sizes}
    for size in sizes * ROUNDS:
        with fleet.workspace() as folder:
            times[size].append(_seconds(Path(folder), size))
    (one, one_cpu), (many, many_cpu) = (
        map(statistics.median, zip(*times[size], strict=True)) for size in sizes
    )
    row = {
        "demands": sizes[1],
        "start_s": one,
        "all_s": many,
        "demands_per_s": sizes[1] / many,
        "without_start_per_s": (sizes[1] - 1) / (many - one),
        "start_cpu_s": one_cpu,
        "all_cpu_s": many_cpu,
    }
    fleet.report("request", **{"Demands through `demandops request`": [row]})


if __name__ == "__main__":
    main()
