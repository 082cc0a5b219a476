"""Refuses a demand for what people forbid or limit.

They do so by overrides, quotas, the capacity of nodes, and policies of versions.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice

from rpds import HashTrieMap

from demandops.base.errors import Fault, Refused, fault
from demandops.base.naming import Subject, SubjectKind
from demandops.base.quantities import amount_of, amount_text
from demandops.connections.connection import Connection
from demandops.decide.planning import overrides
from demandops.decide.planning.overrides import Traits, fits, without_suspended
from demandops.decide.planning.planner import (
    ReleaseKey,
    affected_keys,
    claims_needing,
    contents,
    is_needed,
    keys_of,
    keys_of_claims,
    newest_asked,
    planned,
    running_version,
    version_of_service,
)
from demandops.model.config.appdef import VersionPolicy
from demandops.model.config.base_model import matches
from demandops.model.config.config import NODES_FILE, Config
from demandops.model.config.override import Selector, format_time
from demandops.model.config.policy import AccessDomain
from demandops.model.config.registry import ApplicationVersion, precedence
from demandops.model.demand.demand import Application, Demand, Item
from demandops.model.ledger.ledger import Changes, ClaimChange, World
from demandops.model.release import Release, ServiceKey, ServiceRelease, most_replicas

# ---- denials: a demand is refused if an override selects what it asks for ----
#
# One with ``deny`` suspends existing claims that it selects. A demand that only repeats them is not
# refused; its requester gets a warning. One with ``refuseNew`` leaves existing claims alone, and
# lets them become smaller.


def denial_faults(request: Demand, after: World, changes: Changes) -> Iterator[Fault]:
    refusing = [each for each in reversed(after.overrides) if each.deny or each.refuseNew]
    if not refusing or not request.adds_claims:
        return
    changed = {change.key.subject for change in changes.claims if not change.only_renews}
    wider = {change.key.subject for change in changes.claims if not change.only_narrows}
    own = {change.key for change in changes.claims}
    for item in request.demanded:
        if item.held.subject not in changed:
            continue
        # A selector that names services is compared with each service of the application, because
        # a service may run on another node than the application. Any other is compared with the
        # demand.
        demanded, services = overrides.traits_of(item), list[Traits]()
        if isinstance(item.held, Application):
            services = [
                replace(demanded, nodes=(key.node,), service=key.service)
                for key in keys_of_claims(after, after.ledger.claims_on(item.held.subject))
                if isinstance(key, ServiceKey)
            ]
        matching = (
            (override, selector)
            for override in refusing
            if override.deny or item.held.subject in wider
            for selector in override.select
            for traits in (services if selector.services else [demanded])
            if fits(selector, traits, after.config)
        )
        for override, selector in islice(matching, 1):
            until = f" until {format_time(override.end)}" if override.end else ""
            carried = ""
            if isinstance(item.held, Connection) and not item.is_listed:
                route = item.held.topics[0]
                what = f" of connection '{route.listed}'" if route.listed else ""
                topic = item.held.key_of(route).topic
                carried = f"{topic}{what} is carried by connection '{item.held.id}', which "
            claims = after.ledger.claims_on(item.held.subject)  # others may have it already
            to_it = " to this demand" if any(claim.key not in own for claim in claims) else ""
            how = "is denied" if override.deny else f"is new{to_it}, and refused"
            message = (
                f"{carried}{how} by {override.path}{until}: {override.reason}; ask the "
                f"override's owner, {override.owner}, or demand something else"
            )
            yield item.fault(_matched_field(selector, item, after.config), message, code="denied")


def _matched_field(selector: Selector, item: Item, config: Config) -> str:
    if selector.applications or selector.connections:
        return "id"
    if selector.requesters:
        patterns = selector.requesters
        index = next(i for i, name in enumerate(item.requesters) if matches(name, patterns))
        return f"requesters[{index}]"
    if selector.services or selector.appdefs:
        return "type"
    if isinstance(item.held, Application):
        return "node"
    source = item.held.source
    at_source = not selector.nodes or matches(source, selector.nodes)
    return "source" if at_source and overrides.has_labels(selector, source, config) else "target"


def warnings(request: Demand, world: World) -> Iterator[str]:
    """Yield a warning for each suspended claim of the requesters that a demand holds or lists."""
    if not any(override.deny for override in world.overrides):
        return
    claims = [
        *world.ledger.claims_with("demand", request.demand),
        *(claim for subject in request.subjects() for claim in world.ledger.claims_on(subject)),
    ]
    for claim in {claim.key: claim for claim in claims}.values():
        override = overrides.suspended_by(claim, world)
        if override and {*claim.requesters} <= {*request.requesters()}:
            by = f"{override.path} of {override.owner}: {override.reason}"
            yield f"{claim.subject} is suspended by {by}"


# ---- quotas of an access domain: claims for each requester, and services on each node ----
#
# The quota ``demandsPerMinute`` is checked elsewhere (:mod:`.agenda`).


def quota_faults(before: World, after: World, changes: Changes) -> Iterator[Fault]:
    """Yield a fault for each quota that the booking exceeds and whose count it raises.

    Suspended claims count for ``claimsPerRequester``. Their services do not run, and so do not
    count for ``servicesPerNode``.
    """
    domain_of = after.config.domain_of
    booked = [change.after for change in changes.claims if change.after]
    holders = {(claim.held.home, who) for claim in booked for who in claim.requesters}
    domains = {
        (domain.name, who): domain for node, who in holders if (domain := domain_of.get(node))
    }
    for (_, requester), domain in sorted(domains.items(), key=lambda pair: pair[0]):
        most = domain.quotas.claims_per_requester
        # The ledger has the count in all domains at hand. If even that fits, no search is needed.
        if most is None or len(after.ledger.keys_with("requester", requester)) <= most:
            continue
        count = _held(requester, after, domain)
        if count > most and count > _held(requester, before, domain):
            usage = f"'{requester}' would hold {count} claims"
            yield _exceeded(domain, "claimsPerRequester", most, usage)
    touched = [claim for change in changes.claims if (claim := change.after or change.before)]
    apps = [claim.application for claim in touched if claim.is_on_application]
    nodes = {node for app in apps for node in app.needed_nodes()}
    # A service that runs once for each cluster runs at the node that its definition names.
    nodes |= {
        service.runs_at[app.node]
        for app in apps
        for service in after.config.services.get(app.appdef, {}).values()
        if app.node in service.runs_at
    }
    for node in sorted(nodes):
        of_node = domain_of.get(node)
        most = of_node.quotas.services_per_node if of_node else None
        if of_node is None or most is None:
            continue
        count = _running(node, after)
        if count > most and count > _running(node, before):
            usage = f"'{node}' would run {count} services"
            yield _exceeded(of_node, "servicesPerNode", most, usage)


def _held(requester: str, world: World, domain: AccessDomain) -> int:
    claims = world.ledger.claims_with("requester", requester)
    return sum(world.config.domain_of.get(claim.held.home) is domain for claim in claims)


def _running(node: str, world: World) -> int:
    world = without_suspended(world)
    ids = world.ledger.ids_with("node", node)
    subjects = (Subject(SubjectKind.APPLICATION, id) for id in ids)
    keys = {key for subject in subjects for key in keys_of(world, subject)}
    for name, service in world.config.definitions.items():
        key = ServiceKey(name, node, for_cluster=True)
        if node in service.nodes.values() and is_needed(world, key):
            keys.add(key)
    return sum(isinstance(key, ServiceKey) and key.node == node for key in keys)


def _exceeded(domain: AccessDomain, quota: str, most: int, usage: str) -> Fault:
    return fault(
        "",
        f"{usage}, but quotas.{quota} of access domain '{domain.name}' allows {most}; release "
        "something first, or ask for a change of policy/",
        code="quota",
    )


# ---- capacity: how much the running services request of each node, and how much the node has ----
#
# Each replica of a service requests resources of the node where the replica runs. The service's
# definition says how much. A shared service counts once. Communication clients request nothing.

# The ids of a node and of a resource, as in ``("edge", "cpu")``.
Need = tuple[str, str]
Plans = Mapping[ReleaseKey, Release | None]


@dataclass(frozen=True, slots=True)
class Usage:
    """What services request on each node, for each resource, in thousandths of a unit."""

    # This map follows each demand by what the demand changes. Its copies share what stays the same.
    amounts: HashTrieMap[Need, int] = field(default_factory=HashTrieMap)

    def of(self, node: str, resource: str) -> int:
        return self.amounts.get((node, resource)) or 0

    def plus(self, growth: Mapping[Need, int]) -> Usage:
        amounts = self.amounts
        for need, amount in growth.items():
            total = self.of(*need) + amount
            amounts = amounts.insert(need, total) if total else amounts.discard(need)
        return Usage(amounts)


def whole_usage(world: World) -> Usage:
    """Return what all services request on each node; empty if no node declares a capacity."""
    if not world.config.limits_capacity:
        return Usage()
    apps = (each for each in world.ledger.claims if each.kind is SubjectKind.APPLICATION)
    keys = dict.fromkeys(key for app in apps for key in keys_of(world, app))
    return Usage().plus(requests(planned(world, keys), world.config))


def growth(before: Plans, after: Plans, config: Config) -> dict[Need, int]:
    if not config.limits_capacity:
        return {}
    change = requests(after, config)
    change.subtract(requests(before, config))
    return {need: amount for need, amount in change.items() if amount}


def growth_by(before: World, after: World, changes: Iterable[ClaimChange]) -> dict[Need, int]:
    if not after.config.limits_capacity:
        return {}
    keys = affected_keys(before, after, changes)
    # a release that cannot be planned requests nothing
    return growth(planned(before, keys), planned(after, keys), after.config)


def requests(plans: Plans, config: Config) -> Counter[Need]:
    total: Counter[Need] = Counter()
    for release in plans.values():
        if isinstance(release, ServiceRelease) and release.service.requests:
            # A machine in several access domains has a node in each, but only one capacity.
            host, replicas = config.host_of(release.node.id), most_replicas(release.replicas)
            for resource, quantity in release.service.requests.items():
                total[host, resource] += amount_of(quantity) * replicas
    return total


def excesses(usage: Usage, grown: Mapping[Need, int], config: Config) -> Iterator[tuple[str, str]]:
    """Yield (node, reason) for each resource of which a node has too little for the growth."""
    for (id, resource), amount in sorted(grown.items()):
        node, used = config.nodes.get(id), usage.of(id, resource)
        most = node.most(resource) if node else None
        # Only growth is refused. If a person lowers a capacity below what is used, no demand is
        # stopped that adds nothing there.
        if most is not None and amount > 0 and used + amount > most:
            left = max(most - used, 0)
            free, capacity, asked = (amount_text(n, resource) for n in (left, most, amount))
            yield id, f"has {free} of {capacity} {resource} free, but {asked} is asked for"


class NoRoom(Refused):
    """Raised if a demand asks for more than nodes have; ``full`` says of what, by node."""

    def __init__(self, usage: Usage, grown: Mapping[Need, int], config: Config) -> None:
        self.full: dict[str, list[str]] = {}
        faults = []
        for node, excess in excesses(usage, grown, config):
            self.full.setdefault(node, []).append(excess)
            message = (
                f"'{node}' {excess}; choose another node, release something first, or ask "
                f"for a change of {config.place_of(NODES_FILE)}"
            )
            faults.append(fault("", message, code="capacity"))
        super().__init__(faults)


# ---- version differences: demands ask for different versions of what they share ----
#
# The field ``versions`` of the application definition decides what happens. Either the demand is
# refused, or the newest version is deployed. In some cases a person must approve the newest version
# first.

# From the strictest to the least strict.
_STRICTNESS: tuple[VersionPolicy, ...] = ("refuse", "separate", "update", "upgrade")


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
        # with ``separate``, each version is an application of its own: shared services differ
        return self.policy in ("refuse", "separate")

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
        app = claim.application
        demanded[app.id] = item, app.version
        if old is not None and old.application.version == app.version:
            continue
        versions = after.config.application_versions[app.appdef]
        # Two words may name one version, for example a channel and a number.
        if len({versions[word].rank for word in after.ledger.versions_asked(app.id, versions)}) < 2:
            continue
        others = after.ledger.replace(claim.key, None)
        own = versions.get(app.version, versions[""])
        theirs = newest_asked(others, app.id, versions)
        if own.rank == theirs.rank:
            continue
        holders, held = "", ""
        for other in others.claims_on(app.subject):
            word = other.application.version
            if versions.get(word, versions[""]).rank == theirs.rank:
                holders, held = ", ".join(other.requesters), word if word in versions else ""
                break
        message = (
            f"{_version_text(app.version, own)} contradicts an existing claim: '{app.id}' is held "
            f"by {holders} in {_version_text(held, theirs)}; request that version, or use another "
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
    for release in plans.values():
        if isinstance(release, ServiceRelease) and len(release.applications) > 1:
            yield from _of_service(release, demanded, before, without_suspended(after))


def _version_text(word: str, version: ApplicationVersion) -> str:
    named = f"version '{word}'" if word else "the default version"
    return f"{named} ({version.name})" if version.name not in ("", word) else named


def _of_service(
    release: ServiceRelease, demanded: Mapping[str, tuple[Item, str]], before: World, after: World
) -> Iterator[Difference]:
    """Yield the differences of demanded applications, each with the version it asks for."""
    service, key, config = release.service, release.key, after.config
    versions = {id: running_version(after, id) for id in release.applications}
    if len({contents(version, service) for version in versions.values() if version}) == 1:
        return
    for_what = f"for {key.topic} of '{key.source}'" if key.topic else f"on '{key.node}'"
    what = f"{key.service} {for_what}"
    for id, (item, asked) in demanded.items():
        others = [other for other in versions if other != id]
        own, theirs = versions.get(id), version_of_service(after, service, others)
        if own is None or contents(own, service) == contents(theirs, service):
            continue
        # The difference was there before the demand.
        former = running_version(before, id)
        if (
            former
            and former.rank == own.rank
            and any(claim.application.id == id for claim in claims_needing(before, key))
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
