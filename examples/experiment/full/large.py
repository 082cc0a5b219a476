"""The larger experiment: many vehicles, three intersections, two clusters.

The vehicles send only poses. One process sends all of them, in the cloud's ROS domain. The
detector, the generator's ROS node, Git, the GitOps controllers and the clusters are the same as in
the paper's experiment. No containers run, so no data flows.
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from examples.experiment import paper

from .checks import Check, check_nodes, differ
from .experiment import Experiment, Say
from .observers import CloudObserver
from .outcome import Formed, Outcome, Settings
from .process_runner import ProcessRunner
from .rig import (
    CLUSTER,
    WITHOUT_DEMANDS,
    Rig,
    access_file,
    documented_roles,
    git,
    limited,
    reserved,
)
from .routes import MIDDLES
from .rules import RULES, Event, Near, Pose, events_of

FLEET = "vehicles"
"""The cluster of the vehicles; all other nodes are in the skeleton's cluster."""
EDGES = tuple(f"edge{number:02}" for number in range(len(MIDDLES)))
STATIONS = tuple(f"station{number:02}" for number in range(len(MIDDLES)))
NODES = (*EDGES, *STATIONS, "cloud")


def crossings(near: Near) -> tuple[Near, ...]:
    """Return a nearness condition for each intersection; the first one is the paper's condition."""
    (x, y) = near.point
    return tuple(replace(near, point=(x + dx, y + dy)) for dx, dy in MIDDLES)


def files(vehicles: Collection[str], clusters: str) -> dict[str, str]:
    """Return the inventory's texts by path; `clusters` is the skeleton's `clusters.yaml`."""
    places: dict[str, Any] = yaml.safe_load(clusters)
    places["clusters"].append({"name": FLEET})
    kinds = dict.fromkeys(vehicles, "vehicle") | {node: node.rstrip("0123456789") for node in NODES}
    nodes = [
        {"id": node, "type": kind, "cluster": FLEET if kind == "vehicle" else CLUSTER}
        for node, kind in kinds.items()
    ]
    brokers = [{"node": edge, "host": edge, "port": 1883} for edge in EDGES]
    head = {"apiVersion": "demandops/v1"}
    return {
        "inventory/clusters.yaml": yaml.safe_dump(places),
        "inventory/nodes.yaml": yaml.safe_dump({**head, "kind": "Nodes", "nodes": nodes}),
        "inventory/brokers.yaml": yaml.safe_dump({**head, "kind": "Brokers", "brokers": brokers}),
    }


def rules(near: Near) -> str:
    """Return the example's last rule, for vehicles without a lidar, for each intersection."""
    found: dict[str, Any] = yaml.safe_load(RULES.read_text())
    text = yaml.safe_dump(found["rules"][-1])
    found["rules"] = []
    for number, crossing in enumerate(crossings(near)):
        rule = yaml.safe_load(text.replace("station00", STATIONS[number]))
        rule = yaml.safe_load(
            yaml.safe_dump(rule)
            .replace("/edge", f"/{EDGES[number]}")
            .replace(": edge\n", f": {EDGES[number]}\n")
            .replace("edge/", f"{EDGES[number]}/")
        )
        x, y = crossing.point
        rule |= {"name": f"at-{STATIONS[number]}", "entities": ["vehicle*"]}
        rule["near"]["point"] = {"x": x, "y": y}
        found["rules"].append(rule)
    return yaml.safe_dump(found)


def crossing_events(
    poses: Iterable[Pose], passing: Mapping[str, Near], until: float
) -> list[Event]:
    """Return the events before `until` in order; `passing` maps vehicles to their intersections."""
    own: defaultdict[Near, list[Pose]] = defaultdict(list)
    for pose in poses:
        own[passing[pose.vehicle]].append(pose)
    found = [event for near, some in own.items() for event in events_of(some, near, until)]
    return sorted(found, key=lambda event: event.at)


def requesters(inside: Mapping[str, int]) -> dict[str, list[str]]:
    """Return the requesters while each vehicle is near the intersection of this number."""
    rows: dict[str, list[str]] = {}
    for number, (edge, station) in enumerate(zip(EDGES, STATIONS, strict=True)):
        near = [vehicle for vehicle, at in inside.items() if at == number]
        rows |= paper.requesters(near, edge, station)
    return dict(sorted(rows.items()))


def checks(outcome: Outcome, passing: Mapping[str, int]) -> list[Check]:
    """Return the checks of a run in which no container runs and no data flows."""
    return [
        Check("the detector formed the demands that a plain script over the poses gives",
              differ(_by_vehicle(outcome.events), _by_vehicle(outcome.formed))),
        Check("at the commits whose bookkeeping was read, the requesters of every service and "
              "connection are right", "; ".join(_requesters(outcome.formed, passing))),
        Check("every pod ran on the node that it was for", "; ".join(check_nodes(outcome))),
        Check("at the end both clusters are as before",
              differ(sorted(outcome.before), sorted(outcome.left))),
    ]  # fmt: skip


def _by_vehicle(found: Iterable[Event] | Iterable[Formed]) -> dict[str, list[bool]]:
    """Return each vehicle's joins (true) and leaves (false) in order."""
    by_vehicle: defaultdict[str, list[bool]] = defaultdict(list)
    for one in found:
        by_vehicle[one.vehicle].append(one.joins)
    return dict(sorted(by_vehicle.items()))


def _requesters(formed: Iterable[Formed], passing: Mapping[str, int]) -> Iterator[str]:
    inside: dict[str, int] = {}
    for one in formed:
        if one.joins:
            inside[one.vehicle] = passing[one.vehicle]
        else:
            inside.pop(one.vehicle, None)
        if one.bookkeeping is not None and (fault := differ(requesters(inside), one.bookkeeping)):
            yield f"{one}: {fault}"


# ---- the run ----

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
        self._crossings = crossings(self._near)
        places = [crossing.point for crossing in self._crossings]
        origin = self._near.point
        self.passing = {
            route.vehicle: places.index((origin[0] + route.middle[0], origin[1] + route.middle[1]))
            for route in self._routes
        }

    def _start_cluster(self) -> None:
        vehicles = [route.vehicle for route in self._routes]
        first = Rig(CLUSTER, self._made("rig"), nodes=NODES, report=self._say)
        self._rig = self._stack.enter_context(first)
        second = Rig(FLEET, self._made("rig-fleet"), nodes=vehicles, git_of=first)
        fleet = self._stack.enter_context(second)
        self._rigs = {CLUSTER: self._rig, FLEET: fleet}
        self._domains = {"cloud": self._stack.enter_context(reserved())}
        self._say(f"two clusters are up, with {len(vehicles) + len(NODES)} nodes")

    def _start_fleet(self) -> None:
        world = self._start_world()
        world.push(files(self.passing.keys(), world.file("inventory/clusters.yaml")))
        world.generator.start()
        bootstrap = f"bootstrap/{FLEET}.yaml"
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
        self._detect(rules(self._near))

    def _drive(self) -> Outcome:
        first = self._world.tip()
        self._drive_until(math.inf)
        set_off = self._read()["set_off"]
        last = max(route.ends for route in self._routes)
        self._say(f"{len(self._routes)} vehicles have set off; the last leaves after {last:.0f} s")
        deadline = time.monotonic() + last + 2 * self._near.timeout
        self._reaches(lambda: time.monotonic() > deadline, math.inf)
        passing = {vehicle: self._crossings[at] for vehicle, at in self.passing.items()}
        events = crossing_events(self._poses(), passing, time.time())
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
