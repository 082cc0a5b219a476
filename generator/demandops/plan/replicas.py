"""The number of replicas of a service; the service's definition derives it from the demands."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from demandops import strict_yaml
from demandops.config.appdef import Resource, Scaling
from demandops.demand.application import InputTopic
from demandops.demand.claim import Claim
from demandops.errors import Refused, suggestion
from demandops.ledger.kept_replicas import Kept, Steps


@dataclass(frozen=True, slots=True)
class Autoscaler:
    """A HorizontalPodAutoscaler, which chooses a number of replicas from ``min`` to ``max``.

    ``targets`` has the usage of each resource, in percent, that the autoscaler aims at.
    """

    min: int
    max: int
    targets: Mapping[Resource, int]

    def __str__(self) -> str:
        by = ", ".join(f"{name} {percent} %" for name, percent in self.targets.items())
        return f"{self.min} to {self.max} by an autoscaler ({by})"

    def values(self) -> dict[str, int]:
        targets = {str(name): percent for name, percent in self.targets.items()}
        return {"min": self.min, "max": self.max} | targets


def replicas_of(
    scaling: Scaling,
    parameters: Mapping[str, object],
    topics: Collection[InputTopic],
    claims: Collection[Claim],
    requesters: Collection[str],
) -> int | Autoscaler:
    """Return how many replicas a service needs, or the autoscaler that chooses the number."""
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
        sources = {topic.source for topic in topics}
        counted = {"topics": topics, "sources": sources, "claims": claims, "requesters": requesters}
        needed = -(-len(counted[measure]) // share)  # rounded up
        return max(scaling.min, min(scaling.max, needed))
    return scaling.min


def with_kept(
    needed: int | Autoscaler, scaling: Scaling, steps: Steps
) -> tuple[int | Autoscaler, Kept | None]:
    """Return how many replicas a service has, and the step that decides this number.

    The step is ``None`` if ``needed`` decides the number. ``steps`` say how many replicas the
    service keeps for a while (:mod:`demandops.ledger.kept_replicas`).
    """
    if isinstance(needed, Autoscaler) or not (steps and scaling.down_after):
        return needed, None
    kept = min(steps[0].replicas, scaling.most)  # a person may have lowered the limit meanwhile
    return (kept, steps[0]) if kept > needed else (needed, None)


def overridden(replicas: int | Autoscaler, number: int) -> int | Autoscaler:
    """Return the replicas of a service for which an override sets the number."""
    # Where an autoscaler owns the number, the GitOps controller ignores ``spec.replicas``. So the
    # number is set as both bounds of the autoscaler.
    if isinstance(replicas, Autoscaler):
        return Autoscaler(number, number, replicas.targets)
    return number


def most_replicas(replicas: int | Autoscaler) -> int:
    """Return the highest number of replicas that may run."""
    return replicas.max if isinstance(replicas, Autoscaler) else replicas
