"""The file of rules for the event detector, and the checks across its parts.

:func:`read` reports many faults of a file together, each with its line and field. But the parts are
compared only if the fields are valid, and a demand's form is checked only if its names are known.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from demandops.base.errors import Fault, InvalidInput, fault, suggestion
from demandops.base.naming import message_type_problem
from demandops.base.strict_yaml import located_in
from demandops.detect.condition import (
    Count,
    FieldPath,
    Hours,
    Near,
    Threshold,
    Together,
    topic_pattern_problem,
)
from demandops.detect.rule_demand import RuleDemand, faults_of_demand
from demandops.model.config.base_model import (
    CamelModel,
    DnsLabel,
    FileModel,
    Items,
    Text,
    parse_file,
    seconds_of,
    without,
)
from demandops.model.config.policy import Duration, Patterns, matches

# For some message types, the fields that have x and y; a source can name other fields instead.
POSITIONS: Mapping[str, tuple[str, str]] = {
    "geometry_msgs/msg/PoseStamped": ("pose.position.x", "pose.position.y"),
    "nav_msgs/msg/Odometry": ("pose.pose.position.x", "pose.pose.position.y"),
    "perception_msgs/msg/EgoData": ("state.continuous_state[0]", "state.continuous_state[1]"),
}


class Source(CamelModel):
    """The topics on which one kind of entity reports.

    If ``topic`` contains ``{entity}``, a topic has the entity's name at that place. If not,
    ``entity`` is the message's field with the entity's name. ``x`` and ``y`` are the fields with
    the entity's position. An entity counts as gone when it has been silent for ``timeout``.
    """

    topic: Annotated[Text, without(topic_pattern_problem)]
    type: Annotated[Text, without(message_type_problem)]
    entity: FieldPath | None = None
    x: FieldPath | None = None
    y: FieldPath | None = None
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
        if seconds_of(self.timeout) < 1:
            raise ValueError("timeout must be one second or more")
        return self

    @property
    def position(self) -> tuple[str, str] | None:
        return (self.x, self.y) if self.x and self.y else POSITIONS.get(self.type)


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
        if seconds_of(self.retry) < 1 or (self.renew and seconds_of(self.renew) < 1):
            raise ValueError("retry and renew must be one second or more")
        return self

    @property
    def condition(self) -> Near | Together | Count | Threshold | Hours:
        condition = self.near or self.together or self.count or self.threshold or self.schedule
        assert condition is not None  # noqa: S101 - validated above
        return condition

    @property
    def sources(self) -> tuple[str, ...]:
        """The sources that the rule's condition reads: none, one, or two for ``together``."""
        named = (getattr(self.condition, name, None) for name in ("source", "other"))
        return tuple(name for name in named if name)

    @property
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
    def template(self) -> RuleDemand:
        if self.demand is not None:
            return RuleDemand("demand", self.demand)
        return RuleDemand("deployment_request", self.deployment_request or {})

    def is_for(self, *entities: str) -> bool:
        """Return whether the rule is for an event about these entities."""
        # The patterns of a rule for pairs from two sources limit only the entity of the first.
        limited = entities[:1] if self.together and self.together.other else entities
        return all(matches(entity, self.entities) for entity in limited)


class RuleFile(FileModel):
    """Sources by name, and the rules that read them."""

    kind: Literal["DetectorRules"]
    sources: dict[DnsLabel, Source] = Field(default_factory=dict)
    rules: Items[Rule]


def read(text: str, file: str) -> RuleFile:
    """Return the rules in the text of a file.

    Raises:
        InvalidInput: with the faults that were found together, each with its line. When they are
            mended, further ones may appear.
    """
    with located_in(text):
        rules = parse_file(RuleFile, text, file)
        if faults := list(_faults(rules)):
            raise InvalidInput(each.within(file) for each in faults)
    return rules


def _faults(rules: RuleFile) -> Iterator[Fault]:
    names: set[str] = set()
    ids: list[tuple[str, Rule]] = []
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
                    f"sources.{source}.x and y"
                )
                yield fault(f"{where}.{kind}.{part}", message)
        field = "demand" if rule.demand is not None else "deploymentRequest"
        yield from faults_of_demand(
            rule.template, f"{where}.{field}", rule.subjects, rule.momentary
        )
        if rule.demand is not None:
            id = str(rule.demand.get("demand", "")).replace("{rule}", rule.name)
            for other_id, other in ids:
                # Two rules may have an event for one entity at the same time if they have a pattern
                # in common, or if one of them has ``*``. Different patterns that match the same
                # entity, such as ``car*`` and ``*1``, are not recognized.
                own, others = {*rule.entities}, {*other.entities}
                may_meet = "*" in own | others or not own.isdisjoint(others)
                if id == other_id and may_meet:
                    message = (
                        f"is also the id of a demand of rule '{other.name}', so the event that "
                        "ends first would end the other event's demand; add {rule} to one of the "
                        "ids"
                    )
                    yield fault(f"{where}.demand.demand", message)
                    break
            ids.append((id, rule))
