"""Permission: the check that requesters may demand the applications, nodes and leases they ask for.

The access domains of the nodes decide. Every refusal names the access domain, and what in it does
not allow the request. For a connection between two domains, each of the two domains needs a rule
that names the other one. A domain, one of its rules or an application definition can also require
that a person approves claims before they are booked.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from demandops.base.errors import Fault, fault
from demandops.connections.connection import Connection
from demandops.model.config.base_model import duration_text, matches, seconds_of
from demandops.model.config.config import Config
from demandops.model.config.policy import AccessDomain, Rule
from demandops.model.demand.demand import Application, Demand, Item, Lease
from demandops.model.ledger.claim import requesters_of
from demandops.model.ledger.ledger import ClaimChange, Ledger

# pairs of a rule's field, such as ``nodes``, and a value that this field must allow
Access = list[tuple[str, str]]

# the field of a rule that lists the access domains to which connections may lead
PEERS = "peers"
# without rules in a domain's policy, everybody may demand everything inside of the domain
_NO_RULES = (Rule(name="everything"),)


def faults(request: Demand, config: Config) -> Iterator[Fault]:
    if not request.adds_claims:  # everybody may release what is theirs
        return
    lease_s = request.lease_s
    for item in request.demanded:
        for domain, access in needed_access(item.held, config):
            yield from _not_allowed(item, domain, access)
        home = config.domain_of.get(item.held.home)  # the admission reports nodes without a domain
        longest = home.leases.longest if home else None
        if home and longest and lease_s is not None and lease_s > seconds_of(longest):
            message = (
                f"is {duration_text(lease_s)}, but leases.longest of access domain '{home.name}' "
                f"is {longest}; request a shorter lease, and renew it"
            )
            yield fault("lease", message, code="not-allowed")


def needed_access(
    held: Application | Connection, config: Config
) -> Iterator[tuple[AccessDomain, Access]]:
    """Yield (domain, what a rule of it must grant) for each node of services or of an end."""
    more: Access = []
    if isinstance(held, Application):
        first = [("applications", held.appdef)]
        services = config.services.get(held.appdef, {}).values()
        roles = {role for service in services if service.at_source for role in service.roots}
        # A node to which an override moves a service is left out: the override's owner decides
        nodes: Iterable[str] = (
            held.node,
            *held.services.values(),
            *(service.runs_at[held.node] for service in services if held.node in service.runs_at),
            *(topic.source for role in sorted(roles) for topic in held.inputs.get(role, ())),
        )
    else:
        nodes, first = held.nodes, []
        broker = held.type.broker_node(held, config) if held.type else ""
        more = [("brokers", broker)] if broker else []
    domains = {node: config.domain_of[node] for node in nodes if node in config.domain_of}
    for node, domain in domains.items():
        access = [*first, ("nodes", config.host_of(node)), *more]
        if isinstance(held, Connection):
            others = {other.name for other in domains.values()} - {domain.name}
            access += [(PEERS, other) for other in others]
        yield domain, access


def may_place(item: Item, node: str, config: Config) -> bool:
    """Return whether the requesters may use a node for an application, or as a connection's end."""
    domain = config.domain_of.get(node)
    access = [("nodes", config.host_of(node))]
    if isinstance(item.held, Application) and item.held.appdef:
        access = [("applications", item.held.appdef), *access]
    return domain is not None and not any(_not_allowed(item, domain, access))


def _not_allowed(item: Item, domain: AccessDomain, access: Access) -> Iterator[Fault]:
    rules = domain.rules or _NO_RULES
    for index, requester in enumerate(item.requesters):
        own = [rule for rule in rules if matches(requester, rule.requesters)]
        # one rule must grant the whole access: two rules that grant half of it each do not add up
        misses = [first_uncovered(rule, access) for rule in own]
        if own and None in misses:
            continue
        if not own:
            named = ", ".join(f"{rule.name} ({' '.join(rule.requesters)})" for rule in domain.rules)
            message = (
                f"no rule of access domain '{domain.name}' is for '{requester}'; its rules are "
                f"{named}; ask for a change of policy/"
            )
        else:
            where, reasons = f"access domain '{domain.name}'", list[str]()
            for rule, (kind, value) in zip(own, filter(None, misses), strict=True):
                whose = f"rule '{rule.name}' of {where}"
                if kind == PEERS:
                    reasons.append(
                        f"{whose if domain.rules else where} does not let '{requester}' connect "
                        f"the domain's nodes to nodes of '{value}' (peers)"
                    )
                else:
                    reasons.append(
                        f"{whose} lets '{requester}' have only these {kind}: "
                        f"{' '.join(getattr(rule, kind))}, not '{value}'"
                    )
            message = (
                f"{'; '.join(reasons)}; request what is allowed, or ask for a change of policy/"
            )
        yield item.fault(f"requesters[{index}]", message, code="not-allowed")


def first_uncovered(rule: Rule, access: Access) -> tuple[str, str] | None:
    missing = (pair for pair in access if not matches(pair[1], getattr(rule, pair[0])))
    return next(missing, None)


# ---- owners: the requesters for whom a demand holds claims or waits ----
#
# A demand is put anew, renewed and released by exactly its owners. If one common requester were
# enough, a station that all vehicles name would open each vehicle's demand to all others. Nor does
# a second requester who chooses the same demand id by chance change the demand of the first.


def owner_faults(request: Demand, ledger: Ledger, config: Config) -> Iterator[Fault]:
    """Yield a fault if the request changes a demand of others, which no rule lets it manage."""
    waiting = ledger.waiting.get(request.demand)
    claims = ledger.claims_with("demand", request.demand)
    owners = waiting.requesters if waiting else requesters_of(claims)
    homes = None if waiting else [claim.held.home for claim in claims]
    yield from stranger_faults(request, owners, homes, config)


def stranger_faults(
    request: Demand, owners: Iterable[str], homes: Iterable[str] | None, config: Config
) -> Iterator[Fault]:
    # ``homes`` are the nodes of the demand's claims; None if it waits for one
    owners, asking = {*owners}, {*request.requesters()}
    # the generator itself ends leases, and names nobody
    changes_one = request.operation in ("put", "release", "renew", "wait")
    if not changes_one or not owners or asking == owners:
        return

    def managed_in(domain: AccessDomain) -> set[str]:
        rules = [r for r in domain.rules if all(matches(owner, r.manages) for owner in owners)]
        return {who for who in asking if any(matches(who, rule.requesters) for rule in rules)}

    if homes is None:
        managers = set[str]().union(*map(managed_in, config.domains.values()))
    else:
        domains = {home: config.domain_of[home] for home in homes if home in config.domain_of}
        managers = asking.intersection(*map(managed_in, domains.values())) if domains else set()
    if not (managers and asking <= managers | owners):
        message = (
            f"'{request.demand}' is a demand of {', '.join(sorted(owners))}; name exactly these "
            "requesters, choose another demand id, or ask for a rule that 'manages' them in policy/"
        )
        yield fault("demand", message, code="not-yours")


def lease_in(domain: AccessDomain, request: Demand) -> Lease | None:
    policy = domain.leases
    # the reference's clients need not repeat their demands, unless the policy says so
    if request.is_reference and not policy.deployment_requests:
        return None
    given = policy.default or policy.longest
    seconds = request.lease_s or (seconds_of(given) if given else None)
    return Lease(seconds, seconds_of(policy.slack)) if seconds else None


def approval(
    request: Demand, changes: Iterable[ClaimChange], config: Config
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return what requires a person's approval, and the rules that let requesters do without it."""
    if not request.adds_claims:
        return (), ()
    listed = set(request.subjects())  # without the claims of overrides, which need no approval
    reasons, exempting = dict[str, None](), dict[str, None]()
    for change in changes:
        # a renewal needs no approval, because the person approved what it renews
        after = change.after
        if after is None or after.subject not in listed or change.only_renews:
            continue
        if isinstance(after.held, Application):
            appdef = config.appdefs.get(after.held.appdef)
            if appdef is not None and appdef.approval == "required":
                reasons[f"application definition '{appdef.name}'"] = None
        for domain, access in needed_access(after.held, config):
            for requester in after.requesters:
                granting = [
                    rule
                    for rule in domain.rules
                    if matches(requester, rule.requesters) and first_uncovered(rule, access) is None
                ]
                free = [rule.name for rule in granting if not domain.asks(rule)]
                requiring = [rule.name for rule in granting if rule.approval == "required"]
                # one rule that grants the access without approval is enough
                if free:
                    for name in free if requiring or domain.approval == "required" else ():
                        exempting[f"rule '{name}' of access domain '{domain.name}'"] = None
                    continue
                for name in requiring:
                    reasons[f"rule '{name}' of access domain '{domain.name}'"] = None
                if not requiring and domain.approval == "required":
                    reasons[f"access domain '{domain.name}'"] = None
    return tuple(reasons), tuple(exempting)
