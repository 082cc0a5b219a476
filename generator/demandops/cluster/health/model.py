"""The words in which it is told what a cluster says of releases, by whichever controller. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

Level = Literal["pushed", "reconciled", "healthy"]
State = Literal["waiting", "reconciled", "healthy"]

_ORDER: dict[str, int] = {"waiting": 0, "pushed": 0, "reconciled": 1, "healthy": 2}


class ObjectName(NamedTuple):
    """Where an object is."""

    namespace: str
    name: str


class ObjectSelector(NamedTuple):
    """Objects of a kind that are watched: all of a namespace, or the one with this name."""

    kind: str
    namespace: str
    name: str = ""


@dataclass(frozen=True, slots=True)
class ClusterDomain:
    """An access domain on a cluster.

    ``application`` is the Application over its folder where Argo CD follows, else Flux does.
    """

    cluster: str
    name: str
    namespace: str
    application: ObjectName | None = None


@dataclass(frozen=True, slots=True)
class Target:
    """One release and whether it is to be there. ``by_helm``: a service, else one Deployment."""

    domain: ClusterDomain
    name: str
    by_helm: bool
    wanted: bool = True


@dataclass(frozen=True, slots=True)
class Health:
    """How far something is. ``reason`` says why not further, in the controller's words where it

    has some; ``object`` names the object that says so, ``failing`` whether it speaks of a failure.
    """

    state: State
    reason: str = ""
    object: str = ""
    failing: bool = False

    def reaches(self, level: Level) -> bool:
        """Tell whether it is as far as ``level``."""
        return _ORDER[self.state] >= _ORDER[level]


Key = tuple[str, str, str]
"""Kind, namespace, name."""
Object = Mapping[str, Any]
Objects = Mapping[Key, Object]


class History(Protocol):
    """What is asked of the state repo's commits."""

    def includes(self, commit: str, other: str) -> bool:
        """Tell whether ``commit`` is ``other`` or comes after it."""
        ...

    def unchanged(self, commit: str, other: str, path: str) -> bool:
        """Tell whether two commits hold the same under ``path``."""
        ...


class HealthReader(Protocol):
    """How the objects of one GitOps controller are read."""

    def objects_to_watch(self, domain: ClusterDomain) -> tuple[ObjectSelector, ...]:
        """Return what must be known to tell how things are at a domain."""
        ...

    def objects_to_confirm(self, domain: ClusterDomain) -> tuple[ObjectSelector, ...]:
        """Return what is read once more before something is healthy, in this order."""
        ...

    def domain_health(
        self, domain: ClusterDomain, commit: str, objects: Objects, history: History
    ) -> Health:
        """Return whether a commit is applied in an access domain."""
        ...

    def release_health(
        self, target: Target, commit: str, objects: Objects, history: History
    ) -> Health:
        """Return whether a release of an applied commit runs, or is gone where it is to be."""
        ...

    def last_transition(self, target: Target, objects: Objects) -> str:
        """Return since when a release is as it is, as the cluster says it; empty if it does not."""
        ...

    def applied_commit(self, domain: ClusterDomain, objects: Objects) -> str:
        """Return the commit that an access domain was seen to have applied, or nothing."""
        ...


def worst(healths: list[Health]) -> Health:
    """Return the health of the whole: the least far, one that fails before one that waits."""
    return min(
        healths,
        key=lambda health: (_ORDER[health.state], not health.failing),
        default=Health("healthy"),
    )
