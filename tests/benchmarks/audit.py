"""Measure what an auditor's questions cost on a state repo with thousands of commits.

Vehicles join and leave at all edges in turn; the generator makes a commit of each join and leave.
The benchmark prints the seconds of each question.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path

from demandops.repo import reader
from demandops.repo.history import commit_log
from demandops.serve.generator import Generator

from tests.benchmarks import fleet

RELEASES = 1_000
COMMITS = 10_000
VERIFIED = 300
BATCH = 500


def lay_down(folder: Path) -> Path:
    """Make a state repo with a fleet, and carry out the goals there; return its path."""
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


def timed(what: str, call: Callable[[], object]) -> None:
    start = time.perf_counter()
    found = call()
    print(f"{what:<60} {time.perf_counter() - start:8.2f} s  {found}")


def measure(repo: Path) -> None:
    with reader.opened(str(repo)) as opened:
        tip = opened.commit()
        path_of = partial(commit_log.release_path, opened.objects, tip)
        timed("loading the newest commit", lambda: len(opened.snapshot().state.ledger))
        old = path_of("od-edge00001-v00001x0")
        often = path_of(f"of-{fleet.edge_id(0)}-fusion") or _fusion(opened, tip)
        timed("history of a file that is as it was at first", lambda: _told(opened, old, tip))
        timed("history of a file that changed often", lambda: _told(opened, often, tip))
        gone = f"od-{fleet.edge_id(0)}-{fleet.spare_id(0)}"
        timed("history of a release that stopped", lambda: path_of(gone))
        first = f"{[*opened.log()][-1].time:%Y-%m-%dT%H:%M:%S}"
        timed("a time at the far end", lambda: opened.commit(first)[:10])
        timed("log of one requester", lambda: sum(1 for e in opened.log() if gone in e.summary))
        for whole in (False, True):
            how = "whole" if whole else "by differences"
            timed(f"verify {VERIFIED} commits {how}", partial(_verify, opened, whole=whole))


def _fusion(opened: reader.Reader, tip: str) -> str:
    files = opened.changed_files(opened.commit("main~2"), tip, ("clusters",))
    return files[0] if files else "clusters"


def _told(opened: reader.Reader, path: str | None, tip: str) -> str:
    history = opened.history(path or "", tip, 10)
    return f"{len(history.newest)} and {history.more} more"


def _verify(opened: reader.Reader, *, whole: bool) -> int:
    commits = opened.revisions(f"main~{VERIFIED}..main")
    return sum(verdict.holds for verdict in opened.verify(commits, whole=whole))


def main() -> None:
    with fleet.workspace() as folder:
        measure(lay_down(Path(folder)))


if __name__ == "__main__":
    main()
