"""The request that a goal becomes: parsed, completed, and checked against the configuration."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from datetime import datetime
from typing import TypeVar

from demandops.config.config import Config
from demandops.decision.state import State
from demandops.demand import (
    admission,
    chosen_domain,
    demand_goal,
    deployment_request_goal,
    permission,
    separate_instance,
)
from demandops.demand.demand_request import Decommission, DemandRequest, Put
from demandops.errors import Fault, Refused
from demandops.ledger.waiting import Wait, WaitingDemand
from demandops.plan import implied_connections, output_topics
from demandops.plan.nodes import placement
from demandops.plan.nodes.choice import NO_ROOM

_SUBJECT = re.compile(r"(apps|applications|connections)\[(\d+)\]")


# A function that yields faults if a request comes too soon after others of its requesters
Throttle = Callable[[DemandRequest, Config], Iterable[Fault]]
# A function that is called often during a decision, and raises ``OverBudget`` to end it
Checkpoint = Callable[[], None]


def admitted(
    state: State,
    goal: object,
    now: datetime,
    throttle: Throttle,
    checkpoint: Checkpoint,
) -> DemandRequest:
    """Return the request that a goal becomes.

    If the demand lacks only room on a node and may wait, the result is a request to wait for room.

    Raises:
        Refused: if the goal does not pass all checks of :func:`admit` and the demand cannot wait. A
            demand that already holds claims never waits.
    """
    try:
        return admit(state, goal, throttle, None, checkpoint)
    except Refused as refused:
        if any(found.code != NO_ROOM for found in refused.faults):
            raise
        # the reference's action names no demand that could wait
        if not isinstance(goal, dict) or not demand_goal.is_demand_goal(goal):
            raise
        parsed = separate_instance.with_separate_instances(demand_goal.parse(goal)[0], state.config)
        known = state.ledger.waiting.get(parsed.demand)
        mine = known is None or {*known.requesters} & {*parsed.requesters()}
        holds = state.ledger.claims_of_demand(parsed.demand)
        if not isinstance(parsed, Put) or holds or not mine:
            raise
        if not placement.may_wait(parsed, state, checkpoint):
            raise
        if faults := list(throttle(parsed, state.config)):
            raise Refused(faults) from None
        since, who = known.since if known else now, tuple(sorted({*parsed.requesters()}))
        waiting = WaitingDemand(parsed.demand, parsed.id, who, since, parsed.priority, goal)
        reasons = tuple(found.message for found in refused.faults)
        return Wait(parsed.id, (), parsed.demand, who, waiting, reasons)


def admit(
    state: State,
    goal: object,
    throttle: Throttle = lambda request, config: (),
    trial: placement.Trial | None = None,
    checkpoint: Checkpoint = lambda: None,
) -> DemandRequest:
    """Return the request that a goal becomes, if the goal passes all checks.

    If ``trial`` is given, a node is chosen only if ``trial`` returns ``True`` for the request with
    this node. ``checkpoint`` is that of :func:`demandops.decision.decision.decide`.

    Raises:
        Refused: with the limits that the goal exceeds, if it is too large. Otherwise with every
            fault in the form and in the content of the goal. If there is none, with every fault
            that ``throttle`` yields.
    """
    config, ledger = state.config, state.ledger
    limits = config.repo_settings.limits
    not_placed: list[Fault] = []
    if isinstance(goal, dict) and Decommission.is_goal(goal):
        parsed_node = Decommission.parse(goal)
        return replace(parsed_node, nodes=config.nodes_of(parsed_node.id))
    _refuse(admission.length_faults(goal, limits))
    if isinstance(goal, dict) and demand_goal.is_demand_goal(goal):
        parsed, faults = demand_goal.parse(goal)
        _refuse(admission.size_faults(parsed, limits))
        if parsed.adds_claims:
            checkpoint()
        parsed = separate_instance.with_separate_instances(parsed, config)
        parsed, unclear = chosen_domain.with_chosen_domains(parsed, config, ledger.held)
        request = output_topics.with_further_topics(parsed, ledger, config)
        request, not_placed = placement.with_chosen_nodes(
            request, state, state.usage(), trial, checkpoint
        )
    else:
        wired, faults = deployment_request_goal.parse(goal, config.appdef_by_wire_type)
        if wired is None:
            raise Refused(faults)
        _refuse(admission.size_faults(wired, limits))
        wired, unclear = chosen_domain.with_chosen_domains(wired, config, ledger.held)
        request, not_placed = placement.with_chosen_nodes(
            wired, state, state.usage(), trial, checkpoint
        )
    checkpoint = checkpoint if request.adds_claims else lambda: None
    checkpoint()
    request = completed(request, state)
    _refuse(admission.size_faults(request, limits))  # derived connections count as well
    checkpoint()
    malformed = {found.field for found in faults}
    around_malformed = {parent for field in malformed for parent in _with_parents(field)}
    content = [
        *unclear,
        *not_placed,
        *paced(admission.faults(request, config), checkpoint),
        *permission_faults(request, config, checkpoint),
    ]
    # a list that could not be read must not be reported as empty
    unread = bool(malformed & {"apps", "applications", "connections"})
    faults += [
        found
        for found in content
        if found.field not in around_malformed
        and malformed.isdisjoint(_with_parents(found.field))
        and not (unread and found.code == "empty")
    ]
    faults = faults or list(throttle(request, config))
    if faults:
        raise Refused(sorted(dict.fromkeys(faults), key=lambda found: _subject_of(found.field)))
    return request


def completed(request: DemandRequest, state: State) -> DemandRequest:
    """Return a request with its lease terms and connection types filled in.

    The reference's requests also get their further topics, and other requests their implied
    connections. The nodes of the request are chosen already.
    """
    config, ledger = state.config, state.ledger
    request = permission.with_lease_terms(request, config)
    if request.is_reference:
        request = output_topics.with_further_topics(request, ledger, config)
    else:
        request = implied_connections.with_implied_connections(request, ledger, config)
    return admission.with_chosen_types(request, config, ledger.connection)


def leaves_nodes_open(state: State, goal: object) -> bool:
    """Return whether the generator chooses or checks nodes for the applications of a goal."""
    if isinstance(goal, dict) and demand_goal.is_demand_goal(goal):
        request: DemandRequest | None = demand_goal.parse(goal)[0]
    else:
        request = deployment_request_goal.parse(goal, state.config.appdef_by_wire_type)[0]
    return request is not None and request.adds_claims and placement.needs_placement(request, state)


_Item = TypeVar("_Item")


def paced(items: Iterable[_Item], checkpoint: Checkpoint) -> Iterator[_Item]:
    """Yield ``items``, and call ``checkpoint`` before each of them is used."""
    for item in items:
        checkpoint()
        yield item


def permission_faults(
    request: DemandRequest, config: Config, checkpoint: Checkpoint
) -> Iterator[Fault]:
    """Yield what is not allowed; ``checkpoint`` is called for each item, as rules may be many."""
    for one in paced(request.demanded, checkpoint):
        yield from permission.faults(replace(request, demanded=(one,)), config)


def _refuse(faults: Iterable[Fault]) -> None:
    if found := list(faults):
        raise Refused(found)


def form_faults(goal: object) -> list[Fault]:
    """Return the faults in a goal's form that need no configuration, such as unknown fields."""
    if isinstance(goal, dict) and demand_goal.is_demand_goal(goal):
        return demand_goal.parse(goal)[1]
    return deployment_request_goal.form_faults(goal)


def _with_parents(field: str) -> Iterator[str]:
    yield field
    for match in re.finditer(r"[.\[]", field):
        yield field[: match.start()]


def _subject_of(field: str) -> tuple[str, int]:
    """Return the list of the goal, and the index in this list, to which a field belongs.

    Faults are sorted by this pair, so that the faults of one application or connection are reported
    together.
    """
    match = _SUBJECT.match(field)
    return (match[1], int(match[2])) if match else ("", 0)
