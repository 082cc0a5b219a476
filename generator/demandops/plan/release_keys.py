"""The keys of releases that follow from claims.

:func:`affected_keys` names the releases that a change of claims may touch, so the cost of a demand
does not grow with the number of others. :mod:`demandops.plan.planner` derives each release.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from demandops.config.appdef import ApplicationDefinition
from demandops.config.config import Config
from demandops.connections.communication_client import ClientKey
from demandops.demand.claim import Subject, SubjectKind
from demandops.errors import Refused, fault
from demandops.ledger.ledger import Ledger
from demandops.plan import connection_clients
from demandops.plan.overrides.suspended_claims import without_suspended
from demandops.plan.release import ServiceKey

ReleaseKey = ServiceKey | ClientKey


def keys_of(
    ledger: Ledger, config: Config, subject: Subject, *, strict: bool = False
) -> Iterator[ReleaseKey]:
    """Yield the keys of the releases that the claims on ``subject`` need, except suspended claims.

    If an application's definition is missing, yield none, or refuse if ``strict``: what runs must
    not stop because a file that it needs was deleted.
    """
    yield from keys_including_suspended(
        without_suspended(ledger, config), config, subject, strict=strict
    )


def keys_including_suspended(
    ledger: Ledger, config: Config, subject: Subject, *, strict: bool = False
) -> Iterator[ReleaseKey]:
    """Yield the keys of the releases that all claims on ``subject`` in ``ledger`` need."""
    if subject.kind is SubjectKind.CONNECTION:
        yield from connection_clients.client_keys(ledger, subject.id)
        return
    claims = ledger.application_claims(subject.id)
    if not claims:
        return
    known = strict or claims[0].appdef in config.appdefs
    appdef = appdef_of(config, claims[0].appdef) if known else None
    for name, service in (appdef.services if appdef else {}).items():
        if service.each is None:
            yield ServiceKey(name, claims[0].node, application=subject.id)
            continue
        topics = {
            (topic.source, topic.topic)
            for claim in claims
            for topic in claim.inputs.get(service.each, ())
        }
        for source, topic in sorted(topics):
            node = source if service.placement == "source" else claims[0].node
            yield ServiceKey(name, node, source=source, topic=topic)


def affected_keys(
    before: Ledger, after: Ledger, config: Config, subjects: Iterable[Subject]
) -> tuple[ReleaseKey, ...]:
    """Return the key of every release that a change of ``subjects`` may add, change or remove.

    Raises:
        Refused: if an application definition that ``after`` needs is missing.
    """
    keys = (
        key
        for subject in subjects
        for ledger in (before, after)
        for key in keys_of(ledger, config, subject, strict=ledger is after)
    )
    return tuple(dict.fromkeys(keys))


def all_keys(ledger: Ledger, config: Config) -> tuple[ReleaseKey, ...]:
    """Return the key of every release that the ledger needs.

    Raises:
        Refused: if the definition of a claimed application is missing.
    """
    subjects = [Subject(kind, id) for kind in SubjectKind for id in ledger.subjects(kind)]
    keys = (key for s in subjects for key in keys_of(ledger, config, s, strict=True))
    return tuple(dict.fromkeys(keys))


def appdef_of(config: Config, name: str) -> ApplicationDefinition:
    """Return an application definition by name.

    Raises:
        Refused: if the state repo has none.
    """
    appdef = config.appdefs.get(name)
    if appdef is None:
        raise Refused(
            [
                fault(
                    "appdef",
                    f"'{name}' is in use, but appdefs/{name} is gone; restore it",
                    code="unknown-application",
                ).within(f"appdefs/{name}/appdef.yaml")
            ]
        )
    return appdef
