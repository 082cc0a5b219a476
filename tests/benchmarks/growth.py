"""Measure the cost of a demand, by the vehicles of its application and by the topics it lists.

A vehicle joins and leaves an application that 10 to 1,000 other vehicles hold. A goal lists 10,
1,000 or 8,000 topics. The benchmark measures wall-clock time and CPU time from ``submit`` to the
receipt in a running generator, and the time of the generator's start. The sizes take turns in one
process, so that other work on the machine affects all of them alike.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from demandops.serve.generator import Generator

from tests.benchmarks import fleet

VEHICLES = (10, 100, 200, 1_000)
TOPICS = (10, 1_000, 8_000)
ROUNDS, ROUNDS_OF_TOPICS = 40, 3
WARM_UP = 20

Row = dict[str, float]


def measure(
    folder: Path, sizes: dict[int, int], rounds: int, ego: Callable[[int, int], list[str]]
) -> list[Row]:
    """Return a row for each size: what the join and the leave of one more vehicle cost.

    ``sizes`` maps each size to the number of vehicles that hold the application. A size is what
    the rows vary: the number of vehicles, or of topics in a goal. ``ego`` takes a size and a goal's
    number, and returns the goal's ego topics.
    """
    generators: dict[int, Generator] = {}
    rows: dict[int, Row] = {}
    costs: dict[int, list[tuple[float, ...]]] = {size: [] for size in sizes}
    with ExitStack() as open_ones:
        for size, vehicles in sizes.items():
            laid = fleet.lay_down_crowd(folder / f"{size}.git", vehicles, rounds + WARM_UP)
            start = time.perf_counter()
            generators[size] = Generator(str(laid), data=folder / f"data{size}")
            rows[size] = {"size": size, "start_ms": (time.perf_counter() - start) * 1e3}
            open_ones.callback(generators[size].close)
        for number in range(rounds + WARM_UP):
            for size, vehicles in sizes.items():
                edge, vehicle = fleet.edge_id(0), fleet.vehicle_id(0, vehicles + number)
                join = fleet.goal(edge, vehicle, ego=ego(size, number))
                both = (join, join | {"shutdown": True})
                costs[size].append(
                    tuple(one for goal in both for one in fleet.costs(generators[size], goal))
                )
    for size, row in rows.items():
        names = ("join_ms", "join_cpu_ms", "leave_ms", "leave_cpu_ms")
        medians = map(statistics.median, zip(*costs[size][WARM_UP:], strict=True))
        row |= {name: median * 1e3 for name, median in zip(names, medians, strict=True)}
        row["cpu_ratio"] = row["join_cpu_ms"] / next(iter(rows.values()))["join_cpu_ms"]
    return [*rows.values()]


def main() -> None:
    with fleet.workspace() as folder:
        same = {size: size for size in VEHICLES}
        vehicles = measure(Path(folder), same, ROUNDS, lambda size, number: [])
    with fleet.workspace() as folder:
        topics = measure(
            Path(folder),
            dict.fromkeys(TOPICS, 10),
            ROUNDS_OF_TOPICS,
            lambda size, number: [f"/t{number}/n{index}" for index in range(size)],
        )
    tables = {"vehicles": vehicles, "topics": topics}
    fleet.report(
        "growth", **{f"One more demand, by {name} (medians)": t for name, t in tables.items()}
    )


if __name__ == "__main__":
    main()
