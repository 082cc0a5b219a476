"""One run of the experiment: it starts all parts, lets the vehicles drive, and observes."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from examples.experiment import paper

from . import fleet, routes
from .observers import Broker, CloudObserver, EdgeObserver
from .outcome import Formed, Outcome, Settings
from .participants import POSE, Plan
from .process_runner import ProcessRunner
from .rig import (
    CLUSTER,
    ENDS_WITH_US,
    PATIENCE_S,
    Client,
    Rig,
    World,
    demandops,
    environment,
    git,
    limited_world,
    reserved,
)
from .rules import Event, Near, Pose, causes, events_of, poses_in, predicted
from .standins import image

ROOT = Path(__file__).resolve().parents[3]
_STAND_S = 0.5
"""How many seconds before an event's cause the vehicles stop, to wait for the event before it."""
_INITIAL = tuple(f"mqtt-{vehicle}-cloud-" for vehicle in routes.VEHICLES)

Say = Callable[[str], None]


class Experiment:
    def __init__(self, settings: Settings, folder: Path, say: Say) -> None:
        self._settings, self._folder, self._say = settings, folder, say
        self._near, self._routes = Near.read(), settings.routes()
        self._nodes: tuple[str, ...] = fleet.NODES
        self._domains: dict[str, int] = {}
        self._stack = ExitStack()

    def run(self) -> Outcome:
        with self._stack:
            self._start_cluster()
            self._start_fleet()
            self._deploy_initially()
            return self._drive()

    def _start_cluster(self) -> None:
        folder, gitops = self._made("rig"), self._settings.gitops
        rig = Rig(CLUSTER, folder, gitops=gitops, nodes=self._nodes, report=self._say)
        self._rig = self._stack.enter_context(rig)
        self._rigs = {CLUSTER: rig}
        self._say("the cluster is up")
        for node in self._nodes:
            if node not in self._domains:
                self._domains[node] = self._stack.enter_context(reserved())
        self._brokers = {node: Broker(self._made(f"broker-{node}")) for node in ("cloud", "edge")}
        for broker in self._brokers.values():
            self._stack.callback(broker.close)

    def _start_world(self) -> World:
        client = Client(self._domains["cloud"])
        self._stack.callback(client.close)
        folder = self._made("generator")
        self._world = World(self._rig, folder, self._domains["cloud"], client)
        self._stack.callback(self._world.generator.stop)
        return self._world

    def _start_fleet(self) -> None:
        rig, world = self._rig, self._start_world()
        world.push(self._files({node: broker.port for node, broker in self._brokers.items()}))
        limited_world(world, rig)
        self._runner = ProcessRunner(
            rig.kube,
            world.domain.namespace,
            image(self._made("image")),
            self._made("pods"),
            environment(self._made("containers")) | {"PYTHONPATH": _python_path()},
        )
        self._stack.callback(self._runner.close)
        vehicles = [route.vehicle for route in self._routes]
        self._edge = self._observe(EdgeObserver(self._domains["edge"], vehicles))
        self._cloud = self._observe(CloudObserver(self._domains["cloud"], vehicles))

    def _files(self, ports: dict[str, int]) -> dict[str, str]:
        """Return the fleet's files of the state repo, for brokers at these ports."""
        paths = ("inventory/nodes.yaml", "registry/images.yaml")
        carrier = self._settings.connections
        return fleet.files(*map(self._world.file, paths), self._domains, ports, carrier)

    def _observe(self, observer: Any) -> Any:
        observer.start()
        self._stack.callback(observer.close)
        return observer

    def _deploy_initially(self) -> None:
        """Let connections carry the vehicles' poses to the cloud, and start the detector there."""
        self._start_participants(fleet.station_cloud(self._settings.connections))
        vehicles = [route.vehicle for route in self._routes]
        self._world.demand(fleet.initial_deployment(vehicles))
        for vehicle in vehicles:
            self._wait(
                f"poses of {vehicle} in the cloud",
                lambda v=vehicle: len(self._cloud.arrivals[POSE.format(v)]) > 0,
            )
        self._wait("the pods of the initial deployment", self._is_ready)
        self._before = self._lines()
        self._say("the initial deployment carries the vehicles' poses to the cloud")
        self._detect(fleet.rules(self._settings.connections))

    def _start_participants(self, station_cloud: str, **more: Any) -> None:
        record, file = str(self._folder / "poses.jsonl"), self._folder / "plan.json"
        seed, origin = self._settings.seed, self._near.point
        Plan(self._routes, origin, self._domains, seed, record, station_cloud, **more).write(file)
        self._participants = self._start(
            "participants", "examples.experiment.full.participants", str(file)
        )
        assert self._read()["ready"]

    def _detect(self, rules: str) -> None:
        file = self._folder / "rules.yaml"
        file.write_text(rules)
        options = ["detect", str(file)]
        self._detector = self._start("detector", "demandops.cli.main", *options, domain="cloud")
        self._wait("the detector's start", lambda: "detecting; rules: " in self._log("detector"))

    def _drive(self) -> Outcome:
        first_commit, early = self._world.tip(), self._arrived()
        last = max(route.ends for route in self._routes) + 2 * self._near.timeout
        happens = causes(predicted(self._routes, self._near, last), self._near, last)
        assert happens, "no vehicle comes near"
        self._drive_until(_stand(happens, 1))
        set_off = self._read()["set_off"]
        self._say(f"the vehicles have set off; the last one leaves after {happens[-1]:.0f} s")
        for number in range(1, len(happens) + 1):
            self._drive_until(_stand(happens, number))
            patience = happens[-1] + PATIENCE_S
            self._wait(f"event {number}", lambda n=number: len(self._events()) >= n, patience)
            event = self._events()[number - 1]
            if not self._reaches(lambda n=number: self._is_settled(n, first_commit), PATIENCE_S):
                self._say(f"'{event}' did not have all its consequences; the drive goes on")
        self._wait("the last demands", lambda: self._released(first_commit, len(happens)))
        self._wait_until_as_before(PATIENCE_S)
        time.sleep(2.0)  # time for messages that must not come
        over = time.time()
        return self._outcome(
            events_of(self._poses(), self._near, over),
            set_off=set_off,
            over=over,
            formed=list(self._formed(first_commit)),
            pods=[
                pod for pod in self._runner.pods.values() if not pod.service.startswith(_INITIAL)
            ],
            inputs=self._edge.inputs,
            tracks=self._edge.tracks,
            arrivals=dict(self._edge.arrivals),
            early=early,
            carried=self._carried(),
        )

    def _outcome(self, events: list[Event], **more: Any) -> Outcome:
        """End detector and participants; return the outcome with what all runs observe."""
        left = self._lines()
        self._detector.send_signal(signal.SIGTERM)
        self._detector.wait(PATIENCE_S)
        self._participants.send_signal(signal.SIGTERM)
        said = self._read()
        return Outcome(
            settings=self._settings,
            routes=self._routes,
            near=self._near,
            poses=self._poses(),
            events=events,
            node_ids=self._node_ids(),
            held=said["held"],
            published=said["sent"],
            left=left,
            before=self._before,
            **more,
        )

    # --- observing --------------------------------------------------------------------------

    def _events(self) -> list[Event]:
        return events_of(self._poses(), self._near, time.time())

    def _poses(self) -> list[Pose]:
        return poses_in(self._folder / "poses.jsonl")

    def _arrived(self) -> int:
        return sum(map(len, self._edge.arrivals.values()))

    def _commits(self, since: str) -> list[str]:
        repository = self._rig.repository(self._world.name)
        return git(repository, "rev-list", "--reverse", f"{since}..main").split()

    def _released(self, since: str, expected: int) -> bool:
        """Return whether all commits are made, and only the initial deployment is booked."""
        return len(self._commits(since)) >= expected and not self._bookkeeping(self._world.tip())

    def _is_settled(self, number: int, since: str) -> bool:
        """Return whether the first `number` events have had their consequences.

        Their demands are committed, and the fusion reads the right topics. After a join, the
        vehicle's data is fused. After a leave, the clients of the vehicle's connection have ended.
        """
        events = self._events()[:number]
        inside: set[str] = set()
        for event in events:
            inside ^= {event.vehicle}
        if len(self._commits(since)) < number:
            return False
        if self._edge.inputs[-1][1] != fleet.fusion_inputs(inside):
            return False
        return self._is_fused(events[-1]) if events[-1].joins else not self._runs(events[-1])

    def _is_fused(self, event: Event) -> bool:
        own = {(p.x, p.y) for p in self._poses() if p.vehicle == event.vehicle and p.at >= event.at}
        return any(at >= event.at and own & set(seen) for at, seen in list(self._edge.tracks))

    def _runs(self, event: Event) -> bool:
        carrier = self._settings.connections
        running = [pod for pod in list(self._runner.pods.values()) if pod.ended is None]
        return any(fleet.is_client(pod.service, event.vehicle, carrier) for pod in running)

    def _carried(self) -> dict[str, int]:
        if self._settings.connections == "mqtt":
            return dict(self._brokers["edge"].bytes)
        return {f"zenoh{topic}": size for topic, size in self._edge.bytes.items()}

    def _is_ready(self) -> bool:
        pods = [line for line in self._world.domain.lines() if line.startswith("pod of ")]
        return all(line.endswith(", ready") for line in pods)

    def _lines(self) -> frozenset[str]:
        return self._world.domain.lines()

    def _wait_until_as_before(self, seconds: float) -> None:
        if not self._reaches(lambda: self._lines() == self._before, seconds):
            lines = self._lines()
            stays, lacks = sorted(lines - self._before), sorted(self._before - lines)
            raise AssertionError(f"after {seconds:.0f} s, left over: {stays}; missing: {lacks}")

    def _bookkeeping(self, commit: str) -> dict[str, list[str]]:
        """Return the requesters after a commit, without the initial deployment."""
        repository = str(self._rig.repository(self._world.name))
        options = ("--state-repo", repository, "--at", commit, "--output", "json")
        printed = json.loads(demandops(self._made("reader"), "bookkeeping", *options))
        rows = paper.observed(printed)
        return {row: who for row, who in rows.items() if not row.endswith(" to cloud")}

    def _formed(self, since: str) -> Iterator[Formed]:
        """Yield a demand for each vehicle that joins or leaves the requesters in a commit."""
        stages, inside = self._cloud.commits(), set()
        for commit in self._commits(since):
            read = self._bookkeeping(commit)
            now = {who for whos in read.values() for who in whos} & self._domains.keys() - {paper.S}
            for vehicle in sorted(now ^ inside):
                yield Formed(commit, vehicle, vehicle in now, stages.get(commit, {}), read)
            inside = now

    def _node_ids(self) -> dict[str, str]:
        rigs = self._rigs.values()
        nodes = [node["metadata"] for rig in rigs for node in rig.kube.find("Node")]
        return {node["name"]: node["labels"].get("node_id", "") for node in nodes}

    # --- processes --------------------------------------------------------------------------

    def _start(self, name: str, module: str, *arguments: str, domain: str = "") -> Any:
        given = environment(self._made(name)) | {"PYTHONPATH": _python_path()}
        if domain:
            given["ROS_DOMAIN_ID"] = str(self._domains[domain])
        with (self._folder / f"{name}.log").open("w") as log:
            process = subprocess.Popen(
                [*ENDS_WITH_US, sys.executable, "-m", module, *arguments],
                env=given,
                cwd=ROOT,
                stdin=subprocess.PIPE,
                stdout=log if domain else subprocess.PIPE,
                stderr=log,
                text=True,
            )
        self._stack.callback(lambda: (process.kill(), process.wait(PATIENCE_S)))
        return process

    def _drive_until(self, moment: float) -> None:
        """Let the vehicles drive until a time, in seconds of driving."""
        self._participants.stdin.write(f"{moment}\n")
        self._participants.stdin.flush()

    def _read(self) -> dict[str, Any]:
        line = self._participants.stdout.readline()
        assert line, f"the participants ended: {self._log('participants')}"
        return dict(json.loads(line))

    def _log(self, name: str) -> str:
        return (self._folder / f"{name}.log").read_text()

    def _wait(self, what: str, holds: Callable[[], bool], seconds: float = PATIENCE_S) -> None:
        assert self._reaches(holds, seconds), f"{what} did not come within {seconds:.0f} s"

    def _reaches(self, holds: Callable[[], bool], seconds: float) -> bool:
        deadline = time.monotonic() + seconds
        while not holds():
            self._rig.parts.check()
            for name in ("participants", "detector"):
                process = getattr(self, f"_{name}", None)
                assert process is None or process.poll() is None, f"{name}: {self._log(name)}"
            if time.monotonic() > deadline:
                return False
            time.sleep(0.1)
        return True

    def _made(self, name: str) -> Path:
        folder = self._folder / name
        folder.mkdir(parents=True, exist_ok=True)
        return folder


def _stand(happens: list[float], number: int) -> float:
    """Return the time shortly before the cause of the event after the first `number`."""
    if number == len(happens):
        return math.inf
    before, after = happens[number - 1 : number + 1]
    return after - min(_STAND_S, (after - before) / 2)


def _python_path() -> str:
    return os.pathsep.join(str(ROOT / part) for part in ("", "generator", "ros_bridge"))
