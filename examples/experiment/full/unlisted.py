"""The experiment with a fleet that nobody listed: files of `examples/experiment/unlisted/` alone.

One pattern in the inventory stands for all vehicles. The detector knows them from their CAMs. They
demand two applications, of which one is the user's own, and the fused objects come back to each
vehicle that asked for them.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection
from pathlib import Path
from typing import Any

import yaml
from geometry_msgs.msg import PoseArray, PoseStamped

from examples.experiment import paper

from . import fleet
from .checks import Check, arrivals, common, restarts
from .experiment import ROOT, Experiment, Say
from .observers import FUSED, Observer
from .outcome import Outcome, Settings
from .participants import STATION_CLOUD
from .rig import demandops, git, reserved
from .routes import crowd
from .rules import Event, Near

FILES = ROOT / "examples" / "experiment" / "unlisted"
FIXED = (paper.S, "edge", "cloud")
NEW = (
    *("new", "application", "convoy", "--image", "registry.example/convoy:1.0.0"),
    *("--input", "ego_data=geometry_msgs/msg/PoseStamped", "--service", "members=convoy/members"),
)
CONVOY = "members-edge-convoy-7d6c6b8145e7"
# The outputs that come back to the vehicles
BACK = {FUSED: PoseArray, "/edge_convoy_members": PoseStamped}


def requesters(inside: Collection[str]) -> dict[str, list[str]]:
    """Return the paper's rows, and those of what comes back."""
    rows = paper.requesters(inside)
    rows |= {f"connection edge to {vehicle}": sorted({paper.S, vehicle}) for vehicle in inside}
    if inside:
        rows["members edge/convoy"] = sorted({paper.S, *inside})
    return dict(sorted(rows.items()))


def checks(outcome: Outcome) -> list[Check]:
    return [
        *common(outcome, requesters),
        Check("the user's own application took in and lost vehicles without a restart",
              "; ".join(restarts(outcome, CONVOY))),
        *(
            Check(f"{topic} arrived at every vehicle while it was near, and only then",
                  "; ".join(arrivals(outcome, outcome.delivered.get(topic, {}))))
            for topic in BACK
        ),
    ]  # fmt: skip


class UnlistedExperiment(Experiment):
    def __init__(self, settings: Settings, folder: Path, say: Say) -> None:
        super().__init__(settings, folder, say)
        self._near = Near.read(FILES / "rules.yaml")
        # by the pattern, the number in a vehicle's name is its ROS domain
        free = (self._stack.enter_context(reserved()) for _ in range(settings.unlisted))
        self._domains = {f"vehicle{domain}": domain for domain in free}
        self._routes = crowd(settings.seed, settings.gap, tuple(self._domains))
        self._nodes = (*self._domains, *FIXED)

    def _files(self, ports: dict[str, int]) -> dict[str, str]:
        nodes = (FILES / "nodes.yaml").read_text()
        images = self._world.file("registry/images.yaml")
        own = fleet.files(nodes, images, self._domains, ports, self._settings.connections)
        return own | self._own_application()

    def _own_application(self) -> dict[str, str]:
        """Lay an application down as a user would, and install its node where the pods run."""
        checkout = self._world.person.folder
        demandops(self._made("author"), *NEW, "--directory", str(checkout))
        installed = self._made("image") / "convoy"
        installed.mkdir()
        shutil.copy(checkout / "appdefs/convoy/nodes/members.py", installed / "members")
        paths = git(checkout, "ls-files", "--others", "--exclude-standard").splitlines()
        return {path: (checkout / path).read_text() for path in paths}

    def _deploy_initially(self) -> None:
        """Start the detector, which hears the vehicles by radio: no connection is needed for it."""
        rules: dict[str, Any] = yaml.safe_load((FILES / "rules.yaml").read_text())
        on_earth = (rules["map"]["latitude"], rules["map"]["longitude"])
        self._start_participants(STATION_CLOUD, on_earth=on_earth)
        self._vehicles = {
            route.vehicle: self._observe(Vehicle(self._domains[route.vehicle]))
            for route in self._routes
        }
        self._before = self._lines()
        self._detect((FILES / "rules.yaml").read_text())

    def _is_settled(self, number: int, since: str) -> bool:
        event = self._events()[number - 1]
        came = self._vehicles[event.vehicle].arrivals
        return super()._is_settled(number, since) and (
            not event.joins or all(any(at > event.at for at in came[topic]) for topic in BACK)
        )

    def _outcome(self, events: list[Event], **more: Any) -> Outcome:
        delivered = {
            topic: {name: vehicle.arrivals[topic] for name, vehicle in self._vehicles.items()}
            for topic in BACK
        }
        return super()._outcome(events, delivered=delivered, **more)


class Vehicle(Observer):
    """Records when the outputs of the applications arrive at a vehicle."""

    def __init__(self, domain: int) -> None:
        super().__init__(domain)
        for topic, kind in BACK.items():
            self.watch(kind, topic)
