"""Measure the time from ``submit`` to the durable commit, with 100 and with 10,000 releases."""

from __future__ import annotations

import statistics
import time
from contextlib import closing
from pathlib import Path

from demandops.serve.generator import Generator

from tests.benchmarks import fleet

SIZES = (100, 10_000)
ROUNDS = 60
WARM_UP = 4


def measure(folder: Path, releases: int) -> dict[str, float]:
    """Return the figures for a fleet of about ``releases`` releases; times are in milliseconds."""
    laid = fleet.lay_down(folder / "state-repo.git", releases)
    start = time.perf_counter()
    with closing(Generator(str(laid.path), data=folder / "data")) as generator:
        load, taken = time.perf_counter() - start, []
        for number in range(ROUNDS + WARM_UP):
            # a newcomer joins, then leaves, each time at another edge
            edge = (number // 2 * 7) % laid.edges
            vehicle = fleet.spare_id(edge)
            goal = fleet.goal(fleet.edge_id(edge), vehicle, shutdown=number % 2 == 1)
            taken.append(fleet.costs(generator, goal)[0] * 1e3)
    taken = sorted(taken[WARM_UP:])
    return {
        "releases": laid.releases,
        "load_ms": load * 1e3,
        "p50_ms": statistics.median(taken),
        "p99_ms": taken[int((len(taken) - 1) * 0.99)],
    }


def main() -> None:
    rows = []
    for releases in SIZES:
        with fleet.workspace() as folder:
            rows.append(measure(Path(folder), releases))
            rows[-1]["p50_ratio"] = rows[-1]["p50_ms"] / rows[0]["p50_ms"]
    fleet.report("bench", **{"From submit to durable commit": rows})


if __name__ == "__main__":
    main()
