"""The keys of releases that follow from claims.

:func:`affected_keys` names the releases that a change of claims may touch, so the cost of a demand
does not grow with the number of others. :mod:`demandops.plan.planner` derives each release.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from types import MappingProxyType

from demandops.config.appdef import ApplicationDefinition
from demandops.config.config import Config
from demandops.connections.communication_client import ClientKey
from demandops.demand.claim import ApplicationClaim, Claim, Subject, SubjectKind
from demandops.errors import Refused, fault
from demandops.ledger.ledger import ClaimChange, Ledger
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
    ledger = without_suspended(ledger, config)
    yield from keys_of_claims(ledger, config, ledger.claims_on(subject), strict=strict)


def keys_of_claims(
    ledger: Ledger, config: Config, claims: Iterable[Claim], *, strict: bool = False
) -> Iterator[ReleaseKey]:
    """Yield the keys of the releases that these claims of ``ledger`` need, each once."""
    keys = (
        key
        for claim in claims
        for key in (
            _service_keys(ledger, config, claim, strict)
            if isinstance(claim, ApplicationClaim)
            else connection_clients.client_keys(ledger, claim.connection)
        )
    )
    yield from dict.fromkeys(keys)


def _service_keys(
    ledger: Ledger, config: Config, claim: ApplicationClaim, strict: bool
) -> Iterator[ServiceKey]:
    first = deciding_claim(ledger, claim.application)
    known = strict or first.appdef in config.appdefs
    appdef = appdef_of(config, first.appdef) if known else None
    for name, service in (appdef.services if appdef else {}).items():
        if service.each is None:
            yield ServiceKey(name, first.node, application=claim.application)
            continue
        for topic in claim.inputs.get(service.each, ()):
            node = topic.source if service.placement == "source" else first.node
            yield ServiceKey(name, node, source=topic.source, topic=topic.topic)


def claims_needing(ledger: Ledger, config: Config, key: ServiceKey) -> tuple[ApplicationClaim, ...]:
    """Return the claims that need a service instance, by application and demand."""
    if key.application is not None:
        needed = _role(ledger, config, key.application, key) is not None
        return ledger.application_claims(key.application) if needed else ()
    source, topic = str(key.source), str(key.topic)
    claims = ledger.claims_taking(source, topic)
    roles = {name: _role(ledger, config, name, key) for name in {one.application for one in claims}}
    return tuple(
        one for one in claims if one.inputs_from(roles[one.application] or "", source, topic)
    )


def _role(ledger: Ledger, config: Config, application: str, key: ServiceKey) -> str | None:
    """Return the inputs that an application's service has an instance for each of.

    The text is empty if there is one instance for the application. ``None`` means that ``key`` is
    not a service of the application, for example because it moved or changed its definition.
    """
    first = ledger.first_claim(Subject(SubjectKind.APPLICATION, application))
    appdef = config.appdefs.get(first.appdef) if isinstance(first, ApplicationClaim) else None
    service = appdef.services.get(key.service) if appdef else None
    if service is None or (service.each is None) is (key.application is None):
        return None
    node = key.source if service.placement == "source" else deciding_claim(ledger, application).node
    return service.each or "" if node == key.node else None


def deciding_claim(ledger: Ledger, application: str) -> ApplicationClaim:
    """Return the claim that decides where a claimed application runs, and what it is."""
    first = ledger.first_claim(Subject(SubjectKind.APPLICATION, application))
    assert isinstance(first, ApplicationClaim)  # noqa: S101 - the application is claimed
    return first


def affected_keys(
    before: Ledger, after: Ledger, config: Config, changes: Iterable[ClaimChange]
) -> tuple[ReleaseKey, ...]:
    """Return the key of every release that these changes of claims may add, change or remove.

    The cost follows the topics that differ, unless a change moves or redefines an application.

    Raises:
        Refused: if an application definition that ``after`` needs is missing.
    """
    before, after = without_suspended(before, config), without_suspended(after, config)
    keys: dict[ReleaseKey, None] = {}
    for change in changes:
        subject, claims = change.key.subject, _differing(change, config)
        for ledger, claim in zip((before, after), claims, strict=True):
            own = [claim] if claim and ledger.get(claim.key) else []
            if not _decided_alike(before, after, subject):
                own += ledger.claims_on(subject)
            keys |= dict.fromkeys(keys_of_claims(ledger, config, own, strict=ledger is after))
    return tuple(keys)


def _differing(change: ClaimChange, config: Config) -> tuple[Claim | None, Claim | None]:
    """Return a changed claim before and after; if only inputs differ, with these inputs alone."""
    before, after = change.before, change.after
    if (
        not isinstance(before, ApplicationClaim)
        or not isinstance(after, ApplicationClaim)
        or before.parameters  # the latest booking decides some of them
        or replace(after, inputs=before.inputs, booked=before.booked, lease=before.lease) != before
    ):
        return before, after
    return _with_inputs_not_in(before, after), _with_inputs_not_in(after, before)


def _with_inputs_not_in(claim: ApplicationClaim, other: ApplicationClaim) -> ApplicationClaim:
    inputs = {}
    for role, topics in claim.inputs.items():
        known = {*other.inputs.get(role, ())}
        inputs[role] = tuple(topic for topic in topics if topic not in known)
    return replace(claim, inputs=MappingProxyType(inputs))


def _decided_alike(before: Ledger, after: Ledger, subject: Subject) -> bool:
    """Return whether an application runs at the same place and is the same in both ledgers."""
    one, other = before.first_claim(subject), after.first_claim(subject)
    if isinstance(one, ApplicationClaim) and isinstance(other, ApplicationClaim):
        return (one.appdef, one.node) == (other.appdef, other.node)
    return True


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
