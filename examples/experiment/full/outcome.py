"""The settings of a run, all observations of it, and what follows from them: times and savings."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from statistics import median

from . import routes
from .fleet import CLIENTS, Carrier, is_client
from .process_runner import RunningPod
from .rig import Gitops
from .routes import Way
from .rules import Event, Near, Pose


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
    unlisted: int = 0
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
    # what came back, by topic and vehicle
    delivered: dict[str, dict[str, list[float]]] = field(default_factory=dict)
    carried: dict[str, int] = field(default_factory=dict)
    crossings: tuple[Near, ...] = ()
    """All intersections of the larger experiment; empty in the paper's experiment."""


# ---- measures ----

STAGES = ("demand", "commit", "pods", "fused")


@dataclass(frozen=True)
class Step:
    """An event, and the times of its consequences; None for a consequence that did not come.

    - `demand`: the demand was accepted.
    - `commit`: the demand's commit was published.
    - `pods`: after a join, the last pod of the vehicle's connection got its node; after a leave,
      all pods of the connection had ended.
    - `first`: the first fused message had the vehicle's ego data; None after a leave.
    - `gone`: all pods that came with a join had ended, after a later leave; None for a leave.
    """

    event: Event
    demand: float | None = None
    commit: float | None = None
    pods: float | None = None
    first: float | None = None
    gone: float | None = None

    def delays(self) -> dict[str, float]:
        """Return the seconds from the event to each consequence, by its name in `STAGES`."""
        found = zip(STAGES, (self.demand, self.commit, self.pods, self.first), strict=True)
        return {name: at - self.event.at for name, at in found if at is not None}


def steps(outcome: Outcome) -> list[Step]:
    """Return each event that led to a demand, with the times of its consequences."""
    formed: defaultdict[str, list[Formed]] = defaultdict(list)
    for one in outcome.formed:
        formed[str(one)].append(one)
    return [
        _step(outcome, event, formed[str(event)].pop(0))
        for event in outcome.events
        if formed[str(event)]
    ]


def _step(outcome: Outcome, event: Event, formed: Formed) -> Step:
    commit = formed.stages.get("pushed", formed.stages.get("committed"))
    pods = _pods_of(outcome, event)
    ends = [pod.ended for pod in pods if pod.ended is not None]
    gone = max(ends) if len(ends) == len(pods) and ends else None
    if not event.joins:
        return Step(event, formed.stages.get("admitted"), commit, gone)
    bound = max((pod.bound for pod in pods), default=None)
    first = _first_fused(outcome, event, gone)
    return Step(event, formed.stages.get("admitted"), commit, bound, first, gone)


def _pods_of(outcome: Outcome, event: Event) -> list[RunningPod]:
    """Return the pods of the vehicle's connection; the event is the start or end of its visit."""
    carrier = outcome.settings.connections
    pods = [pod for pod in outcome.pods if is_client(pod.service, event.vehicle, carrier)]
    if event.joins:
        return [pod for pod in pods if pod.bound >= event.at][: CLIENTS[carrier]]
    return [pod for pod in pods if pod.bound <= event.at][-CLIENTS[carrier] :]


def _first_fused(outcome: Outcome, event: Event, gone: float | None) -> float | None:
    places = {
        (pose.x, pose.y)
        for pose in outcome.poses
        if pose.vehicle == event.vehicle and event.at <= pose.at <= (gone or outcome.over)
    }
    arrived = (at for at, seen in outcome.tracks if at >= event.at and places & set(seen))
    return next(arrived, None)


@dataclass(frozen=True)
class Saving:
    """The mean of a quantity during the drive: with services on demand, and with all always on."""

    name: str
    unit: str
    on_demand: float
    always: float

    @property
    def saved(self) -> float:
        """How much services on demand save, as a share of ``always``."""
        return 1 - self.on_demand / self.always if self.always else 0.0


def savings(outcome: Outcome) -> list[Saving]:
    """Return what the services used during the drive, and what they would use if always on.

    "Always on" means: each service that ran at all runs during the whole drive, and each topic that
    was carried to the edge is carried with all its messages.
    """
    seconds = outcome.over - outcome.set_off
    services: dict[str, RunningPod] = {pod.service: pod for pod in outcome.pods}

    def mean(amount: Callable[[RunningPod], float]) -> float:
        lifetimes = ((pod.ended or outcome.over) - pod.bound for pod in outcome.pods)
        used = zip(outcome.pods, lifetimes, strict=True)
        return sum(amount(pod) * lifetime for pod, lifetime in used) / seconds

    def always(amount: Callable[[RunningPod], float]) -> float:
        return sum(amount(pod) for pod in services.values())

    amounts: list[tuple[str, str, Callable[[RunningPod], float]]] = [
        ("pods", "", lambda _: 1.0),
        ("requested processor", "cores", lambda pod: pod.requests()[0]),
        ("requested memory", "MiB", lambda pod: pod.requests()[1] / 2**20),
    ]
    found = [Saving(name, unit, mean(use), always(use)) for name, unit, use in amounts]
    if not outcome.carried:
        return found
    topics = _payload(outcome)
    carried = sum(topics.values())
    published = sum(outcome.published.get(topic, 0) for topic in topics)
    rate = [size / seconds / 1024 for size in (carried, published)]
    return [*found, Saving("carried to the edge", "KiB/s", *rate)]


def _payload(outcome: Outcome) -> dict[str, int]:
    """Return how many bytes of each topic were carried to the edge, by its name at the source."""
    found: defaultdict[str, int] = defaultdict(int)
    for topic, size in outcome.carried.items():
        ros_topic = "/" + topic.partition("/")[2]
        is_own = topic.startswith(("mqtt_client/", "$SYS/"))
        if ros_topic in outcome.published and not is_own:  # else it comes from the edge
            found[ros_topic] += size
    return dict(found)


def running(outcome: Outcome) -> Iterator[tuple[float, int]]:
    """Yield the time and the new number of running pods whenever the number changes."""
    changes = [(pod.bound, 1) for pod in outcome.pods]
    changes += [(pod.ended, -1) for pod in outcome.pods if pod.ended is not None]
    count = 0
    for at, change in sorted(changes):
        count += change
        yield at, count


def quantiles(values: Sequence[float]) -> tuple[float, float, float]:
    return min(values), median(values), max(values)
