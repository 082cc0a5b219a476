"""The report's plots as images for the docs, drawn by a headless browser."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from tests.kit.browser import chromium

_WIDTH = 900


def draw(plots: Mapping[str, str], folder: Path) -> None:
    """Write each plot as an image, `experiment-<name>.png`."""
    with chromium() as browser:
        page = browser.new_page(viewport={"width": _WIDTH, "height": 600}, device_scale_factor=1.5)
        for name, plot in plots.items():
            page.set_content(f'<body style="margin:0">{plot}</body>')
            page.locator("svg").screenshot(path=folder / f"experiment-{name}.png")
