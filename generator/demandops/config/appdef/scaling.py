"""The number of replicas of a service, and the fields of a definition that decide it."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import timedelta
from typing import Annotated, Literal

from pydantic import Field, model_validator

from demandops import strict_yaml
from demandops.config.base_model import CamelModel, Positive, Word
from demandops.config.durations import seconds_of
from demandops.config.policy import Duration
from demandops.errors import sentences

Count = Annotated[int, Field(ge=0, le=1000)]

# A percentage of what a pod requests of a resource. It may be above 100, because a pod may use more
# than it requests.
Percent = Annotated[int, Field(ge=1, le=1000)]

# What the generator counts to get the number of replicas. Each replica serves up to a fixed number
# of the counted things.
Measure = Literal["topics", "sources", "claims", "requesters"]

Resource = Literal["cpu", "memory"]


class Sizes(CamelModel):
    """The number of replicas for each size. A parameter of the demands names the size."""

    parameter: Word
    replicas: Annotated[dict[Word, Count], Field(min_length=1)]

    def replicas_for(self, value: object) -> int | None:
        """Return the number of replicas for a size, or for the largest of a list of sizes.

        Return ``None`` if anything else is among the sizes, or if the list is empty.
        """
        names = value if isinstance(value, list) else [value]
        # compared with a list, because a value may have no hash, such as a mapping
        counts = [self.replicas[name] for name in names if name in [*self.replicas]]
        return max(counts) if counts and len(counts) == len(names) else None


class Scaling(CamelModel):
    """How many replicas a service has.

    A service has ``min`` replicas unless one of three fields decides the number. With ``per``, each
    replica serves up to the given number of topics, sources, claims or requesters. With
    ``sizes``, a parameter names a size, and each size has its number of replicas. ``autoscaler``
    has the targets of a HorizontalPodAutoscaler, in percent of what the pods request.

    ``divides_work`` says that no two replicas publish the same data.

    With ``per`` or ``sizes``, additional replicas start without delay. They stop once fewer
    replicas have been needed for ``down_after``, or at once without it
    (:mod:`demandops.ledger.kept_replicas`). No number is above ``max``, except one in ``sizes``.
    """

    min: Count = 1
    max: Annotated[Count, Field(ge=1)] = 1
    per: Annotated[dict[Measure, Positive], Field(min_length=1)] | None = None
    sizes: Sizes | None = None
    autoscaler: Annotated[dict[Resource, Percent], Field(min_length=1)] | None = None
    may_depend_on_requesters: bool = False
    divides_work: bool = False
    down_after: Duration | None = None

    @model_validator(mode="before")
    @classmethod
    def _renamed(cls, data: object) -> object:
        if isinstance(data, dict) and "topicsPerReplica" in data:
            per = strict_yaml.short_repr(data["topicsPerReplica"])
            raise ValueError(f"'topicsPerReplica' has a new name; write 'per: {{topics: {per}}}'")
        return data

    @model_validator(mode="after")
    def _consistent(self) -> Scaling:
        if problems := [*self._problems()]:
            raise ValueError(sentences(problems))
        return self

    def _problems(self) -> Iterator[str]:
        if self.min > self.max:
            yield f"min {self.min} is above max {self.max}; lower min or raise max"
        deciding = [f"'per: {measure}'" for measure in self.per or ()]
        deciding += [f"'{name}'" for name in ("sizes", "autoscaler") if getattr(self, name)]
        if len(deciding) > 1:
            yield f"{' and '.join(deciding)} each decide the number of replicas; keep one"
        for name in sorted({"min", "max"} & self.model_fields_set) if self.sizes else ():
            yield (
                f"'sizes' alone decides the number of replicas, so {name} does nothing; "
                f"remove {name}"
            )
        for name in ("per", "autoscaler"):
            if getattr(self, name) and self.min == self.max:
                yield f"'{name}' does nothing, because min and max are both {self.max}; raise max"
        if self.autoscaler and self.min == 0:
            yield "an autoscaler keeps at least one replica; raise min to 1"
        by_requesters = "requesters" in (self.per or {})
        if by_requesters and not self.may_depend_on_requesters:
            yield (
                "'per' counts requesters, so the rendered files show how many requesters there "
                "are; allow this with 'mayDependOnRequesters: true'"
            )
        if self.may_depend_on_requesters and not by_requesters:
            yield "'mayDependOnRequesters' does nothing unless 'per' counts requesters; remove it"
        if self.down_after and not (self.per or self.sizes):
            own = " (an autoscaler has a delay of its own)" if self.autoscaler else ""
            yield f"'downAfter' does nothing without 'per' or 'sizes'{own}; remove 'downAfter'"
        if self.down_after and seconds_of(self.down_after) < 1:
            yield "downAfter is zero; leave it out"

    @property
    def kept_for(self) -> timedelta | None:
        """How long a service keeps replicas that no demand needs; ``None`` if it keeps none."""
        return timedelta(seconds=seconds_of(self.down_after)) if self.down_after else None

    @property
    def most(self) -> int:
        """The highest number of replicas that the service may have without an override."""
        if self.sizes:
            return max(self.sizes.replicas.values())
        return self.max if self.per or self.autoscaler else self.min
