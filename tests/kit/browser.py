"""The system's Chromium without a window, and visits that record a page's requests and errors."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from playwright.sync_api import Browser, Page, sync_playwright

from tests.kit.limits import PATIENCE_S

_ALONE = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)

_NOTE_LONG_TASKS = """
window.longTasks = [];
new PerformanceObserver((list) => {
  for (const entry of list.getEntries()) window.longTasks.push(entry.duration);
}).observe({ type: "longtask", buffered: true });
"""


@contextmanager
def chromium() -> Iterator[Browser]:
    program = shutil.which("chromium")
    assert program, "chromium is not installed; run setup/system page"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=program, args=list(_ALONE), timeout=PATIENCE_S * 1000
        )
        try:
            yield browser
        finally:
            browser.close()


class Visit:
    """A visit to the site: its page, the hosts of all requests, and all errors and warnings."""

    def __init__(self, browser: Browser, url: str, *, width: int = 1280, **options: Any) -> None:
        self.url = url
        viewport = {"width": width, "height": 900 if width > 500 else 844}
        self.context = browser.new_context(viewport=viewport, **options)  # type: ignore[arg-type]
        self.context.set_default_timeout(PATIENCE_S * 1000)
        self.context.add_init_script(_NOTE_LONG_TASKS)
        self.hosts: set[str] = set()
        self.complaints: list[str] = []
        self.page = self.context.new_page()
        self.page.on("request", lambda request: self.hosts.add(urlsplit(request.url).netloc))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("console", self._note)

    def _note(self, message: Any) -> None:
        if message.type in ("error", "warning"):
            self.complaints.append(message.text)

    def open(self, path: str) -> Page:
        self.page.goto(f"{self.url}{path}", wait_until="load")
        return self.page

    def longest_task_ms(self) -> float:
        self.page.wait_for_timeout(150)  # the observer reports tasks a moment later
        return float(self.page.evaluate("Math.max(0, ...window.longTasks)"))

    def close(self) -> None:
        self.context.close()
