"""Measure the time of a commit from ``submit`` on, and compare it with a floor.

The state repo has 100 or 10,000 releases. The floor is the least time that such a commit can take:
bare pygit2 writes the same blobs, trees and commit with the same fsync, in the same repository,
right after each demand. For comparison, GitPython's index commits the same files in a checked-out
copy. The benchmark prints a table and writes ``build/bench.json``.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path
from tempfile import TemporaryDirectory

import git
import pygit2
from demandops.repo.git import tree as trees
from demandops.repo.git.objects import NewObjects
from demandops.repo.history import commit_message
from demandops.serve.generator import Generator
from rich.console import Console
from rich.progress import Progress

from tests.benchmarks import fleet

SIZES = (100, 10_000)
ROUNDS = 60
INDEX_ROUNDS = 3
WARM_UP = 4


def _changed(repo: pygit2.Repository, commit: pygit2.Commit) -> dict[str, str | None]:
    """Return the text of each file that a commit changed, by path; None for a removed file."""
    files: dict[str, str | None] = {}
    before, after = commit.parents[0].tree, commit.tree
    for path, _ in trees.differences(before, after):
        files[path] = trees.read_text(after, path)
    return files


class Floor:
    """Measures the floor: bare pygit2 writes the same objects, each into a file of its own."""

    def __init__(self, path: Path) -> None:
        self._repo, self._other = pygit2.Repository(str(path)), pygit2.Repository(str(path))
        self._new = NewObjects(self._other)

    def commit(self, base: pygit2.Commit, files: Mapping[str, str | None], text: str) -> float:
        """Write blobs, trees, commit and branch; return the seconds."""
        start = time.perf_counter()
        tree = trees.write(self._new, self._repo[base.id].peel(pygit2.Commit).tree, files)
        for oid in self._new:
            self._repo.write(*self._new.read(oid))
        self._new.forget()
        who = commit_message.generator_signature(datetime.now(timezone.utc))
        made = self._repo.create_commit(None, who, who, text, tree, [base.id])
        self._repo.references.create("refs/bench/floor", made, force=True)
        return time.perf_counter() - start


def measure(
    folder: Path, releases: int, edges_per_cluster: int, progress: Progress
) -> dict[str, float]:
    """Return the figures for a fleet of about ``releases`` releases; times are in milliseconds."""
    task = progress.add_task(f"{releases} releases: laying down the fleet", total=None)
    laid = fleet.lay_down(folder / "state-repo.git", releases, edges_per_cluster)
    progress.update(task, description=f"{releases} releases: reading the ledger")
    start = time.perf_counter()
    generator = Generator(str(laid.path), data=folder / "data")
    load = time.perf_counter() - start
    repo, floor = pygit2.Repository(str(laid.path)), Floor(laid.path)
    submits, floors = [], []
    progress.update(task, description=f"{releases} releases: demands", total=ROUNDS, completed=0)
    changes: list[dict[str, str | None]] = []
    try:
        for number in range(ROUNDS + WARM_UP):
            # a newcomer joins, then leaves, each time at another edge
            edge = (number // 2 * 7) % laid.edges
            vehicle = fleet.spare_id(edge)
            goal = fleet.goal(fleet.edge_id(edge), vehicle, shutdown=number % 2 == 1)
            start = time.perf_counter()
            receipt = generator.submit(goal).future.result()
            submits.append(time.perf_counter() - start)
            made = repo[receipt.commit].peel(pygit2.Commit)
            files = _changed(repo, made)
            changes.append(files)
            salted = {p: t and f"{t}# {number} {time.time_ns()}\n" for p, t in files.items()}
            floors.append(floor.commit(made.parents[0], salted, made.message))
            progress.update(task, completed=number)
    finally:
        generator.close()
    progress.update(task, description=f"{releases} releases: GitPython's index", completed=ROUNDS)
    index = _index(folder, laid.path, changes[: 2 * INDEX_ROUNDS])
    progress.remove_task(task)
    submits, floors = submits[WARM_UP:], floors[WARM_UP:]
    return {
        "releases": laid.releases,
        "load_ms": load * 1e3,
        "submit_p50_ms": statistics.median(submits) * 1e3,
        "submit_p99_ms": _p99(submits) * 1e3,
        "floor_p50_ms": statistics.median(floors) * 1e3,
        "floor_p99_ms": _p99(floors) * 1e3,
        "gitpython_index_p50_ms": statistics.median(index) * 1e3,
    }


def _p99(values: list[float]) -> float:
    return sorted(values)[min(len(values) - 1, int(len(values) * 0.99))]


def _index(folder: Path, bare: Path, changes: list[dict[str, str | None]]) -> list[float]:
    """Commit the same changes through GitPython's index; return the seconds of each commit.

    The index needs a checked-out copy.
    """
    times = []
    start_at = f"HEAD~{ROUNDS + WARM_UP}"
    with git.Repo.clone_from(str(bare), folder / "work") as repo:
        repo.git.reset("--hard", start_at)
        root = Path(repo.working_dir)
        for files in changes:
            start = time.perf_counter()
            added = []
            for path, text in files.items():
                if text is None:
                    repo.index.remove([path], working_tree=True)
                    continue
                target = root / path
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_text(text)
                added.append(path)
            repo.index.add(added)
            repo.index.commit("the same change")
            times.append(time.perf_counter() - start)
    return times


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="numbers of releases")
    parser.add_argument("--edges-per-cluster", type=int, default=10)
    parser.add_argument("--output", type=Path, default=Path("build/bench.json"))
    args = parser.parse_args()
    out = Console(highlight=False)
    rows = []
    args.output.parent.mkdir(parents=True, exist_ok=True)
    with Progress(console=out, transient=True) as progress:
        for releases in args.sizes:
            with TemporaryDirectory(prefix="bench-", dir=args.output.parent) as folder:
                rows.append(measure(Path(folder), releases, args.edges_per_cluster, progress))
    for row in rows:
        row["submit_over_floor"] = row["submit_p50_ms"] / row["floor_p50_ms"]
    out.print(fleet.table("From submit to durable commit", rows))
    ratio = rows[-1]["submit_p50_ms"] / rows[0]["submit_p50_ms"]
    out.print(f"p50 at {rows[-1]['releases']:,} over p50 at {rows[0]['releases']:,}: {ratio:.2f}")
    machine = {"cpus": os.cpu_count(), "python": platform.python_version()}
    args.output.write_text(
        json.dumps({"machine": machine, "rows": rows, "p50_ratio": ratio}, indent=2) + "\n"
    )
    out.print(f"written to {args.output}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
