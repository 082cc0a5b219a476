"""May a requester demand an application? The rule, quota, override or approval that decides."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime

from demandops.base.errors import Fault, Refused, fault, suggestion
from demandops.decide import booking
from demandops.decide.admission import permission
from demandops.decide.checks import forbidden
from demandops.decide.state import State
from demandops.model.config.policy import matches
from demandops.model.demand.demand import Application, Demand, Item


@dataclass(frozen=True, slots=True)
class Answer:
    node: str
    faults: tuple[Fault, ...]  # why not
    rules: tuple[str, ...]  # what allows it
    approval: tuple[str, ...]  # what requires that a person approves it


def may_demand(
    requester: str, appdef: str, node: str, version: str, state: State, now: datetime
) -> Answer:
    """Return whether policy and overrides let the demand pass, whatever inputs it will have.

    Without ``node``, the answer is that for the first node on which it may, else for the last one.
    """
    config = state.config
    versions = config.application_versions.get(appdef, {})
    for field, word, known in (
        ("APPLICATION", appdef, config.appdefs),
        ("--node", node, config.nodes),
        ("--version", version, versions),
    ):
        if word and word not in known:
            raise Refused.at(field, f"'{word}' is not known{suggestion(word, known)}")
    answer = Answer(node, (fault("node", "no node is in an access domain"),), (), ())
    for name in [node] if node else sorted(config.domain_of):
        held = Application(f"may/{requester}", appdef, name, version=version)
        demanded = (Item(held, (requester,)),)
        demand = Demand("put", "may", demanded, f"may/{requester}", (requester,))
        faults = list(permission.faults(demand, config))
        if name not in config.domain_of:
            faults.append(fault("node", f"'{name}' is in no access domain; see policy/"))
        ledger, changes = booking.apply(state.ledger, demand, now)
        after = replace(state, ledger=ledger)
        faults += forbidden.denial_faults(demand, after, changes)
        faults += forbidden.quota_faults(state, after, changes)
        rules = (
            f"rule '{rule.name}' of access domain '{domain.name}'"
            for domain, access in permission.needed_access(held, config)
            for rule in domain.rules
            if matches(requester, rule.requesters)
            and permission.first_uncovered(rule, access) is None
        )
        pairs = ((change.before, change.after) for change in changes.claims)
        approval, _ = permission.approval(demand, pairs, config)
        answer = Answer(name, tuple(dict.fromkeys(faults)), tuple(rules), approval)
        if not faults:
            break
    return answer
