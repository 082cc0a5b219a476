"""The number of replicas of a service, as the definition derives it from what is demanded."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from demandops import strict_yaml
from demandops.config.appdef import Resource, Scaling
from demandops.demand.application import InputTopic
from demandops.demand.claim import Claim
from demandops.errors import Refused, suggestion


@dataclass(frozen=True, slots=True)
class Autoscaler:
    """A number that a HorizontalPodAutoscaler chooses between two bounds, by its targets."""

    min: int
    max: int
    targets: Mapping[Resource, int]

    def __str__(self) -> str:
        """Return bounds and targets as a fact of a release."""
        by = ", ".join(f"{name} {percent} %" for name, percent in self.targets.items())
        return f"{self.min} to {self.max} by an autoscaler ({by})"

    def values(self) -> dict[str, int]:
        """Return what a values template gets."""
        targets = {str(name): percent for name, percent in self.targets.items()}
        return {"min": self.min, "max": self.max} | targets


def replicas_of(
    scaling: Scaling,
    parameters: Mapping[str, object],
    topics: Collection[InputTopic],
    claims: Collection[Claim],
    requesters: Collection[str],
) -> int | Autoscaler:
    """Return the replicas for the parameters, inputs, claims and requesters of a service.

    Raises:
        Refused: if a parameter names no size.
    """
    if scaling.autoscaler:
        return Autoscaler(scaling.min, scaling.max, scaling.autoscaler)
    if scaling.sizes:
        name = scaling.sizes.parameter
        replicas = scaling.sizes.replicas_for(parameters[name])
        if replicas is None:
            value = parameters[name]
            message = f"{strict_yaml.short_repr(value)} is not a size" + suggestion(
                str(value), scaling.sizes.replicas
            )
            raise Refused.at(f"parameters.{name}", message)
        return replicas
    for measure, share in (scaling.per or {}).items():
        sources = {one.source for one in topics}
        counted = {"topics": topics, "sources": sources, "claims": claims, "requesters": requesters}
        needed = -(-len(counted[measure]) // share)
        return max(scaling.min, min(scaling.max, needed))
    return scaling.min


def overridden(replicas: int | Autoscaler, by: int) -> int | Autoscaler:
    """Return the replicas that an override sets; an autoscaler gets no choice."""
    return Autoscaler(by, by, replicas.targets) if isinstance(replicas, Autoscaler) else by
