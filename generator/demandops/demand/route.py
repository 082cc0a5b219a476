"""One topic of a connection: from which name to which, which way, and how it is carried.

A :class:`Route` is what requests ask for, claims hold and clients are configured from. Which
type of connection can honour which option is :mod:`demandops.demand.transport_choice`'; here is
only what a route may say at all. :func:`parse` is for every parser that takes
options from outside: the ledger's files, and messages that have them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationError

from demandops.config.base_model import FrozenModel, faults_of
from demandops.errors import Fault, fault, quoted
from demandops.identifiers import message_type_problem, topic_problem


@dataclass(frozen=True, slots=True)
class Route:
    """One topic that a connection carries.

    ``source`` is its name on the source node, ``target`` on the target node; with ``reverse`` it
    is carried from the target to the source. ``type`` is the ROS message type
    (``std_msgs/msg/String``), empty where it is not said. Of the options each default leaves the
    client's own behaviour: ``qos`` (MQTT, 0 to 2), ``retained`` and ``primitive`` (MQTT),
    ``reliability``, ``durability`` and ``queue`` (of the ROS endpoints), ``rate`` (most messages
    a second, in Hz; 0 for all).
    """

    source: str
    target: str
    type: str = ""
    reverse: bool = False
    qos: int = 0
    retained: bool = False
    primitive: bool = False
    reliability: str = ""
    durability: str = ""
    queue: int = 0
    rate: float = 0.0

    def options(self) -> dict[str, Any]:
        """Return what is not as by default, besides the two names."""
        return {
            name: value for name, default in _DEFAULTS if (value := getattr(self, name)) != default
        }

    @property
    def read_topic(self) -> str:
        """The topic that is read, at the end where messages come from."""
        return self.target if self.reverse else self.source

    @property
    def written_topic(self) -> str:
        """The topic that is written, at the end where messages arrive."""
        return self.source if self.reverse else self.target

    def sender_and_receiver(self, source: str, target: str) -> tuple[str, str]:
        """Return the nodes that messages come from and arrive at, of a connection's two ends."""
        return (target, source) if self.reverse else (source, target)


_DEFAULTS = tuple(
    (item.name, item.default) for item in fields(Route) if item.name not in ("source", "target")
)


def _message_type(value: str) -> str:
    if value and message_type_problem(value):
        raise ValueError(message_type_problem(value))
    return value


MessageType = Annotated[str, AfterValidator(_message_type)]


class RouteOptions(FrozenModel):
    """The options of a route as they come from outside; each default is that of :class:`Route`."""

    type: MessageType = ""
    reverse: bool = False
    qos: Annotated[int, Field(ge=0, le=2)] = 0
    retained: bool = False
    primitive: bool = False
    reliability: Literal["", "reliable", "best_effort"] = ""
    durability: Literal["", "volatile", "transient_local"] = ""
    queue: Annotated[int, Field(ge=0, le=100_000)] = 0
    rate: Annotated[float, Field(ge=0, le=100_000, allow_inf_nan=False, strict=False)] = 0.0

    def route(self, source: str, target: str) -> Route:
        """Return the route from ``source`` to ``target`` with these options."""
        return Route(source, target, **self.model_dump(include=set(RouteOptions.model_fields)))


def parse(
    where: str, source: str, target: str, options: Mapping[str, object]
) -> tuple[Route, list[Fault]]:
    """Return a route of options that came from outside, and what is wrong with them.

    Args:
        where: the field that holds them, for faults (``connections[0].topics[2]``).
        source, target: the topic's names at both ends, absolute.
        options: by the names of :class:`RouteOptions`; what is left out is as by default.

    Returns:
        The route, without the options that are faulty; it must not be booked where there are any.
    """
    try:
        return RouteOptions.model_validate(dict(options)).route(source, target), []
    except ValidationError as error:
        faults = faults_of(error, RouteOptions)
        bad = {found.field for found in faults}
        sound = {name: value for name, value in options.items() if name not in bad}
        return (
            RouteOptions.model_validate(sound).route(source, target),
            [fault(f"{where}.{found.field}", found.message) for found in faults],
        )


def faults(where: str, routes: Iterable[Route]) -> Iterator[Fault]:
    """Yield what the routes of one connection break, whatever carries them."""
    targets: dict[str, Route] = {}
    read_back: dict[str, str] = {}
    for index, route in enumerate(routes):
        for side, name in (("source", route.source), ("target", route.target)):
            problem = topic_problem(name)
            if problem:
                yield fault(f"{where}[{index}].{side}", problem)
        first = targets.setdefault(route.source, route)
        if first.target != route.target:
            yield fault(
                f"{where}[{index}].target",
                f"{quoted(route.source)} goes to {quoted(first.target)} and to "
                f"{quoted(route.target)}; one source topic has one target, use a second connection",
            )
        for name, stands, asked in contradictions(first, route):
            yield fault(
                f"{where}[{index}].{name}",
                f"{quoted(route.source)} is listed with {name} {stands} and {asked}; list it once",
            )
        if route.reverse and read_back.setdefault(route.target, route.source) != route.source:
            yield fault(
                f"{where}[{index}].target",
                f"{quoted(route.target)} is carried back to {quoted(read_back[route.target])} and "
                f"to {quoted(route.source)}; one topic goes to one place, use a second connection",
            )


def contradictions(one: Route, other: Route) -> Iterator[tuple[str, object, object]]:
    """Yield (option, its value in one, in the other) where two routes contradict each other.

    A message type that is not said contradicts none.
    """
    for name, _ in _DEFAULTS:
        first, second = getattr(one, name), getattr(other, name)
        if first == second or (name == "type" and not (first and second)):
            continue
        yield name, _written(first), _written(second)


def _written(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else f"{value!r}"


def merge_routes(routes: Iterable[Route]) -> dict[str, Route]:
    """Return routes by source topic, sorted; a type that one of them says holds for all."""
    found: dict[str, Route] = {}
    for route in routes:
        known = found.get(route.source)
        if known is None or (route.type and not known.type):
            found[route.source] = route
    return dict(sorted(found.items()))
