"""Version differences: demands that share an application or a service ask for different versions.

The field ``versions`` of the application definition decides what happens. Either the demand is
refused, or the newest version is deployed. In some cases a person must approve the newest version
first.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from demandops.config.appdef import VersionPolicy
from demandops.config.registry import ApplicationVersion, precedence
from demandops.demand.claim import Claim
from demandops.demand.demand_request import Demanded, DemandRequest
from demandops.errors import Fault
from demandops.ledger.claim_changes import ClaimChange
from demandops.ledger.ledger import Ledger
from demandops.ledger.world import World
from demandops.plan.overrides.claim_overrides import without_suspended
from demandops.plan.release import Release, ServiceRelease
from demandops.plan.release_keys import ReleaseKey, claims_needing
from demandops.plan.running_version import (
    contents,
    newest_asked,
    running_version,
    same_version,
    version_of_service,
)
from demandops.subject import Subject

_STRICTNESS: tuple[VersionPolicy, ...] = ("refuse", "separate", "update", "upgrade")
_REFUSING = ("refuse", "separate")
"""The values of ``versions`` that refuse a difference.

With ``separate`` each version is an application of its own, so only shared services can differ.
"""


@dataclass(frozen=True, slots=True)
class Difference:
    """A difference: demands ask for different versions of one application or service.

    ``what`` describes this application or service. ``demanded`` is the version that the new demand
    asks for. ``others`` is the newest version that the other demands ask for. ``policy`` is the
    value of ``versions`` in the application definition ``appdef``. If two definitions share the
    service, it is the stricter of their values.
    """

    what: str
    appdef: str
    policy: VersionPolicy
    demanded: str
    others: str
    newer: bool
    """Whether ``demanded`` is newer than ``others``."""
    fault: Fault
    """The fault to report if :attr:`is_refused`."""

    def matters_to(self, asked: str) -> bool:
        """Return whether the difference concerns a demand that names the version ``asked``.

        ``asked`` is empty if the demand names no version. Then the difference concerns the demand
        only if :attr:`newer` or :attr:`is_refused` is true.
        """
        return bool(asked) or self.newer or self.is_refused

    @property
    def is_refused(self) -> bool:
        """Whether :attr:`policy` refuses the difference."""
        return self.policy in _REFUSING

    def approval_reason(self) -> str:
        """Return why a person must approve the difference; empty if no approval is needed.

        The result has no meaning if :attr:`is_refused`.
        """
        same = precedence(self.demanded)[0][0] == precedence(self.others)[0][0]
        if self.policy == "upgrade" or same:
            return ""
        change = (
            f"the upgrade of {self.what} from version {self.others} to {self.demanded}"
            if self.newer
            else f"version {self.demanded} of {self.what}, which runs in version {self.others}"
        )
        return f"application definition '{self.appdef}', for {change}"

    def warning(self) -> str:
        """Return a warning that the deployed version is newer than the demanded version.

        The result is an empty text if the demanded version is the newer one.
        """
        others = f"{self.what} runs version {self.others}, which others ask for"
        return "" if self.newer else f"{others}, not {self.demanded}"


def differences(
    request: DemandRequest,
    before: World,
    after: World,
    changes: Iterable[ClaimChange],
    plans: Mapping[ReleaseKey, Release | None],
) -> Iterator[Difference]:
    """Yield the differences between the versions that a demand and other demands ask for.

    A difference that existed before the demand is left out, and so is one that does not concern the
    demand (:meth:`Difference.matters_to`).

    Args:
        request: the demand.
        before, after: the world before and after the demand.
        changes: the claims that the demand changes.
        plans: the releases that the demand may change, as they are after the demand.
    """
    if not request.adds_claims:
        return
    listed = {one.held.subject: one for one in request.demanded}
    own: dict[str, tuple[Demanded, str]] = {}
    for change in changes:
        one, claim, old = listed.get(change.key.subject), change.after, change.before
        if one is None or claim is None or not claim.is_on_application:
            continue
        own[claim.application.id] = one, claim.application.version
        if old is None or old.application.version != claim.application.version:
            yield from _of_application(one, claim, after)
    for release in plans.values():
        if isinstance(release, ServiceRelease) and len(release.applications) > 1:
            yield from _of_service(release, own, before, without_suspended(after))


def _of_application(one: Demanded, claim: Claim, after: World) -> Iterator[Difference]:
    """Yield the difference between a claim's version and the newest one of the other claims."""
    app, ledger = claim.application, after.ledger
    known = after.config.application_versions[app.appdef]
    if len({known[word].rank for word in ledger.versions_asked(app.id, known)}) < 2:
        return
    others = ledger.replace(claim.key, None)
    own, theirs = known.get(app.version, known[""]), newest_asked(others, app.id, known)
    if same_version(own, theirs):
        return
    holders, word = _first_asker(others, app.subject, theirs, known)
    message = (
        f"{_words(app.version, own)} contradicts an existing claim: '{app.id}' is held by "
        f"{holders} in {_words(word, theirs)}; request that version, or use another application id"
    )
    found = Difference(
        f"application '{app.id}'",
        app.appdef,
        after.config.appdefs[app.appdef].versions,
        own.name,
        theirs.name,
        own.rank > theirs.rank,
        one.fault("version", message, code="conflict"),
    )
    if found.matters_to(app.version):
        yield found


def _first_asker(
    ledger: Ledger,
    subject: Subject,
    version: ApplicationVersion,
    known: Mapping[str, ApplicationVersion],
) -> tuple[str, str]:
    """Return (requesters, word) of the first claim on ``subject`` that asks for ``version``.

    ``word`` is the version or channel that the claim names; it is empty for the default version.
    """
    for claim in ledger.claims_on(subject):
        word = claim.application.version
        if same_version(known.get(word, known[""]), version):
            return ", ".join(claim.requesters), word if word in known else ""
    return "", ""


def _words(word: str, version: ApplicationVersion) -> str:
    named = f"version '{word}'" if word else "the default version"
    return f"{named} ({version.name})" if version.name not in ("", word) else named


def _of_service(
    release: ServiceRelease,
    listed: Mapping[str, tuple[Demanded, str]],
    before: World,
    after: World,
) -> Iterator[Difference]:
    """Yield a difference for each listed application whose version of a shared service differs.

    The version is compared with the one that the other applications need.

    Args:
        release: the release of the shared service.
        listed: the applications of the demand by id, each with the version that it asks for.
        before, after: the world before and after the demand.
    """
    service, key, config = release.service, release.key, after.config
    versions = {id: running_version(after, id) for id in release.applications}
    if len({contents(version, service) for version in versions.values() if version}) == 1:
        return
    for_what = f"for {key.topic} of '{key.source}'" if key.topic else f"on '{key.node}'"
    what = f"{key.service} {for_what}"
    for id, (one, asked) in listed.items():
        others = [other for other in versions if other != id]
        own, theirs = versions.get(id), version_of_service(after, service, others)
        if own is None or contents(own, service) == contents(theirs, service):
            continue
        if same_version(running_version(before, id), own) and any(
            claim.application.id == id for claim in claims_needing(before, key)
        ):
            continue
        by_name = own.appdef == theirs.appdef and own.name
        new, current = (
            version.name if by_name else version.charts[service.chart].version
            for version in (own, theirs)
        )
        has_current = f"a version that has {key.service} {current}"
        remedy = f"version {current}" if by_name else has_current
        sharing = ", ".join(f"'{other}'" for other in others[:3])
        message = (
            f"{what} would run in version {new}, but is shared with {sharing} in version "
            f"{current}; request {remedy}"
        )
        appdefs = (config.appdefs[version.appdef] for version in (own, theirs))
        strictest = min(appdefs, key=lambda appdef: _STRICTNESS.index(appdef.versions))
        found = Difference(
            what,
            strictest.name,
            strictest.versions,
            new,
            current,
            precedence(new) > precedence(current),
            one.fault("version", message, code="conflict"),
        )
        if found.matters_to(asked):
            yield found
