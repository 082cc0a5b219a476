"""The vehicles' routes through the intersection: made from a seed, or recorded.

The intersection, where the station is, is the origin of the map. Distances are in metres, times in
seconds since the vehicles set off.
"""

from __future__ import annotations

import math
import random
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

RADIUS_M = 84.0
"""The paper's distance at which a vehicle is near the intersection."""
FAR_M = 105.0
"""The distance from the intersection at which a route begins and ends."""
VEHICLES = ("vehicle00", "vehicle01", "vehicle02", "vehicle03")
STATION = "station00"

LEAD_S = 2.0
"""A recording begins this many seconds after the vehicles set off."""
MIDDLES = ((0.0, 0.0), (1000.0, 0.0), (0.0, 1000.0))
SPACING_S = 1.2
_SILENCE_S = 0.6
"""A recorded vehicle is silent when none of its poses was recorded within this many seconds."""

_PAPER = ("0", "1", "3", "2", "-0", "-1", "-2", "-3")
"""The order of events in the paper: `0` means that vehicle 0 joins, `-0` that it leaves."""
_SHORTEST_STAY = 3  # slots
_TOGETHER = 4
_JITTER = 0.2  # of a slot
_ARMS = tuple(math.radians(degrees) for degrees in (0, 90, 180, 270))


@dataclass(frozen=True)
class Route:
    """A vehicle's way along one arm of the intersection to its middle, and out along another arm.

    The vehicle is within ``RADIUS_M`` of the middle from the time ``enters`` to the time
    ``leaves``. It sends nothing from the time ``vanishes`` on. ``arm_in`` and ``arm_out`` are
    angles in radians. ``middle`` is the position of the intersection.
    """

    vehicle: str
    enters: float
    leaves: float
    arm_in: float
    arm_out: float
    vanishes: float = math.inf
    middle: tuple[float, float] = (0.0, 0.0)

    @property
    def speed(self) -> float:
        return 2 * RADIUS_M / (self.leaves - self.enters)

    @property
    def ends(self) -> float:
        return min(self.leaves, self.vanishes)

    @property
    def label(self) -> str:
        silent = ", falls silent" if math.isfinite(self.vanishes) else ""
        return f"{self.speed * 3.6:.0f} km/h{silent}"

    def position(self, time: float) -> tuple[float, float]:
        along = (time - self.enters) * self.speed - RADIUS_M  # negative before the middle
        along = min(max(along, -FAR_M), FAR_M)
        arm = self.arm_in if along < 0 else self.arm_out
        x, y = self.middle
        return x + abs(along) * math.cos(arm), y + abs(along) * math.sin(arm)

    def distance(self, time: float) -> float:
        return math.dist(self.position(time), self.middle)

    def sends(self, time: float) -> bool:
        return time < self.vanishes


@dataclass(frozen=True)
class Track:
    """A recorded way: points, each with a time, an x and a y, and straight lines between them.

    Until the time of the first point, the vehicle waits at that point. It is silent in the gaps of
    the recording.
    """

    vehicle: str
    points: tuple[tuple[float, float, float], ...]
    label: str = "recorded"

    @property
    def ends(self) -> float:
        return self.points[-1][0]

    def position(self, time: float) -> tuple[float, float]:
        (begin, x0, y0), (end, x1, y1) = self._around(time)
        part = min(max((time - begin) / (end - begin), 0.0), 1.0) if end > begin else 0.0
        return x0 + part * (x1 - x0), y0 + part * (y1 - y0)

    def sends(self, time: float) -> bool:
        before, after = self._around(time)
        nearest = min(abs(before[0] - time), abs(after[0] - time))
        return time < self.points[0][0] or nearest <= _SILENCE_S

    def _around(self, time: float) -> tuple[tuple[float, float, float], ...]:
        index = bisect_right(self.points, time, key=lambda point: point[0])
        last = len(self.points) - 1
        return self.points[max(index - 1, 0)], self.points[min(index, last)]


Way = Route | Track
"""Where a vehicle is at each time; nothing of interest happens after `ends`."""


def four(seed: int, gap: float) -> tuple[Route, ...]:
    """Return the routes of four vehicles, with about ``gap`` seconds from one event to the next.

    Seed 0 has the paper's order of events. Every other seed has an order of its own. The seed also
    decides the exact times, and by which arms of the intersection each vehicle comes and leaves.
    """
    chance = random.Random(seed)
    order = _PAPER if seed == 0 else _shuffled(chance)
    at = {
        event: (slot + 1 + chance.uniform(-_JITTER, _JITTER)) * gap
        for slot, event in enumerate(order)
    }
    return tuple(
        Route(vehicle, at[str(number)], at[f"-{number}"], *chance.sample(_ARMS, 2))
        for number, vehicle in enumerate(VEHICLES)
    )


def one(seed: int, gap: float) -> tuple[Route, ...]:
    arms = random.Random(seed).sample(_ARMS, 2)
    return (Route(VEHICLES[0], gap, 4 * gap, *arms),)


def many(seed: int, count: int) -> tuple[Route, ...]:
    """Return routes through ``MIDDLES``; every ``SPACING_S`` s one enters, at 20 to 50 km/h."""
    chance = random.Random(seed)
    found = []
    for number in range(count):
        enters = (number + 1 + chance.uniform(-_JITTER, _JITTER)) * SPACING_S
        leaves = enters + 2 * RADIUS_M / (chance.uniform(20, 50) / 3.6)
        arms = chance.sample(_ARMS, 2)
        middle = chance.choice(MIDDLES)
        found.append(Route(f"vehicle{number:03}", enters, leaves, *arms, middle=middle))
    return tuple(found)


def crowd(seed: int, gap: float, vehicles: Sequence[str]) -> tuple[Route, ...]:
    """Return routes of any number of vehicles, of which at most ``_TOGETHER`` are near at once."""
    chance = random.Random(seed)
    coming, slot = list(vehicles), 0
    inside: dict[str, int] = {}
    spans: dict[str, tuple[int, int]] = {}
    while coming or inside:
        long_there = [name for name, since in inside.items() if slot - since >= _SHORTEST_STAY]
        if coming and len(inside) < _TOGETHER and (not long_there or chance.random() < 0.6):
            inside[coming.pop(0)] = slot
        elif long_there:
            name = chance.choice(long_there)
            spans[name] = (inside.pop(name), slot)
        slot += 1
    moment = {at: (at + 1 + chance.uniform(-_JITTER, _JITTER)) * gap for at in range(slot)}
    return tuple(
        Route(name, moment[enters], moment[leaves], *chance.sample(_ARMS, 2))
        for name, (enters, leaves) in sorted(spans.items(), key=lambda item: item[1])
    )


def vanishing(routes: Sequence[Route], vehicle: str) -> tuple[Route, ...]:
    """Return the routes, changed so that ``vehicle`` falls silent while it is near.

    Shortly before an event, the experiment may stop all vehicles, and a stopped vehicle goes on
    sending. So ``vehicle`` falls silent in the middle of the longest time without other events.
    """
    (lost,) = (route for route in routes if route.vehicle == vehicle)
    moments = sorted(
        moment
        for route in routes
        for moment in (route.enters, route.leaves)
        if lost.enters <= moment <= lost.leaves
    )
    before, after = max(pairwise(moments), key=lambda pair: pair[1] - pair[0])
    silent = replace(lost, vanishes=(before + after) / 2)
    return tuple(silent if route is lost else route for route in routes)


def _shuffled(chance: random.Random) -> list[str]:
    """Return a random order of events; no stay is shorter than ``_SHORTEST_STAY`` slots."""
    numbers = range(len(VEHICLES))
    events = [*(str(number) for number in numbers), *(f"-{number}" for number in numbers)]
    while True:
        chance.shuffle(events)
        stays = (events.index(f"-{n}") - events.index(str(n)) for n in numbers)
        if all(stay >= _SHORTEST_STAY for stay in stays):
            return events
