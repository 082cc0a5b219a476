"""Fixtures: a fleet whose demands and services have a history, its page, and a browser."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, expect

from tests.kit import repo
from tests.kit.browser import Visit, chromium
from tests.kit.limits import PATIENCE_S
from tests.kit.page_story import Story, story

expect.set_options(timeout=PATIENCE_S * 1000)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Story]:
    folder = tmp_path_factory.mktemp("fleet")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DEMANDOPS_DATA_HOME", str(folder / "home"))
        with story(repo.init(folder / "fleet.git"), folder) as told:
            yield told


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    with chromium() as running:
        yield running


Visits = Callable[..., Visit]


@pytest.fixture
def visit(browser: Browser, fleet: Story) -> Iterator[Visits]:
    """Return a function that opens the page in the browser and returns the :class:`Visit`.

    After the test, the fixture checks that the page called no other host and reported no error.
    """
    made: list[Visit] = []

    def start(**options: Any) -> Visit:
        made.append(Visit(browser, fleet.url, **options))
        return made[-1]

    yield start
    for one in made:
        one.close()
    assert {host for one in made for host in one.hosts} <= {fleet.url.removeprefix("http://")}
    assert [text for one in made for text in one.complaints] == []


FIGURES = Path(__file__).parents[2] / "docs" / "figures"
