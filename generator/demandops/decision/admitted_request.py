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

_ITEM = re.compile(r"(apps|applications|connections)\[(\d+)\]")


# yields faults if a request comes too soon after others of its requesters
Throttle = Callable[[DemandRequest, Config], Iterable[Fault]]
# is called often during a decision, and raises OverBudget to end it
Checkpoint = Callable[[], None]


def admitted(
    state: State,
    goal: object,
    now: datetime,
    throttle: Throttle,
    checkpoint: Checkpoint,
) -> DemandRequest:
    """Return the request that a goal becomes: to wait, if it lacks only room and may wait.

    Raises:
        Refused: if the goal does not pass all checks of :func:`admit` and the demand cannot wait.
    """
    try:
        return admit(state, goal, throttle, None, checkpoint)
    except Refused as refused:
        if any(each.code != NO_ROOM for each in refused.faults):
            raise
        # the reference's action names no demand that could wait
        if not isinstance(goal, dict) or not demand_goal.is_demand_goal(goal):
            raise
        parsed = separate_instance.with_separate_instances(demand_goal.parse(goal)[0], state.config)
        before = state.ledger.waiting.get(parsed.demand)
        mine = before is None or {*before.requesters} & {*parsed.requesters()}
        # a demand that holds claims keeps them when it is refused, so it cannot wait as well
        holds = state.ledger.claims_of_demand(parsed.demand)
        if not isinstance(parsed, Put) or holds or not mine:
            raise
        if not placement.may_wait(parsed, state, checkpoint):
            raise
        if faults := list(throttle(parsed, state.config)):
            raise Refused(faults) from None
        # a demand that is sent again keeps its place among those that wait
        since = before.since if before else now
        who = tuple(sorted({*parsed.requesters()}))
        waiting = WaitingDemand(parsed.demand, parsed.id, who, since, parsed.priority, goal)
        reasons = tuple(each.message for each in refused.faults)
        return Wait(parsed.id, (), parsed.demand, who, waiting, reasons)


def admit(
    state: State,
    goal: object,
    throttle: Throttle = lambda request, config: (),
    trial: placement.Trial | None = None,
    checkpoint: Checkpoint = lambda: None,
) -> DemandRequest:
    """Return the request that a goal becomes, if the goal passes all checks.

    If ``trial`` is given, a node is chosen only if ``trial`` accepts the request with this node.

    Raises:
        Refused: with the limits that the goal exceeds, if it is too large. Otherwise with every
            fault in the form and in the content of the goal. If there is none, with every fault
            that ``throttle`` yields.
    """
    config, ledger = state.config, state.ledger
    limits = config.repo_settings.limits
    if isinstance(goal, dict) and Decommission.is_goal(goal):
        decommission = Decommission.parse(goal)
        return replace(decommission, nodes=config.nodes_of(decommission.id))
    # before anything is parsed, because the parser's work grows with the goal
    _refuse(admission.length_faults(goal, limits))
    if isinstance(goal, dict) and demand_goal.is_demand_goal(goal):
        parsed, faults = demand_goal.parse(goal)
        _refuse(admission.size_faults(parsed, limits))
        if parsed.adds_claims:
            checkpoint()
        # the id of a separate instance comes first, because the placement looks for claims on it
        parsed = separate_instance.with_separate_instances(parsed, config)
        parsed, unclear = chosen_domain.with_chosen_domains(parsed, config, ledger.held)
        request = output_topics.with_further_topics(parsed, ledger, config)
    else:
        wired, faults = deployment_request_goal.parse(goal, config.appdef_by_wire_type)
        if wired is None:
            raise Refused(faults)
        _refuse(admission.size_faults(wired, limits))
        request, unclear = chosen_domain.with_chosen_domains(wired, config, ledger.held)
    request, not_placed = placement.with_chosen_nodes(
        request, state, state.usage(), trial, checkpoint
    )
    # what was booked must be released, however long that takes
    checkpoint = checkpoint if request.adds_claims else lambda: None
    checkpoint()
    request = completed(request, state)
    _refuse(admission.size_faults(request, limits))  # derived connections count as well
    checkpoint()
    # A field that is malformed was left out, so faults of its content would be wrong. The faults of
    # form and of content that remain are reported together, to be mended in one go.
    malformed = {each.field for each in faults}
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
        each
        for each in content
        if each.field not in around_malformed
        and malformed.isdisjoint(_with_parents(each.field))
        and not (unread and each.code == "empty")
    ]
    # last, because a goal with faults does not count against the limits of its requesters
    faults = faults or list(throttle(request, config))
    if faults:
        # the faults of one application or connection are reported together
        raise Refused(sorted(dict.fromkeys(faults), key=lambda each: _item_of(each.field)))
    return request


def completed(request: DemandRequest, state: State) -> DemandRequest:
    """Return a request, whose nodes are chosen, with all else that the generator adds."""
    config, ledger = state.config, state.ledger
    request = permission.with_lease_terms(request, config)
    if request.is_reference:  # its clients list their connections and shut down what they listed
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
    for item in items:
        checkpoint()
        yield item


def permission_faults(
    request: DemandRequest, config: Config, checkpoint: Checkpoint
) -> Iterator[Fault]:
    for item in paced(request.demanded, checkpoint):  # an access domain may have many rules
        yield from permission.faults(replace(request, demanded=(item,)), config)


def _refuse(faults: Iterable[Fault]) -> None:
    if listed := list(faults):
        raise Refused(listed)


def form_faults(goal: object) -> list[Fault]:
    """Return the faults in a goal's form that need no configuration, such as unknown fields."""
    if isinstance(goal, dict) and demand_goal.is_demand_goal(goal):
        return demand_goal.parse(goal)[1]
    return deployment_request_goal.form_faults(goal)


def _with_parents(field: str) -> Iterator[str]:
    yield field
    for match in re.finditer(r"[.\[]", field):
        yield field[: match.start()]


def _item_of(field: str) -> tuple[str, int]:
    match = _ITEM.match(field)
    return (match[1], int(match[2])) if match else ("", 0)
