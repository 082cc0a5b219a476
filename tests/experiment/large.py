"""The larger experiment: many vehicles, three intersections, two clusters.

The vehicles send only poses. One process sends all of them, in the cloud's ROS domain. The
detector, the generator's ROS node, Git, the GitOps controllers and the clusters are the same as in
the paper's experiment. No containers run, so no data flows.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path

from tests.e2e.common.access import access_file, documented_roles, limited
from tests.e2e.common.expected import CLUSTER, WITHOUT_DEMANDS
from tests.e2e.rig.cluster import Rig
from tests.kit.repo import git
from tests.kit.ros import reserved

from . import crowd
from .experiment import Experiment, Say
from .observers import CloudObserver
from .outcome import Formed, Outcome, Settings
from .process_runner import ProcessRunner

_LOOKS = 12
"""The run records the whole bookkeeping at about this many of its commits.

These commits are spread evenly over the run, and the last commit is one of them.
"""


class PodWatch(ProcessRunner):
    """Records when pods get their nodes and when they end; it starts no containers."""

    def _prepare(self) -> None:
        self.pods |= self._waiting
        self._waiting.clear()

    def _refresh(self, config_map: str) -> None:
        pass


class LargeExperiment(Experiment):
    def __init__(self, settings: Settings, folder: Path, say: Say) -> None:
        super().__init__(settings, folder, say)
        self._crossings = crowd.crossings(self._near)
        places = [crossing.point for crossing in self._crossings]
        origin = self._near.point
        self.passing = {
            route.vehicle: places.index((origin[0] + route.middle[0], origin[1] + route.middle[1]))
            for route in self._routes
        }

    def _start_cluster(self) -> None:
        vehicles = [route.vehicle for route in self._routes]
        first = Rig(CLUSTER, self._made("rig"), nodes=crowd.NODES, report=self._say)
        self._rig = self._stack.enter_context(first)
        second = Rig(crowd.FLEET, self._made("rig-fleet"), nodes=vehicles, git_of=first)
        fleet = self._stack.enter_context(second)
        self._rigs = {CLUSTER: self._rig, crowd.FLEET: fleet}
        self._domains = {"cloud": self._stack.enter_context(reserved())}
        self._say(f"two clusters are up, with {len(vehicles) + len(crowd.NODES)} nodes")

    def _start_fleet(self) -> None:
        world = self._start_world()
        world.push(crowd.files(self.passing.keys(), world.file("inventory/clusters.yaml")))
        world.generator.start()
        bootstrap = f"bootstrap/{crowd.FLEET}.yaml"
        self._wait("the second cluster's bootstrap file", lambda: self._exists(bootstrap))
        access, self._watches = {}, []
        for name, rig in self._rigs.items():
            domain = world.bootstrap(name, rig, url=rig.git_url(world.name))
            domain.wait_lines(WITHOUT_DEMANDS)  # waits also for what Kubernetes adds to a namespace
            rights = documented_roles("flux")
            folder = self._made(f"access-{name}")
            access[name] = {"kubeconfig": limited(rig.kube, rig.kubeconfig, folder, rights)}
            watch = PodWatch(rig.kube, domain.namespace, world.folder, self._made("pods"), {})
            self._stack.callback(watch.close)
            self._watches.append(watch)
        world.generator.stop()
        world.generator.start("--clusters", str(access_file(world.folder, access)))
        self._cloud = CloudObserver(self._domains["cloud"])
        self._cloud.start()
        self._stack.callback(self._cloud.close)

    def _deploy_initially(self) -> None:
        self._start_participants("", poses_only=True)
        self._before = self._lines()
        self._detect(crowd.rules(self._near))

    def _drive(self) -> Outcome:
        first = self._world.tip()
        self._drive_until(math.inf)
        set_off = self._read()["set_off"]
        last = max(route.ends for route in self._routes)
        self._say(f"{len(self._routes)} vehicles have set off; the last leaves after {last:.0f} s")
        deadline = time.monotonic() + last + 2 * self._near.timeout
        self._reaches(lambda: time.monotonic() > deadline, math.inf)
        passing = {vehicle: self._crossings[at] for vehicle, at in self.passing.items()}
        events = crowd.events(self._poses(), passing, time.time())
        self._wait("the last demands", lambda: len(self._commits(first)) >= len(events), 300)
        self._wait_until_as_before(300)
        return self._outcome(
            events,
            set_off=set_off,
            over=time.time(),
            formed=list(self._formed(first)),
            pods=[pod for watch in self._watches for pod in watch.pods.values()],
            crossings=self._crossings,
        )

    def _exists(self, path: str) -> bool:
        self._world.tip()  # updates the clone
        return (self._world.person.folder / path).exists()

    def _lines(self) -> frozenset[str]:
        domains = self._world.domains.items()
        return frozenset(f"{name}: {line}" for name, one in domains for line in one.lines())

    def _formed(self, since: str) -> Iterator[Formed]:
        """Yield each commit's demand, about :data:`_LOOKS` of them with the bookkeeping."""
        stages, commits = self._cloud.commits(), self._commits(since)
        looks = {*commits[:: max(1, len(commits) // _LOOKS)], *commits[-1:]}
        for commit in commits:
            operation, *requesters = self._trailers(commit)
            (vehicle,) = self.passing.keys() & set(requesters)
            read = self._bookkeeping(commit) if commit in looks else None
            yield Formed(commit, vehicle, operation == "join", stages.get(commit, {}), read)

    def _trailers(self, commit: str) -> list[str]:
        keys = "".join(f"%(trailers:key={key},valueonly)%n" for key in ("Operation", "Requester"))
        repository = self._rig.repository(self._world.name)
        return git(repository, "log", "-1", f"--format={keys}", commit).split()
