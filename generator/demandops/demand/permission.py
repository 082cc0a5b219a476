"""Permission: the check that requesters may demand the applications, nodes and leases they ask for.

The access domains of the nodes decide. Every refusal names the access domain, and what in it does
not allow the request. For a connection between two domains, each of the two domains needs a rule
that names the other one. A domain, one of its rules or an application definition can also require
that a person approves claims before they are booked.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from demandops.config.config import Config
from demandops.config.durations import duration_text, seconds_of
from demandops.config.policy import AccessDomain, Rule, matches
from demandops.connections.connection import Connection
from demandops.demand.application import Application
from demandops.demand.claim import Claim
from demandops.demand.demand_request import AnyRequest, Demanded, DemandRequest, Put
from demandops.demand.lease import Term
from demandops.errors import Fault, fault

# Pairs of a rule's field, such as ``nodes``, and a value that this field must allow
Access = list[tuple[str, str]]

# The field of a rule that lists the access domains to which connections may lead
PEERS = "peers"
# For a domain whose policy has no rules: everybody may demand everything inside of the domain
_NO_RULES = (Rule(name="everything"),)


def faults(request: DemandRequest, config: Config) -> Iterator[Fault]:
    """Yield a fault for everything that the access domains do not allow the requesters.

    A request that adds no claims needs no permission. :mod:`demandops.demand.admission` reports
    nodes without a domain.
    """
    if not request.adds_claims:
        return
    for one in request.demanded:
        for domain, access in needed_access(one.held, config):
            yield from _not_allowed(one, domain, access)
        home = config.domain_of.get(one.held.home)
        if home is not None:
            yield from _too_long(request, home)


def needed_access(
    held: Application | Connection, config: Config
) -> Iterator[tuple[AccessDomain, Access]]:
    """Yield (access domain, access) for each node where services run or a connection has an end.

    The access domain is the node's; a node without one is left out. The access is what a rule of
    this domain must grant.
    """
    more: Access = []
    if isinstance(held, Application):
        nodes, first = _service_nodes(held, config), [("applications", held.appdef)]
    else:
        nodes, first = held.nodes, []
        more = held.type.access(held, config) if held.type else []
    domains = {node: config.domain_of[node] for node in nodes if node in config.domain_of}
    for node, domain in domains.items():
        access = [*first, ("nodes", config.host_of(node)), *more]
        if isinstance(held, Connection):
            others = {other.name for other in domains.values()} - {domain.name}
            access += [(PEERS, other) for other in others]
        yield domain, access


def _service_nodes(app: Application, config: Config) -> Iterable[str]:
    """Return the nodes on which services of an application run.

    These are the application's node, the sources at which services run, and the nodes of services
    that run once for a cluster or have a node of their own. A node to which an override moves a
    service is left out, because the override's owner decides about that node.
    """
    services = config.services.get(app.appdef, {}).values()
    roles = {role for one in services if one.at_source for role in one.roots}
    others = (one.runs_at[app.node] for one in services if app.node in one.runs_at)
    return (
        app.node,
        *app.services.values(),
        *others,
        *(one.source for role in sorted(roles) for one in app.inputs.get(role, ())),
    )


def may_place(one: Demanded, appdef: str, node: str, config: Config) -> bool:
    """Return whether the requesters may use a node for an application of the type ``appdef``.

    If ``appdef`` is empty, return whether they may use the node as an end of a connection.
    """
    domain = config.domain_of.get(node)
    access: Access = [("applications", appdef)] if appdef else []
    access.append(("nodes", config.host_of(node)))
    return domain is not None and not any(_not_allowed(one, domain, access))


def _not_allowed(one: Demanded, domain: AccessDomain, access: Access) -> Iterator[Fault]:
    """Yield a fault for each requester to whom no rule of the domain grants the access."""
    rules = domain.rules or _NO_RULES
    for index, requester in enumerate(one.requesters):
        own = [rule for rule in rules if matches(requester, rule.requesters)]
        misses = [first_uncovered(rule, access) for rule in own]
        if own and None in misses:
            continue
        if not own:
            known = ", ".join(f"{rule.name} ({' '.join(rule.requesters)})" for rule in domain.rules)
            message = (
                f"no rule of access domain '{domain.name}' is for '{requester}'; its rules are "
                f"{known}; ask for a change of policy/"
            )
        else:
            reasons = "; ".join(
                _reason(domain, rule, requester, *miss)
                for rule, miss in zip(own, filter(None, misses), strict=True)
            )
            message = f"{reasons}; request what is allowed, or ask for a change of policy/"
        yield one.fault(f"requesters[{index}]", message, code="not-allowed")


def _reason(domain: AccessDomain, rule: Rule, requester: str, kind: str, value: str) -> str:
    where = f"access domain '{domain.name}'"
    if kind == PEERS:
        whose = f"rule '{rule.name}' of {where}" if domain.rules else where
        return (
            f"{whose} does not let '{requester}' connect the domain's nodes to nodes of '{value}' "
            "(peers)"
        )
    return (
        f"rule '{rule.name}' of {where} lets '{requester}' have only these {kind}: "
        f"{' '.join(getattr(rule, kind))}, not '{value}'"
    )


def first_uncovered(rule: Rule, access: Access) -> tuple[str, str] | None:
    """Return the first pair of ``access`` that ``rule`` lacks; ``None`` if it grants all pairs."""
    return next(
        ((kind, value) for kind, value in access if not matches(value, getattr(rule, kind))), None
    )


def _too_long(request: DemandRequest, domain: AccessDomain) -> Iterator[Fault]:
    longest, lease_s = domain.leases.longest, _wanted_lease(request)
    if longest is None or lease_s is None or lease_s <= seconds_of(longest):
        return
    yield fault(
        "lease",
        f"is {duration_text(lease_s)}, but leases.longest of access domain '{domain.name}' is "
        f"{longest}; request a shorter lease, and renew it",
        code="not-allowed",
    )


def with_lease_terms(request: AnyRequest, config: Config) -> AnyRequest:
    """Return the request with the lease term of each item.

    The lease policy of the item's access domain sets the term. An item without a lease gets
    ``None``.
    """

    def with_term(one: Demanded) -> Demanded:
        domain = config.domain_of.get(one.held.home)
        return replace(one, term=term(request, domain) if domain else None)

    return replace(request, demanded=tuple(map(with_term, request.demanded)))


def term(request: DemandRequest, domain: AccessDomain) -> Term | None:
    """Return the lease term that a request gets in an access domain; ``None`` for no lease."""
    policy = domain.leases
    if request.is_reference and not policy.deployment_requests:
        return None
    given = policy.default or policy.longest
    seconds = _wanted_lease(request) or (seconds_of(given) if given else None)
    return Term(seconds, seconds_of(policy.slack)) if seconds else None


def _wanted_lease(request: DemandRequest) -> int | None:
    return request.lease_s if isinstance(request, Put) else None


def approval_reasons(
    request: DemandRequest, changes: Iterable[tuple[Claim | None, Claim | None]], config: Config
) -> tuple[str, ...]:
    """Return the reasons why a request needs approval, such as ``access domain 'edge'``, each once.

    The result is empty if the request needs none. Renewals, releases and the claims of overrides
    need no approval.

    Args:
        request: an admitted request.
        changes: each changed claim as (before the request, after the request).
        config: the access domains and application definitions.
    """
    if not request.adds_claims:
        return ()
    listed = set(request.subjects())
    changed = (
        after
        for before, after in changes
        if after and after.subject in listed and _is_more_than_renewed(before, after)
    )
    return tuple(dict.fromkeys(reason for claim in changed for reason in _reasons(claim, config)))


def _is_more_than_renewed(before: Claim | None, after: Claim) -> bool:
    return before is None or replace(after, lease=before.lease) != before


def _reasons(claim: Claim, config: Config) -> Iterator[str]:
    if isinstance(claim.held, Application):
        appdef = config.appdefs.get(claim.held.appdef)
        if appdef is not None and appdef.approval == "required":
            yield f"application definition '{appdef.name}'"
    for domain, access in needed_access(claim.held, config):
        for requester in claim.requesters:
            yield from _domain_reasons(domain, requester, access)


def _domain_reasons(domain: AccessDomain, requester: str, access: Access) -> Iterator[str]:
    """Yield why an access to a domain needs approval, if no rule grants it without approval."""
    rules = [
        rule
        for rule in domain.rules
        if matches(requester, rule.requesters) and first_uncovered(rule, access) is None
    ]
    if any((rule.approval or domain.approval) == "none" for rule in rules):
        return
    own = [rule for rule in rules if rule.approval == "required"]
    for rule in own:
        yield f"rule '{rule.name}' of access domain '{domain.name}'"
    if not own and domain.approval == "required":
        yield f"access domain '{domain.name}'"


def with_leases_from_approval(request: AnyRequest) -> AnyRequest:
    """Return the request with leases that start when a person approves the request."""

    def from_approval(one: Demanded) -> Demanded:
        return replace(one, term=replace(one.term, on_approval=True)) if one.term else one

    return replace(request, demanded=tuple(map(from_approval, request.demanded)))
