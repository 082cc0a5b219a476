"""Measure the cost of a demand, by the vehicles of its application and by the topics it lists.

A vehicle joins and leaves an application that 10 to 1,000 other vehicles hold. A goal lists 10,
1,000 or 8,000 topics. The benchmark measures wall-clock time and CPU time from ``submit`` to the
receipt in a running generator, and the time of the generator's start. The sizes take turns in one
process, so that other work on the machine affects all of them alike. The benchmark prints two
tables and writes ``build/growth.json``.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from demandops.serve.generator import Generator
from rich.console import Console

from tests.benchmarks import fleet

VEHICLES = (10, 100, 200, 1_000)
TOPICS = (10, 1_000, 8_000)
ROUNDS = 40
WARM_UP = 20

Row = dict[str, float]
Ego = Callable[[int, int], list[str]]


def _costs(generator: Generator, goal: dict[str, Any]) -> tuple[float, float]:
    """Carry out a goal; return its wall-clock seconds and its CPU seconds."""
    start, worked = time.perf_counter(), time.process_time()
    generator.submit(goal).future.result()
    return time.perf_counter() - start, time.process_time() - worked


def _rows(folder: Path, sizes: dict[int, int], rounds: int, ego: Ego) -> list[Row]:
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
            path = folder / f"{size}.git"
            laid = fleet.lay_down_crowd(path, vehicles, rounds + WARM_UP)
            start = time.perf_counter()
            generators[size] = Generator(str(laid), data=folder / f"data{size}")
            rows[size] = {"start_ms": (time.perf_counter() - start) * 1e3}
            open_ones.callback(generators[size].close)
        for number in range(rounds + WARM_UP):
            for size, vehicles in sizes.items():
                edge, vehicle = fleet.edge_id(0), fleet.vehicle_id(0, vehicles + number)
                join = fleet.goal(edge, vehicle, ego=ego(size, number))
                leave = join | {"shutdown": True}
                costs[size].append(
                    (*_costs(generators[size], join), *_costs(generators[size], leave))
                )
    for size, row in rows.items():
        names = ("join_ms", "join_cpu_ms", "leave_ms", "leave_cpu_ms")
        medians = map(statistics.median, zip(*costs[size][WARM_UP:], strict=True))
        row |= {name: median * 1e3 for name, median in zip(names, medians, strict=True)}
    return [{"size": size, **row} for size, row in rows.items()]


def vehicles_rows(folder: Path, vehicles: Sequence[int]) -> list[Row]:
    """Return the cost of one more vehicle for each number of vehicles that share an application."""
    return _rows(folder, {size: size for size in vehicles}, ROUNDS, lambda size, number: [])


def topics_rows(folder: Path, topics: Sequence[int]) -> list[Row]:
    """Return the cost of a goal and of its shutdown, for each number of topics in the goal."""

    def ego(size: int, number: int) -> list[str]:
        return [f"/t{number}/n{index}" for index in range(size)]

    return _rows(folder, dict.fromkeys(topics, 10), 3, ego)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("--vehicles", type=int, nargs="+", default=VEHICLES)
    parser.add_argument("--topics", type=int, nargs="+", default=TOPICS)
    parser.add_argument("--output", type=Path, default=Path("build/growth.json"))
    args = parser.parse_args()
    out = Console(highlight=False)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    results: dict[str, list[Row]] = {}
    for name, measure in (("vehicles", vehicles_rows), ("topics", topics_rows)):
        with TemporaryDirectory(prefix="bench-", dir=args.output.parent) as folder:
            rows = results[name] = measure(Path(folder), getattr(args, name))
        for row in rows:
            row["cpu_ratio"] = row["join_cpu_ms"] / rows[0]["join_cpu_ms"]
        out.print(fleet.table(f"One more demand, by {name} (medians)", rows))
    args.output.write_text(json.dumps(results, indent=2) + "\n")
    out.print(f"written to {args.output}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
