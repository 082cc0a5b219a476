"""The types that describe the health of releases, the same for all controllers. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

Level = Literal["pushed", "reconciled", "healthy"]
State = Literal["waiting", "reconciled", "healthy"]

_ORDER: dict[str, int] = {"waiting": 0, "pushed": 0, "reconciled": 1, "healthy": 2}


class ObjectName(NamedTuple):
    """The namespace and name of an object."""

    namespace: str
    name: str


class ObjectSelector(NamedTuple):
    """Selects objects of a kind: all in a namespace, or the one with this name."""

    kind: str
    namespace: str
    name: str = ""


@dataclass(frozen=True, slots=True)
class ClusterDomain:
    """An access domain on a cluster.

    ``application`` is the Argo CD Application of its folder; with Flux it is ``None``.
    """

    cluster: str
    name: str
    namespace: str
    application: ObjectName | None = None


@dataclass(frozen=True, slots=True)
class Target:
    """A release, and whether it should run.

    With ``by_helm`` it is a service, otherwise the single Deployment of a communication client.
    """

    domain: ClusterDomain
    name: str
    by_helm: bool
    wanted: bool = True


@dataclass(frozen=True, slots=True)
class Health:
    """The state of a domain or a release.

    ``reason`` says why it has not reached the next level, if possible in the controller's words.
    ``object`` is the object that the reason comes from. ``failing`` says whether the reason is a
    failure.
    """

    state: State
    reason: str = ""
    object: str = ""
    failing: bool = False

    def reaches(self, level: Level) -> bool:
        """Report whether the state is at least ``level``."""
        return _ORDER[self.state] >= _ORDER[level]


Key = tuple[str, str, str]
"""Kind, namespace, name."""
Object = Mapping[str, Any]
Objects = Mapping[Key, Object]


class History(Protocol):
    """Queries on the state repo's commits."""

    def includes(self, commit: str, other: str) -> bool:
        """Report whether ``commit`` is ``other`` or comes after it."""
        ...

    def unchanged(self, commit: str, other: str, path: str) -> bool:
        """Report whether two commits have the same content under ``path``."""
        ...


def worst(healths: list[Health]) -> Health:
    """Return the least advanced health; if several are equal, prefer a failing one."""
    return min(
        healths,
        key=lambda health: (_ORDER[health.state], not health.failing),
        default=Health("healthy"),
    )
