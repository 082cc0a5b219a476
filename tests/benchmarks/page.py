"""Measure the page of a large fleet: the server's time, and that of the browser's main thread.

A headless Chromium opens the page of a fleet with about 10,000 releases on 3,900 nodes. For each
view, the benchmark measures the server's time, the size of the answer, and the longest time that
the browser's main thread was busy while the view came up. Then the benchmark books a demand and
measures how the open view is updated.
"""

from __future__ import annotations

import os
import time
import urllib.request
import uuid
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from demandops.repo.reader import Reader
from demandops.serve.generator import Generator
from demandops.web.follower import Follower
from demandops.web.server import WebServer
from playwright.sync_api import Browser, expect

from tests.benchmarks import fleet
from tests.kit.browser import Visit, chromium

VIEWS = ["", "map", "map?q=edge00000"]
VIEWS += ["demands", "releases", "connections", "nodes", "timeline", "overrides"]
RELEASES = 10_000
AIM_MS = 200
ROUNDS = 3
PATIENCE_MS = 120_000

Row = dict[str, Any]


def _on_server(url: str) -> tuple[float, int]:
    """Return the server's seconds for a view that it has served already, and its bytes."""
    for _ in range(2):
        start = time.perf_counter()
        with urllib.request.urlopen(url) as answer:  # noqa: S310 - the page on this machine
            size = len(answer.read())
    return time.perf_counter() - start, size


def _row(browser: Browser, generator: Generator, server: WebServer, view: str) -> Row:
    """Return a view's figures; those of the browser are the best of several rounds."""
    server_s, size = _on_server(server.url + view)
    first, updates = list[float](), list[tuple[float, float]]()
    for _ in range(ROUNDS):
        visit = Visit(browser, server.url.rstrip("/"))
        page = visit.open(f"/{view}")
        expect(page.locator("#live")).to_have_text("live")
        first.append(visit.longest_task_ms())
        page.evaluate("window.longTasks = []")
        goal = fleet.goal(fleet.edge_id(0), fleet.spare_id(0), ego=[f"/t{uuid.uuid4().hex}"])
        start = time.perf_counter()
        generator.submit(goal).future.result()
        commit = str(generator.snapshot.commit)[:10]
        expect(page.locator("footer .id")).to_have_text(commit, timeout=PATIENCE_MS)
        updates.append((visit.longest_task_ms(), time.perf_counter() - start))
        assert visit.complaints == []
        visit.close()
    return {
        "server_ms": server_s * 1000,
        "kB": size / 1000,
        "longest_task_ms": min(first),
        "update_s": min(seconds for _, seconds in updates),
        "longest_task_of_update_ms": min(task for task, _ in updates),
    }


def main() -> None:
    rows = []
    with TemporaryDirectory() as folder, chromium() as browser:
        os.environ["DEMANDOPS_DATA_HOME"] = f"{folder}/home"
        laid = fleet.lay_down(Path(folder) / "state-repo.git", fleet.edges_for(RELEASES))
        generator = Generator(str(laid))
        follower = Follower(Reader.of(str(laid)), {}, 0)
        server = WebServer("127.0.0.1:0", "--listen", follower)
        release = next(iter(follower.newest.releases))
        for view in (*VIEWS, f"release?name={release}"):
            name = view.partition("=")[0] or "overview"
            rows.append({"view": name} | _row(browser, generator, server, view))
        server.close()
        generator.close()
    tasks = ("longest_task_ms", "longest_task_of_update_ms")
    longest = max(float(row[task]) for row in rows for task in tasks)
    title = f"The page; the longest task took {longest:.0f} ms, aim below {AIM_MS} ms"
    fleet.report("page", **{title: rows})


if __name__ == "__main__":
    main()
