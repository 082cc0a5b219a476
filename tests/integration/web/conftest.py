"""Fixtures: the web site of a real state repo, called without a network."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from demandops.repo.reader import Reader
from demandops.serve.generator import Generator
from demandops.views.causes import Cause
from demandops.views.causes import causes as causes_of
from demandops.views.rows import Filter
from demandops.views.source import Source
from demandops.web.follower import Follower
from demandops.web.page_views import LISTS
from demandops.web.server import Site
from starlette.testclient import TestClient

from tests.integration.web.html import Page
from tests.kit import goals
from tests.kit.rig import book, running, wait_until

VIEWS = ("/", "/map", "/services", "/timeline", *(f"/{name}" for name in LISTS))
DENY = """apiVersion: demandops/v1
kind: Override
reason: The road is closed
owner: traffic-control
select: [{connections: [vehicle01/edge]}]
deny: true
"""


@dataclass(frozen=True)
class Shown:
    """A state repo with the first two demands of the paper's experiment, and its web site."""

    bare: Path
    generator: Generator
    follower: Follower
    client: TestClient

    def look(self, path: str, status: int = 200, **params: str) -> Page:
        """Wait until the site shows the newest commit, then return the page at a path."""
        wait_until(
            lambda: self.follower.newest.commit == str(self.generator.snapshot.commit),
            "the page has the newest commit",
        )
        answer = self.client.get(path, params=params)
        assert answer.status_code == status, answer.text
        return Page(answer.text)


@contextmanager
def showing(bare: Path) -> Iterator[Shown]:
    with running(bare) as generator:
        book(generator, *map(goals.experiment, (1, 2)))
        follower = Follower(Reader.of(str(bare)), {}, 0)
        site = Site(follower, ("127.0.0.1", "localhost"))
        client = TestClient(site.application, base_url="http://127.0.0.1:8080")
        yield Shown(bare, generator, follower, client)
        follower.close()


@pytest.fixture
def shown(bare: Path) -> Iterator[Shown]:
    with showing(bare) as made:
        yield made


@pytest.fixture(scope="session")
def still(bare_template: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shown]:
    """A state repo with its site, shared by all tests that change nothing in it."""
    bare = tmp_path_factory.mktemp("still") / "state.git"
    with showing(Path(shutil.copytree(bare_template, bare))) as made:
        yield made


def causes(source: Source, text: str = "") -> list[Cause]:
    return [cause for cause in causes_of(source) if Filter(text).matches(cause.row)]
