"""The file of rules for the event detector, and what a rule demands."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from types import MappingProxyType
from typing import Annotated, Any, Literal, NamedTuple, TypeAlias

from pydantic import Field, model_validator

from demandops.base.errors import Fault, InvalidInput, fault, suggestion
from demandops.base.naming import message_type_problem
from demandops.base.placeholders import filled, names, texts, unknown_names, values_in
from demandops.base.quoting import quoted
from demandops.base.settings import API_VERSION
from demandops.base.strict_yaml import located_in
from demandops.detect import condition as conditions
from demandops.detect.condition import Count, FieldPath, Hours, Near, Number, Threshold, Together
from demandops.detect.map_frame import MapFrame
from demandops.model.config import base_model
from demandops.model.config.base_model import CamelModel, DnsLabel, FileModel, Items, Text, matches
from demandops.model.config.policy import Duration, Patterns
from demandops.model.demand.goals import form_faults

# The values of the placeholders in a demand
Values = Mapping[str, str | float]

# ---- what a rule demands: a template for goals that start, renew and end a demand ----
#
# The template also recognizes which demands in the bookkeeping the rule has made, so that a restart
# of the detector changes nothing.

# the names of the ROS actions
Action = Literal["Demand", "DeploymentRequest"]
# What a goal of ``Demand`` also has in a file.
_HEAD = {"apiVersion": API_VERSION, "kind": "Demand"}


# A demand in the bookkeeping: its action, its id there, and its requesters.
BookedDemand = tuple[Action, str, Sequence[str]]


@dataclass(frozen=True, slots=True)
class Goal:
    """A goal, or a rule's template for goals, whose texts have names in braces."""

    action: Action
    data: Mapping[str, Any]

    @property
    def id(self) -> str:
        return str(self.data.get("demand" if self.action == "Demand" else "id", ""))

    @property
    def requesters(self) -> tuple[str, ...]:
        lists = requester_lists(self.action, self.data)
        return tuple(sorted({id for _, ids in lists for id in ids}))

    @property
    def document(self) -> Mapping[str, Any]:
        """The goal in the form that a file for ``demandops demand`` has."""
        return {**_HEAD, **self.data} if self.action == "Demand" else self.data

    def ended(self) -> Goal:
        if self.action == "DeploymentRequest":
            return Goal(self.action, {**self.data, "shutdown": True})
        return Goal(self.action, {**self._identity(), "operation": "release"})

    def renewed(self) -> Goal:
        if self.action == "DeploymentRequest":
            return self  # the same request again renews the leases of its claims
        return Goal(self.action, {**self._identity(), "operation": "renew"})

    def _identity(self) -> dict[str, Any]:
        return {name: self.data[name] for name in ("demand", "requesters")}

    def filled(self, values: Values) -> Goal:
        return Goal(self.action, filled(self.data, values))

    def names(self) -> set[str]:
        return {name for _, text in texts(self.data) for name in names(text)}

    def outline(self, values: Values) -> Goal:
        """Return a goal that suffices to end the demand, and starts it if no value is missing."""
        if self.names() <= set(values):
            return self.filled(values)
        # Only the template of a ``Demand`` may have names whose values become unknown.
        return Goal(self.action, filled(self._identity(), values))

    def subjects_of(
        self, booked: BookedDemand, subjects: tuple[str, ...], rule: str
    ) -> Values | None:
        """Return the entities of the event for which the rule made a booked demand, or ``None``."""
        action, booked_id, requesters = booked
        if len(requesters) > len(self.requesters) or action != self.action:
            return None
        # The id alone may not tell the entities: ``{entity}-{other}`` can give ``a-b-c`` in two
        # ways. So the requesters are read as well, and each combination is tried.
        pairs = [(self.id, booked_id), *product(self.requesters, requesters)]
        entities: dict[str, set[str]] = {name: set() for name in subjects}
        for template, text in pairs:
            for name, entity in (values_in(template, text) or {}).items():
                entities.get(name, set()).add(entity)
        for combination in product(*(sorted(entities[name]) for name in subjects)):
            values = dict(zip(subjects, combination, strict=True))
            goal = self.outline({"rule": rule, **values})
            if (goal.id, goal.requesters) == (booked_id, tuple(sorted(requesters))):
                return values
        return None


def requester_lists(action: Action, data: Mapping[str, Any]) -> Iterator[tuple[str, Sequence[str]]]:
    # each with its place in the goal
    if action == "Demand":
        yield "requesters", data.get("requesters", ())
        return
    kind = "object_detection_fusion_app"
    for index, app in enumerate(data.get("apps", ())):
        ids = app.get(kind, {}).get("requester_ids", ())
        yield f"apps[{index}].{kind}.requester_ids", ids
    for index, connection in enumerate(data.get("connections", ())):
        yield f"connections[{index}].requester_ids", connection.get("requester_ids", ())


# ---- the checks of what a rule demands: the template's names, the demand's form and ids ----

# Values of the right types, with which the form of a demand is checked before any event.
_SAMPLE: Values = {
    "rule": "rule",
    "entity": "entity",
    "other": "other",
    "x": 0.0,
    "y": 0.0,
    "distance": 0.0,
    "value": 0.0,
    "count": 1,
}


def faults_of_demand(
    template: Goal, field: str, subjects: tuple[str, ...], momentary: frozenset[str]
) -> list[Fault]:
    """Return the faults of a rule's demand: of its names, else of its form, else of its ids.

    ``momentary`` are the names of values that are known only when an event starts.
    """
    # A ``DeploymentRequest`` is sent again to renew it and with ``shutdown`` to end it. It must be
    # the same then, also after a restart, when momentary values are not known.
    known = {"rule", *subjects, *(momentary if template.action == "Demand" else ())}
    problems = [
        fault(path, f"'{{{name}}}' has no value here{suggestion(name, known)}")
        for path, name in unknown_names(template.data, field, known)
    ]
    if problems:
        return problems
    data = filled(template.data, _SAMPLE)
    if template.action == "Demand":
        fixed = [name for name in ("apiVersion", "kind", "operation") if name in data]
        malformed = form_faults({**_HEAD, **data})
    else:
        fixed = ["shutdown"] if "shutdown" in data else []
        malformed = form_faults(data)
    problems = [fault(f"{field}.{name}", "is set by the detector; remove it") for name in fixed]
    written = dict(texts(template.data, field))
    for problem in malformed:
        path = f"{field}.{problem.field}" if problem.field else field
        text, message = written.get(path, ""), problem.message
        # The writer wrote a text such as ``{x}``, which becomes a number.
        is_number = text.startswith("{") and isinstance(_SAMPLE.get(text[1:-1]), float | int)
        if is_number and message.startswith("must be text"):
            message = (
                f"{quoted(text)} becomes a number, but this field needs text; write a word before "
                f"{text}, such as 'near-{text}'"
            )
        problems.append(fault(path, message))
    return problems or list(_faults_of_ids(template, field, {f"{{{name}}}" for name in subjects}))


def _faults_of_ids(template: Goal, field: str, needed: set[str]) -> Iterator[Fault]:
    """Yield a fault for each id that is missing, may change, or would be that of two events."""
    data: Any = template.data
    for name in ("demand", "requesters") if template.action == "Demand" else ("id",):
        if not data.get(name):
            yield fault(f"{field}.{name}", "is missing; add it")
    if template.action == "Demand":
        why = "otherwise two events would share one demand"
        listed: list[tuple[str, Sequence[str]]] = [("demand", [data.get("demand", "")])]
        for name, what in (("demand", "id"), ("requesters", "requesters")):
            for path, text in texts(data.get(name, ()), f"{field}.{name}"):
                if changing := sorted({*names(text)} - {"rule", "entity", "other"}):
                    message = (
                        f"'{{{changing[0]}}}' changes, but the demand's {what} must stay the same; "
                    )
                    yield fault(path, f"{message}leave that name out")
    else:
        why = "a shutdown ends what its requesters joined, so each event needs its own requesters"
        listed = [*requester_lists(template.action, data)]
    for path, values in listed:
        missing = needed - {f"{{{name}}}" for value in values for name in names(value)}
        if missing and any(values):
            named = " and ".join(sorted(missing))
            yield fault(f"{field}.{path}", f"must name {named}, because {why}")


# ---- the file of rules, and the checks across its parts ----
#
# :func:`read` reports many faults of a file together, each with its line and field. But the parts
# are compared only if the fields are valid, and a demand's form is checked only if its names are
# known.


class PositionFields(NamedTuple):
    """The two fields of a message with a position: x and y in metres, or degrees.

    Degrees, latitude first, are multiplied by ``scale``. If a field has one of the values that
    ``unavailable`` gives it, the message says that the position is not known. Metres may be in the
    frame that the field ``frame`` names, with the height ``z``.
    """

    first: str
    second: str
    scale: float = 0.0
    unavailable: Mapping[str, Sequence[float]] = MappingProxyType({})
    z: str = ""
    frame: str = ""

    @property
    def in_degrees(self) -> bool:
        return bool(self.scale)


def _in_metres(point: str) -> PositionFields:
    return PositionFields(f"{point}.x", f"{point}.y", z=f"{point}.z", frame="header.frame_id")


_ETSI = "cam.cam_parameters.basic_container.reference_position"
# in units of 0.1 microdegree, with a number of its own for a position that is not known
_CAM = PositionFields(
    f"{_ETSI}.latitude.value",
    f"{_ETSI}.longitude.value",
    1e-7,
    {f"{_ETSI}.latitude.value": (900_000_001,), f"{_ETSI}.longitude.value": (1_800_000_001,)},
)

# For some message types, the fields that have the position; a source can name other fields.
POSITIONS: Mapping[str, PositionFields] = {
    "geometry_msgs/msg/PoseStamped": _in_metres("pose.position"),
    "geometry_msgs/msg/PoseWithCovarianceStamped": _in_metres("pose.pose.position"),
    "nav_msgs/msg/Odometry": _in_metres("pose.pose.position"),
    "perception_msgs/msg/EgoData": PositionFields(
        "state.continuous_state[0]",
        "state.continuous_state[1]",
        z="state.continuous_state[2]",
        frame="header.frame_id",
    ),
    # without a fix, or not known whether there is one
    "sensor_msgs/msg/NavSatFix": PositionFields(
        "latitude", "longitude", 1.0, {"status.status": (-1, -2)}
    ),
    "etsi_its_cam_msgs/msg/CAM": _CAM,
    "etsi_its_cam_ts_msgs/msg/CAM": _CAM,
}


class Source(CamelModel):
    """The topics on which one kind of entity reports.

    If ``topic`` contains ``{entity}``, a topic has the entity's name at that place. If not,
    ``entity`` is the message's field with the entity's name. The entity's position is in the
    fields ``x`` and ``y``, in metres, or ``latitude`` and ``longitude``, in degrees after they are
    multiplied by ``scale``. Metres may be in another frame than the map's; the field ``frame`` has
    its name, and ``z`` the height in it. A message in which a field has its number in
    ``unavailable`` counts as silence. An entity counts as gone when it has been silent for
    ``timeout``.
    """

    topic: Annotated[Text, base_model.without(conditions.topic_pattern_problem)]
    type: Annotated[Text, base_model.without(message_type_problem)]
    entity: FieldPath | None = None
    x: FieldPath | None = None
    y: FieldPath | None = None
    latitude: FieldPath | None = None
    longitude: FieldPath | None = None
    z: FieldPath | None = None
    frame: FieldPath | None = None
    scale: Annotated[float, Field(gt=0, le=1)] | None = None
    unavailable: dict[FieldPath, Number] = Field(default_factory=dict)
    timeout: Duration = "5s"

    @model_validator(mode="after")
    def _names_entities(self) -> Source:
        if ("{entity}" in self.topic) == bool(self.entity):
            raise ValueError(
                "must say at exactly one place where the name of the entity is: either write "
                "{entity} as a part of 'topic', or set 'entity' to the field of the message that "
                "has the name"
            )
        if bool(self.x) != bool(self.y):
            raise ValueError("names x or y alone; give both, or neither")
        if bool(self.latitude) != bool(self.longitude):
            raise ValueError("names latitude or longitude alone; give both, or neither")
        if self.x and self.latitude:
            raise ValueError("names both x and latitude; give metres or degrees")
        if (self.z or self.frame) and self.latitude:
            raise ValueError("z and frame belong to x and y; leave them out")
        if self.scale is not None and not self.latitude:
            raise ValueError("scale belongs to latitude and longitude; leave it out, or add them")
        if base_model.seconds_of(self.timeout) < 1:
            raise ValueError("timeout must be one second or more")
        return self

    @property
    def position(self) -> PositionFields | None:
        if self.latitude and self.longitude:
            return PositionFields(self.latitude, self.longitude, self.scale or 1.0)
        usual = POSITIONS.get(self.type)
        if self.x and self.y:
            usual = PositionFields(self.x, self.y)
        if usual is None:
            return None
        # a frame that names the entity is not where the entity is
        frame = self.frame or (usual.frame if usual.frame != self.entity else "")
        return usual._replace(z=self.z or usual.z, frame=frame)

    @property
    def silence(self) -> dict[str, Sequence[float]]:
        """The numbers, by field, with which a message says that it knows nothing."""
        usual = POSITIONS[self.type].unavailable if self.type in POSITIONS else {}
        return {**usual, **{field: (number,) for field, number in self.unavailable.items()}}


# The identity of an entity: its source and its name.
Who: TypeAlias = tuple[str, str]

CONDITIONS = ("near", "together", "count", "threshold", "schedule")


class Rule(CamelModel):
    """A condition, and what is demanded while it holds.

    The rule is for entities that match ``entities``. The condition must hold for ``dwell``
    before anything is demanded. A refused demand is sent again after ``retry``. A
    ``deploymentRequest`` is sent again every ``renew``; this renews the leases that access domains
    give its claims.
    """

    name: DnsLabel
    entities: Patterns = ("*",)
    near: Near | None = None
    together: Together | None = None
    count: Count | None = None
    threshold: Threshold | None = None
    schedule: Hours | None = None
    dwell: Duration = "0s"
    demand: dict[str, Any] | None = None
    deployment_request: dict[str, Any] | None = None
    retry: Duration = "30s"
    renew: Duration | None = None

    @model_validator(mode="after")
    def _has_one_condition_and_one_demand(self) -> Rule:
        given = [name for name in CONDITIONS if getattr(self, name) is not None]
        if len(given) != 1:
            listed = f"; it has {', '.join(given)}" if given else ""
            raise ValueError(f"needs exactly one of {', '.join(CONDITIONS)}{listed}")
        if (self.demand is None) == (self.deployment_request is None):
            raise ValueError("needs exactly one of demand and deploymentRequest")
        if self.renew and self.demand is not None:
            raise ValueError(
                "renew is for a deploymentRequest; leave it out, because the detector renews each "
                "demand that has a lease"
            )
        if base_model.seconds_of(self.retry) < 1 or (
            self.renew and base_model.seconds_of(self.renew) < 1
        ):
            raise ValueError("retry and renew must be one second or more")
        return self

    @cached_property
    def condition(self) -> Near | Together | Count | Threshold | Hours:
        condition = self.near or self.together or self.count or self.threshold or self.schedule
        assert condition is not None  # noqa: S101 - validated above
        return condition

    @cached_property
    def dwell_s(self) -> float:
        return float(base_model.seconds_of(self.dwell))

    @cached_property
    def sources(self) -> tuple[str, ...]:
        """The sources that the rule's condition reads: none, one, or two for ``together``."""
        named = (getattr(self.condition, name, None) for name in ("source", "other"))
        return tuple(name for name in named if name)

    @cached_property
    def subjects(self) -> tuple[str, ...]:
        """The names by which the template refers to an event's entities, such as ``entity``."""
        if self.together is not None:
            return ("entity", "other")
        return () if self.count or self.schedule else ("entity",)

    @property
    def momentary(self) -> frozenset[str]:
        """The names of values that an event has only when it starts, like ``distance``."""
        if self.near is not None or self.together is not None:
            return frozenset(("x", "y", "distance"))
        return frozenset({"value"} if self.threshold else {"count"} if self.count else ())

    @property
    def template(self) -> Goal:
        if self.demand is not None:
            return Goal("Demand", self.demand)
        return Goal("DeploymentRequest", self.deployment_request or {})

    def takes(self, who: Who) -> bool:
        # The patterns of a rule on pairs limit only the entities of the first source.
        return who[0] != self.sources[0] or "*" in self.entities or matches(who[1], self.entities)

    def entities_of(self, subjects: tuple[str, ...]) -> tuple[Who, ...]:
        # A rule on pairs from one source names this source once, but its events have two entities.
        return tuple(zip((*self.sources, *self.sources), subjects, strict=False))

    def is_for(self, subjects: tuple[str, ...]) -> bool:
        return all(map(self.takes, self.entities_of(subjects)))


class RuleFile(FileModel):
    """Sources by name, and the rules that read them."""

    kind: Literal["DetectorRules"]
    # Where the metres of rules are on earth and in the tree of frames
    map: MapFrame | None = None
    sources: dict[DnsLabel, Source] = Field(default_factory=dict)
    rules: Items[Rule]


def read(text: str, file: str) -> RuleFile:
    with located_in(text):
        rules = base_model.parse_file(RuleFile, text, file)
        if faults := list(_faults(rules)):
            raise InvalidInput(each.within(file) for each in faults)
    return rules


def _faults(rules: RuleFile) -> Iterator[Fault]:
    names: set[str] = set()
    identities: list[tuple[Any, Rule]] = []
    for name, listed in rules.sources.items():
        place, frame = listed.position, rules.map
        if place and place.in_degrees and not (frame and frame.on_earth):
            message = (
                "reports degrees; add to the file where its metres are on earth, such as "
                "'map: {latitude: 50.7784, longitude: 6.0606}'"
            )
            yield fault(f"sources.{name}", message)
        if listed.frame and not (frame and frame.frame):
            message = "is set; add to the file in which frame its metres are: 'map: {frame: map}'"
            yield fault(f"sources.{name}.frame", message)
    for index, rule in enumerate(rules.rules):
        where = f"rules[{index}]"
        if rule.name in names:
            message = f"'{rule.name}' appears twice; give each rule a name of its own"
            yield fault(f"{where}.name", message)
        names.add(rule.name)
        kind = next(name for name in CONDITIONS if getattr(rule, name) is not None)
        for part in ("source", "other"):
            source = getattr(rule.condition, part, None)
            if source is not None and source not in rules.sources:
                hint = suggestion(source, rules.sources)
                yield fault(f"{where}.{kind}.{part}", f"'{source}' is not in sources{hint}")
            elif source is not None and kind != "threshold" and not rules.sources[source].position:
                message = (
                    f"source '{source}' has no position; name the fields of its position in "
                    f"sources.{source}: x and y, or latitude and longitude"
                )
                yield fault(f"{where}.{kind}.{part}", message)
        field = "demand" if rule.demand is not None else "deploymentRequest"
        if problems := faults_of_demand(
            rule.template, f"{where}.{field}", rule.subjects, rule.momentary
        ):
            yield from problems
            continue
        # what ends an event's demand; a shutdown also ends only what the same requesters joined
        goal = rule.template.filled({"rule": rule.name})
        identity = (goal.action, goal.id, goal.requesters if rule.demand is None else ())
        for other_identity, other in identities:
            # Two rules may have an event for one entity at the same time if they have a pattern in
            # common, or if one of them has ``*``. Different patterns that match the same entity,
            # such as ``car*`` and ``*1``, are not recognized.
            own, others = {*rule.entities}, {*other.entities}
            may_meet = "*" in own | others or not own.isdisjoint(others)
            if identity == other_identity and may_meet:
                message = (
                    f"is also the id of a demand of rule '{other.name}', so the event that ends "
                    "first would end the other event's demand; add {rule} to one of the ids"
                )
                yield fault(f"{where}.{field}.{'demand' if rule.demand else 'id'}", message)
                break
        identities.append((identity, rule))
