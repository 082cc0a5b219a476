"""Version differences: demands that share an application or a service ask for different versions.

The field ``versions`` of the application definition decides what happens. Either the demand is
refused, or the newest version is deployed. In some cases a person must approve the newest version
first.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from demandops.base.errors import Fault
from demandops.decide.planning import release_keys
from demandops.decide.planning.overrides import without_suspended
from demandops.decide.planning.release_keys import ReleaseKey, contents, newest_asked
from demandops.model.config.appdef import VersionPolicy
from demandops.model.config.registry import ApplicationVersion, precedence
from demandops.model.demand.demand import Demand, Item
from demandops.model.ledger.claim import Claim
from demandops.model.ledger.ledger import ClaimChange, World
from demandops.model.release import Release, ServiceRelease

# From the strictest to the least strict.
_STRICTNESS: tuple[VersionPolicy, ...] = ("refuse", "separate", "update", "upgrade")
# With ``separate`` each version is an application of its own, so only shared services can differ.
_REFUSING = ("refuse", "separate")


@dataclass(frozen=True, slots=True)
class Difference:
    """A difference: demands ask for different versions of one application or service.

    ``others`` is the newest version that the other demands ask for; ``newer`` tells whether
    ``demanded`` is newer. ``policy`` is the value of ``versions`` in the definition ``appdef``. If
    two definitions share the service, it is the stricter of their values.
    """

    what: str
    appdef: str
    policy: VersionPolicy
    demanded: str
    others: str
    newer: bool
    # To report if :attr:`is_refused`.
    fault: Fault

    def matters_to(self, asked: str) -> bool:
        # A demand that names no version has an empty text for ``asked``.
        return bool(asked) or self.newer or self.is_refused

    @property
    def is_refused(self) -> bool:
        return self.policy in _REFUSING

    def approval_reason(self) -> str:
        """Return why a person must approve the difference, or ``""``; of no use if refused."""
        # Another major version breaks what others get, in both directions. In 0.x, too, only the
        # first number counts.
        same_major = precedence(self.demanded)[0][0] == precedence(self.others)[0][0]
        if self.policy == "upgrade" or same_major:
            return ""
        change = (
            f"the upgrade of {self.what} from version {self.others} to {self.demanded}"
            if self.newer
            else f"version {self.demanded} of {self.what}, which runs in version {self.others}"
        )
        return f"application definition '{self.appdef}', for {change}"

    def warning(self) -> str:
        others = f"{self.what} runs version {self.others}, which others ask for"
        return "" if self.newer else f"{others}, not {self.demanded}"


def differences(
    request: Demand,
    before: World,
    after: World,
    changes: Iterable[ClaimChange],
    plans: Mapping[ReleaseKey, Release | None],
) -> Iterator[Difference]:
    """Yield the differences between the versions that a demand and other demands ask for.

    A difference that existed before the demand is left out, and so is one that does not matter to
    it. ``plans`` are the releases that the demand may change, as they are after it.
    """
    if not request.adds_claims:
        return
    listed = {item.held.subject: item for item in request.demanded}
    demanded: dict[str, tuple[Item, str]] = {}
    for change in changes:
        item, claim, old = listed.get(change.key.subject), change.after, change.before
        if item is None or claim is None or not claim.is_on_application:
            continue
        demanded[claim.application.id] = item, claim.application.version
        if old is None or old.application.version != claim.application.version:
            yield from _of_application(item, claim, after)
    for release in plans.values():
        if isinstance(release, ServiceRelease) and len(release.applications) > 1:
            yield from _of_service(release, demanded, before, without_suspended(after))


def _of_application(item: Item, claim: Claim, after: World) -> Iterator[Difference]:
    app, ledger = claim.application, after.ledger
    versions = after.config.application_versions[app.appdef]
    # Two words may name one version, for example a channel and a number.
    if len({versions[word].rank for word in ledger.versions_asked(app.id, versions)}) < 2:
        return
    others = ledger.replace(claim.key, None)
    own, theirs = versions.get(app.version, versions[""]), newest_asked(others, app.id, versions)
    if own.rank == theirs.rank:
        return
    holders, held = "", ""
    for other in others.claims_on(app.subject):
        word = other.application.version
        if versions.get(word, versions[""]).rank == theirs.rank:
            holders, held = ", ".join(other.requesters), word if word in versions else ""
            break
    message = (
        f"{_version_text(app.version, own)} contradicts an existing claim: '{app.id}' is held by "
        f"{holders} in {_version_text(held, theirs)}; request that version, or use another "
        "application id"
    )
    difference = Difference(
        f"application '{app.id}'",
        app.appdef,
        after.config.appdefs[app.appdef].versions,
        own.name,
        theirs.name,
        own.rank > theirs.rank,
        item.fault("version", message, code="conflict"),
    )
    if difference.matters_to(app.version):
        yield difference


def _version_text(word: str, version: ApplicationVersion) -> str:
    named = f"version '{word}'" if word else "the default version"
    return f"{named} ({version.name})" if version.name not in ("", word) else named


def _of_service(
    release: ServiceRelease,
    demanded: Mapping[str, tuple[Item, str]],
    before: World,
    after: World,
) -> Iterator[Difference]:
    """Yield the differences of demanded applications, each with the version it asks for."""
    service, key, config = release.service, release.key, after.config
    versions = {id: release_keys.running_version(after, id) for id in release.applications}
    if len({contents(version, service) for version in versions.values() if version}) == 1:
        return
    for_what = f"for {key.topic} of '{key.source}'" if key.topic else f"on '{key.node}'"
    what = f"{key.service} {for_what}"
    for id, (item, asked) in demanded.items():
        others = [other for other in versions if other != id]
        own, theirs = versions.get(id), release_keys.version_of_service(after, service, others)
        if own is None or contents(own, service) == contents(theirs, service):
            continue
        # The difference was there before the demand.
        former = release_keys.running_version(before, id)
        if (
            former
            and former.rank == own.rank
            and any(
                claim.application.id == id for claim in release_keys.claims_needing(before, key)
            )
        ):
            continue
        # Versions of two definitions have names of their own, so the charts are compared.
        by_name = own.appdef == theirs.appdef and own.name
        new, current = (
            version.name if by_name else version.charts[service.chart].version
            for version in (own, theirs)
        )
        remedy = f"version {current}" if by_name else f"a version that has {key.service} {current}"
        sharing = ", ".join(f"'{other}'" for other in others[:3])
        message = (
            f"{what} would run in version {new}, but is shared with {sharing} in version "
            f"{current}; request {remedy}"
        )
        appdefs = (config.appdefs[version.appdef] for version in (own, theirs))
        strictest = min(appdefs, key=lambda appdef: _STRICTNESS.index(appdef.versions))
        difference = Difference(
            what,
            strictest.name,
            strictest.versions,
            new,
            current,
            precedence(new) > precedence(current),
            item.fault("version", message, code="conflict"),
        )
        if difference.matters_to(asked):
            yield difference
