"""What a demand costs as what it touches grows: vehicles on one application, topics in one goal.

A vehicle joins and leaves an application that 10, 100 and 1,000 others hold. One goal lists 10,
1,000 and 8,000 topics. Each figure is the time from ``submit`` to the receipt in one running
generator; its start is reported beside it. Prints two tables, writes ``build/growth.json``.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from demandops.service import Generator
from rich.console import Console
from rich.table import Table

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


def _measured(
    folder: Path, vehicles: int, goals: Callable[[int], list[dict[str, Any]]], rounds: int
) -> tuple[float, list[float]]:
    """Return the start of a generator with ``vehicles`` at one edge, and each goal's median."""
    laid = fleet.lay_down_crowd(folder / "state-repo.git", vehicles, rounds + WARM_UP)
    start = time.perf_counter()
    generator = Generator(str(laid), data=folder / "data")
    load = time.perf_counter() - start
    try:
        times = [
            [_seconds(generator, goal) for goal in goals(number)]
            for number in range(rounds + WARM_UP)
        ]
    finally:
        generator.close()
    return load, [statistics.median(column) for column in zip(*times[WARM_UP:], strict=True)]


def vehicles_row(folder: Path, vehicles: int) -> Row:
    """Measure one more vehicle on an application that ``vehicles`` hold."""

    def goals(number: int) -> list[dict[str, Any]]:
        edge, name = fleet.edge_id(0), fleet.vehicle_id(0, vehicles + number)
        return [fleet.goal(edge, name), fleet.goal(edge, name, shutdown=True)]

    load, (join, leave) = _measured(folder, vehicles, goals, ROUNDS)
    return {
        "vehicles": vehicles,
        "start_ms": load * 1e3,
        "join_ms": join * 1e3,
        "leave_ms": leave * 1e3,
    }


def topics_row(folder: Path, topics: int) -> Row:
    """Measure one goal with ``topics`` topics, and its shutdown."""

    def goals(number: int) -> list[dict[str, Any]]:
        names = [f"/t{number}/n{index}" for index in range(topics)]
        edge, name = fleet.edge_id(0), fleet.vehicle_id(0, 10 + number)
        return [
            fleet.goal(edge, name, ego=names),
            fleet.goal(edge, name, ego=names, shutdown=True),
        ]

    load, (join, leave) = _measured(folder, 10, goals, 3)
    return {
        "topics": topics,
        "start_ms": load * 1e3,
        "join_ms": join * 1e3,
        "leave_ms": leave * 1e3,
    }


def _print(out: Console, title: str, rows: list[Row]) -> None:
    table = Table(title=title)
    for column in rows[0]:
        table.add_column(column.replace("_", " "), justify="right")
    for row in rows:
        table.add_row(
            *(
                f"{value:,.1f}" if name.endswith("_ms") else f"{value:,}"
                for name, value in row.items()
            )
        )
    out.print(table)


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
    for name, measure, sizes in (
        ("vehicles", vehicles_row, args.vehicles),
        ("topics", topics_row, args.topics),
    ):
        rows = results[name] = []
        for size in sizes:
            folder = Path(tempfile.mkdtemp(prefix="bench-", dir=args.output.parent))
            try:
                rows.append(measure(folder, size))
            finally:
                shutil.rmtree(folder, ignore_errors=True)
        _print(out, f"One more demand, by {name} (medians in milliseconds)", rows)
    args.output.write_text(json.dumps(results, indent=2) + "\n")
    out.print(f"written to {args.output}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
