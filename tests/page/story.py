"""A running fleet for tests of the web page; all services are healthy except one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from pathlib import Path

from demandops.cluster.clusters_file import ClusterAccess
from demandops.repo.reader import Reader
from demandops.serve.generator import Generator
from demandops.web.follower import Follower
from demandops.web.server import WebServer

from tests.kit import goals
from tests.kit.cluster import KubeApi, kube_api
from tests.kit.config import override
from tests.kit.goals import Goal
from tests.kit.http import kubeconfig
from tests.kit.repo import Person
from tests.kit.rig import book, wait_until

NAMESPACE = "perception"
FAILING = "od-edge-vehicle00"
FAULT = "Helm install failed: container detection: ImagePullBackOff: manifest unknown"
OVERRIDES = {
    "roadworks": override(
        {"connections": ["vehicle03/edge"]},
        reason="The road is closed until the bridge is mended",
        owner="traffic-control",
        deny=True,
    ),
    "old": override(
        {"services": ["gone"]},
        reason="Left from a demonstration",
        owner="Petra Platform",
        replicas=2,
    ),
}


def leased(id: str, vehicle: str, lease: str = "30m") -> Goal:
    made = {"kind": "Demand", "demand": id, "requesters": [vehicle], "lease": lease}
    topics = [{"source": f"/vehicles/{vehicle}/ego_data"}]
    ends = {"type": "mqtt", "source": vehicle, "target": "cloud"}
    return made | {"connections": [{"id": f"{vehicle}/cloud", "topics": topics} | ends]}


def released(id: str, vehicle: str) -> Goal:
    return {"kind": "Demand", "demand": id, "requesters": [vehicle], "operation": "release"}


@dataclass
class Story:
    bare: Path
    generator: Generator
    api: KubeApi
    person: Person
    server: WebServer
    follower: Follower

    @property
    def url(self) -> str:
        return self.server.url.rstrip("/")

    def wait_followed(self) -> None:
        def is_at() -> bool:
            return self.follower.newest.commit == str(self.generator.snapshot.commit)

        wait_until(is_at, "the page has the newest commit")

    def settle(self, *, mended: bool = False) -> None:
        """Report the newest commit as applied; ``FAILING`` fails unless it is mended."""
        commit = str(self.generator.snapshot.commit)
        since = (datetime.now(timezone.utc) - timedelta(minutes=12)).strftime("%Y-%m-%dT%H:%M:%SZ")
        self.api.flux(NAMESPACE, "perception", commit)
        for planned in self.follower.at(commit).running:
            name = planned.release.name
            if planned.target.is_service:
                fault = FAULT if name == FAILING and not mended else ""
                self.api.helm_release(NAMESPACE, name, fault, since)
            else:
                self.api.deployment(NAMESPACE, name)


@contextmanager
def story(bare: Path, folder: Path) -> Iterator[Story]:
    with ExitStack() as stack:
        api = stack.enter_context(kube_api())
        generator = Generator(str(bare), fetch_interval=0.2)
        stack.callback(generator.close)
        person = Person(bare, folder / "person")
        book(generator, *map(goals.experiment, (1, 2, 3, 4)))
        book(generator, leased("vehicle01-to-cloud", "vehicle01"))
        access = ClusterAccess(kubeconfig=kubeconfig(folder, api.url))
        follower = Follower(Reader.of(str(bare)), {"c-its": access}, 0)
        server = WebServer("127.0.0.1:0", "--listen", follower)
        stack.callback(server.close)
        told = Story(bare, generator, api, person, server, follower)
        person.override(**OVERRIDES)
        wait_until(
            lambda: "roadworks" in generator.snapshot.state.config.overrides, "it is in effect"
        )
        told.wait_followed()

        def is_seen() -> bool:
            told.settle()  # again after each commit that the override brings about
            return follower.newest.status(FAILING).health.failing

        wait_until(is_seen, "the page sees what fails")
        yield told
