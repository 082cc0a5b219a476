"""The settings of a run, and all observations of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from . import routes
from .fleet import Carrier
from .process_runner import RunningPod
from .routes import Way
from .rules import Event, Near, Pose

if TYPE_CHECKING:
    from tests.e2e.rig.cluster import Gitops


@dataclass(frozen=True)
class Settings:
    """What a run plays: routes made from a seed, or the tracks of a bag."""

    gitops: Gitops = "flux"
    connections: Carrier = "mqtt"
    seed: int = 0
    gap: float = 10.0
    short: bool = False
    vanish: str = ""
    bag: str = ""
    large: int = 0
    tracks: tuple[Way, ...] = ()

    def routes(self) -> tuple[Way, ...]:
        if self.tracks:
            return self.tracks
        if self.large:
            return routes.many(self.seed, self.large)
        found = routes.one(self.seed, self.gap) if self.short else routes.four(self.seed, self.gap)
        return routes.vanishing(found, self.vanish) if self.vanish else found


@dataclass(frozen=True)
class Formed:
    """A demand that the detector formed: its commit, and when it reached each stage.

    `bookkeeping` has the requesters of each service and connection after the commit; None if it was
    not read at this commit.
    """

    commit: str
    vehicle: str
    joins: bool
    stages: dict[str, float]
    bookkeeping: dict[str, list[str]] | None

    def __str__(self) -> str:
        return f"{self.vehicle} {'joins' if self.joins else 'leaves'}"


@dataclass(frozen=True)
class Outcome:
    settings: Settings
    routes: tuple[Way, ...]
    near: Near
    set_off: float
    over: float
    poses: list[Pose]
    events: list[Event]
    formed: list[Formed]
    left: frozenset[str]
    before: frozenset[str]
    pods: list[RunningPod] = field(default_factory=list)
    node_ids: dict[str, str] = field(default_factory=dict)
    published: dict[str, int] = field(default_factory=dict)
    held: float = 0.0
    early: int = 0
    # what the edge received; empty in the larger experiment
    inputs: list[tuple[float, frozenset[str]]] = field(default_factory=list)
    tracks: list[tuple[float, list[tuple[float, float]]]] = field(default_factory=list)
    arrivals: dict[str, list[float]] = field(default_factory=dict)
    carried: dict[str, int] = field(default_factory=dict)
    crossings: tuple[Near, ...] = ()
    """All intersections of the larger experiment; empty in the paper's experiment."""
