"""The version of an application that is deployed: the newest version that its claims ask for.

A claim on an application asks for a named version, or for the default version. A service that
several applications share has the newest of the versions of these applications. So the order of
the claims does not matter, and two demands that renew in turn do not restart the pods again and
again. :mod:`demandops.plan.checks.version_difference` decides whether a demand may ask for another
version than the existing demands.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from demandops.config.appdef import Service
from demandops.config.config import VERSIONS_FILE
from demandops.config.registry import ApplicationVersion, precedence
from demandops.errors import Refused
from demandops.ledger.ledger import Ledger
from demandops.ledger.world import World


def running_version(world: World, application: str) -> ApplicationVersion | None:
    """Return the deployed version of an application.

    Return ``None`` if no claim holds the application, or if its appdef is missing.
    """
    app = world.ledger.application(application)
    versions = world.config.application_versions.get(app.appdef) if app else None
    return newest_asked(world.ledger, application, versions) if versions else None


def newest_asked(
    ledger: Ledger, application: str, versions: Mapping[str, ApplicationVersion]
) -> ApplicationVersion:
    """Return the newest of ``versions`` that claims on an application ask for, or the default."""
    asked = ledger.versions_asked(application, versions)
    return max((versions[word] for word in asked or ("",)), key=lambda version: version.rank)


def same_version(one: ApplicationVersion | None, other: ApplicationVersion | None) -> bool:
    """Return whether two versions of one appdef have the same rank, or both are ``None``."""
    return (one and one.rank) == (other and other.rank)


def version_of_service(
    world: World, service: Service, applications: Iterable[str]
) -> ApplicationVersion:
    """Return the version in which a service runs for the applications that share it.

    At least one of the applications must have a version (:func:`running_version`).

    Raises:
        Refused: if another appdef has the same chart version, but different images.
    """
    newest: dict[str, ApplicationVersion] = {}
    for running in filter(None, (running_version(world, id) for id in applications)):
        if running.rank > newest.setdefault(running.appdef, running).rank:
            newest[running.appdef] = running
    # Ranks are comparable only within one appdef, and all versions of a service have its chart. So
    # among several appdefs, the one with the newest chart decides.
    versions = [version for _, version in sorted(newest.items())]
    best = max(versions, key=lambda version: precedence(version.charts[service.chart].version))
    for other in versions:
        its, own = contents(other, service), contents(best, service)
        if its[0] == own[0] and its != own:  # neither is the newest
            file = world.config.place_of(VERSIONS_FILE)
            message = (
                f"application definitions '{best.appdef}' and '{other.appdef}' share "
                f"{service.chart} {own[0]}, but pin different images; pin the same images, or "
                f"give one of the definitions another version of the chart, in {file}"
            )
            raise Refused.at("version", message, code="conflict")
    return best


def contents(version: ApplicationVersion, service: Service) -> tuple[object, ...]:
    """Return what a version pins for a service: the version of the chart, and the images."""
    pins = (version.images.get(name) for name in service.images)
    return version.charts[service.chart].version, *pins
