"""What a demand costs as what it touches grows: vehicles on one application, topics in one goal.

A vehicle joins and leaves an application that 10, 100 and 1,000 others hold. One goal lists 10,
1,000 and 8,000 topics. Each figure is the time from ``submit`` to the receipt in one running
generator; its start is reported beside it. Prints two tables, writes ``build/growth.json``.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from demandops.service import Generator
from rich.console import Console

from tests.benchmarks import fleet

VEHICLES = (10, 100, 200, 1_000)
TOPICS = (10, 1_000, 8_000)
ROUNDS = 40
WARM_UP = 20

Row = dict[str, float]


def _seconds(generator: Generator, goal: dict[str, Any]) -> float:
    start = time.perf_counter()
    generator.submit(goal).future.result()
    return time.perf_counter() - start


def _row(
    folder: Path, name: str, size: int, vehicles: int, rounds: int, ego: Callable[[int], list[str]]
) -> Row:
    """Measure a further vehicle, again and again, on an application that ``vehicles`` hold."""
    laid = fleet.lay_down_crowd(folder / "state-repo.git", vehicles, rounds + WARM_UP)
    start = time.perf_counter()
    generator = Generator(str(laid), data=folder / "data")
    load = time.perf_counter() - start
    times: list[tuple[float, float]] = []
    try:
        for number in range(rounds + WARM_UP):
            edge, vehicle = fleet.edge_id(0), fleet.vehicle_id(0, vehicles + number)
            join = fleet.goal(edge, vehicle, ego=ego(number))
            leave = join | {"shutdown": True}
            times.append((_seconds(generator, join), _seconds(generator, leave)))
    finally:
        generator.close()
    joins, leaves = map(statistics.median, zip(*times[WARM_UP:], strict=True))
    return {name: size, "start_ms": load * 1e3, "join_ms": joins * 1e3, "leave_ms": leaves * 1e3}


def vehicles_row(folder: Path, vehicles: int) -> Row:
    """Measure one more vehicle on an application that ``vehicles`` hold."""
    return _row(folder, "vehicles", vehicles, vehicles, ROUNDS, lambda number: [])


def topics_row(folder: Path, topics: int) -> Row:
    """Measure one goal with ``topics`` topics, and its shutdown."""

    def ego(number: int) -> list[str]:
        return [f"/t{number}/n{index}" for index in range(topics)]

    return _row(folder, "topics", topics, 10, 3, ego)


def main() -> int:
    """Measure both and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("--vehicles", type=int, nargs="+", default=VEHICLES)
    parser.add_argument("--topics", type=int, nargs="+", default=TOPICS)
    parser.add_argument("--output", type=Path, default=Path("build/growth.json"))
    args = parser.parse_args()
    out = Console(highlight=False)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    results: dict[str, list[Row]] = {}
    for name, measure in (("vehicles", vehicles_row), ("topics", topics_row)):
        rows = results[name] = []
        for size in getattr(args, name):
            with TemporaryDirectory(prefix="bench-", dir=args.output.parent) as folder:
                rows.append(measure(Path(folder), size))
        out.print(fleet.table(f"One more demand, by {name} (medians)", rows))
    args.output.write_text(json.dumps(results, indent=2) + "\n")
    out.print(f"written to {args.output}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
