"""The decision on one demand: from the goal to the files of a commit.

:func:`decide` is one pure function with these stages: parse, admit, book, plan, render. It reads
the state repo only through ``read`` and writes nothing. So the real run, a dry run, and a replay
after the remote got newer commits all call the same function.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cache
from typing import Literal, TypeVar

from demandops.base.errors import Fault, OverBudget, Refused, fault, suggestion
from demandops.base.quoting import quoted
from demandops.connections.connection import ClientKey
from demandops.decide import carriers, warnings
from demandops.decide.admission import admission, permission
from demandops.decide.admission.completing import (
    completed,
    with_chosen_domains,
    with_definitions,
    with_separate_instances,
)
from demandops.decide.booking import Drain, Restoration, apply, restoration_faults
from demandops.decide.checks import collisions, forbidden
from demandops.decide.checks.forbidden import Difference
from demandops.decide.placement import placement, relocation
from demandops.decide.placement.candidates import NO_ROOM
from demandops.decide.planning import flows
from demandops.decide.planning.overrides import update_kept_claims, without_suspended
from demandops.decide.planning.planner import affected_keys
from demandops.decide.state import (
    Changeset,
    FileReader,
    PlannedChange,
    ReleaseChange,
    State,
    plan_change,
    render_change,
)
from demandops.model.config.base_model import matches
from demandops.model.config.config import Config
from demandops.model.demand.demand import Application, Decommission, Demand, Item
from demandops.model.demand.goals import goal_field, read_goal, size_faults
from demandops.model.ledger.claim import demand_id
from demandops.model.ledger.ledger import Changes, World, claim_changes, ledger_of
from demandops.model.ledger.records import Wait, WaitingDemand

_Each = TypeVar("_Each")
_Result = TypeVar("_Result")

Stage = Literal["admitted", "booked"]
Outcome = Literal["booked", "released", "restored", "unchanged", "waiting"]

# the outcome in the receipt, by operation; that of all others is ``released``
_OUTCOMES: dict[str, Outcome] = {
    "join": "booked",
    "put": "booked",
    "renew": "booked",
    "drain": "booked",
    "rollback": "restored",
    "wait": "waiting",
}


@dataclass(frozen=True, slots=True)
class Decision:
    """The effect of a demand.

    ``files`` maps each path to the new text, or to ``None`` if the file is to be removed.
    ``approval`` has the reasons why a person must approve the demand before it is booked, and
    ``approved_by`` the rules without which a person would have to.
    """

    request: Demand
    outcome: Outcome
    state: State
    changes: Changes
    files: Mapping[str, str | None]
    releases: tuple[ReleaseChange, ...]
    warnings: tuple[str, ...]
    approval: tuple[str, ...] = ()
    approved_by: tuple[str, ...] = ()
    # the paths of the overrides that change the content of the rendered files
    overrides: tuple[str, ...] = ()
    # whether waiting demands are tried again: services now request less of a node, or one of the
    # demands shares an application that was booked
    awaited: bool = False
    # a sentence for each placed application or service: the chosen node and the reason
    placed: tuple[str, ...] = ()

    @property
    def lease_s(self) -> int | None:
        """The shortest lease of the demand in seconds: the client must renew as often."""
        waiting = self.state.ledger.waiting.get(self.request.demand)
        if waiting is not None:
            # which domain it will get is open, so any in which it may wait counts
            put, config = waiting.put, self.state.config
            domains = (domain for domain in config.domains.values() if domain.when_full == "wait")
            leases = (permission.lease_in(domain, put) for domain in domains)
            return min((lease.seconds for lease in leases if lease), default=None)
        claims = self.state.ledger.claims_with("demand", self.request.demand)
        claims = claims or tuple(change.after for change in self.changes.claims if change.after)
        return min((claim.lease.seconds for claim in claims if claim.lease), default=None)


# Yields faults if a demand comes too soon after others of its requesters.
Throttle = Callable[[Demand, Config], Iterable[Fault]]
# Is called often during a decision, and raises OverBudget to end it.
Checkpoint = Callable[[], None]
_NO_LIMIT: Checkpoint = lambda: None  # noqa: E731


def decide(
    state: State,
    goal: object,
    now: datetime,
    read: FileReader,
    on_stage: Callable[[Stage], None] = lambda stage: None,
    throttle: Throttle = lambda demand, config: (),
    checkpoint: Checkpoint = _NO_LIMIT,
) -> Decision:
    """Return the decision on a demand, or on its goal as plain data.

    A demand that is complete is not checked against the configuration and its policy again.

    Args:
        now: when the demand was received, with time zone.
        on_stage: called when the demand is admitted and when it is booked, each at most once.
            Later checks may still refuse an admitted demand.
        throttle: called if all other checks of admission find no fault, for one demand perhaps
            with several nodes. It is not called for a :class:`Decommission` and for the
            generator's own.
        checkpoint: called often while a demand that may add claims is decided, and raises
            :class:`OverBudget` to end the decision. It can only refuse a demand, never change what
            is decided.

    Raises:
        Refused: with every fault, each with its field in the goal; with the code ``too-large``, if
            the demand takes too much work.
        InvalidInput: if a file of the state repo prevents the rendering of a valid demand.
    """
    config = state.config
    demand = read_goal(goal, config.repo_settings.limits)
    # what was booked must be released, however long that takes
    if demand.is_complete or not demand.adds_claims:
        checkpoint = _NO_LIMIT
    tell = cache(on_stage)  # once for each stage, because there may be several attempts

    def attempt(request: Demand, faults: Sequence[Fault] = ()) -> _Booked:
        counts = demand if isinstance(request, Wait) else None
        if not request.is_complete:
            counts = request = admitted(request, state, faults, checkpoint)
        # in this order, because a demand with faults does not count against the limits
        if counts and (too_soon := tuple(throttle(counts, config))):
            raise _TooSoon(too_soon)
        tell("admitted")
        return _booked(state, request, now, read, checkpoint)

    try:
        try:
            booked = _searched(state, demand, attempt, checkpoint)
        except Refused as refused:
            wait = _wait(state, demand, refused.faults, now, checkpoint)
            if wait is None:
                raise
            booked = attempt(wait)
        request, changes, after = booked.request, booked.changes, booked.after
        rendered = render_change(
            booked.planned,
            config,
            state.evaluate,
            read,
            keeps_late=request.operation not in _OUTCOMES,  # a release waits for no template
            checkpoint=checkpoint,
        )
        checkpoint()
        required_by, approved_by = permission.approval(request, changes.claims, config)
        # a demand may list one thing twice, and several releases may have one reason
        notes = dict.fromkeys(notes_on(request, state, after, changes, rendered))
        for difference in booked.differing:
            notes[difference.warning()] = None
        reasons = (*required_by, *(each.approval_reason() for each in booked.differing))
        placed = dict.fromkeys(text for item in request.demanded for text in item.placed)
    except OverBudget as spent:
        raise _refused(state, demand, [fault("", str(spent), code="too-large")]) from None
    except (_TooSoon, Refused) as refused:
        raise _refused(state, demand, refused.faults) from None
    tell("booked")
    has_changes = bool(changes.claims or changes.waiting)
    outcome: Outcome = "unchanged"
    if has_changes or isinstance(request, Wait):
        outcome = _OUTCOMES.get(request.operation, "released")
    return Decision(
        request=request,
        outcome=outcome,
        state=after,
        changes=changes,
        files=rendered.files if has_changes else {},
        releases=rendered.releases,
        warnings=tuple(filter(None, notes)),
        approval=tuple(filter(None, dict.fromkeys(reasons))),
        approved_by=approved_by,
        overrides=rendered.overrides,
        awaited=booked.makes_room
        # a demand that waits for room for an application runs wherever another demand books it
        or any(
            subject in changes.subjects()
            for waiting in state.ledger.waiting.values()
            if waiting.demand != request.demand
            for subject in waiting.put.subjects()
        ),
        placed=request.moved if isinstance(request, Drain) else (*placed,),
    )


class _TooSoon(Exception):
    """Raised when a demand is throttled; who was throttled gets no try on other nodes."""

    def __init__(self, faults: tuple[Fault, ...]) -> None:
        self.faults = faults


def _refused(state: State, demand: Demand, faults: Iterable[Fault]) -> Refused:
    """Return the refusal with the fields of the demand's goal."""
    config = state.config
    roles = {
        name: {str(wire): role for wire, role in appdef.deployment_request.inputs.items()}
        for name, appdef in config.appdefs.items()
        if appdef.deployment_request
    }
    named = with_definitions(demand, config)
    told = (
        each if each.file else replace(each, field=goal_field(each.field, named, roles))
        for each in faults
    )
    return Refused(dict.fromkeys(told))  # a fault of the requesters is one of each item


# ---- parse, complete, admit, place ----


def _searched(
    state: State,
    demand: Demand,
    attempt: Callable[[Demand, Sequence[Fault]], _Result],
    checkpoint: Checkpoint,
) -> _Result:
    """Return what the attempt returns for the completed demand on the first nodes that do."""
    if demand.is_complete:
        return attempt(demand, ())
    if faults := list(size_faults(demand, state.config.repo_settings.limits)):
        raise Refused(faults)
    checkpoint()
    # all that does not depend on the nodes that are chosen for the demand
    config, ledger = state.config, state.ledger
    if isinstance(demand, Decommission):
        nodes = config.nodes_of(demand.id)
        return attempt(replace(demand, nodes=nodes, is_complete=True), ())
    demand = with_definitions(demand, config)
    # the id of a separate instance comes first, because the placement looks for claims on it
    demand = with_separate_instances(demand, config)
    demand, unclear = with_chosen_domains(demand, config, ledger)
    demand, unread = flows.with_topics_of_outputs(demand, ledger, config)
    return placement.search(
        demand, state, lambda r, faults: attempt(r, (*unclear, *unread, *faults)), checkpoint
    )


def admit(state: State, demand: Demand) -> Demand:
    """Return the completed demand, or raise Refused with all faults against the configuration."""
    return _searched(
        state,
        demand,
        lambda request, faults: admitted(request, state, faults, _NO_LIMIT),
        _NO_LIMIT,
    )


_ITEM = re.compile(r"(applications|connections)\[(\d+)\]")


def admitted(
    request: Demand, state: State, faults: Sequence[Fault], checkpoint: Checkpoint
) -> Demand:
    """Return the completed request; raise Refused with ``faults`` and all that admission finds."""
    if request.is_complete:
        return request
    request, config = completed(request, state, checkpoint), state.config
    # derived connections count as well
    if large := list(size_faults(request, config.repo_settings.limits)):
        raise Refused(large)
    checkpoint()
    found = [*faults, *_paced(admission.faults(request, config), checkpoint)]
    for item in _paced(request.demanded, checkpoint):  # an access domain may have many rules
        found += permission.faults(replace(request, demanded=(item,)), config)
    if found:

        def item_of(each: Fault) -> tuple[str, int]:
            match = _ITEM.match(each.field)
            return (match[1], int(match[2])) if match else ("", 0)

        # the faults of one application or connection are reported together
        raise Refused(sorted(dict.fromkeys(found), key=item_of))
    return request


def _paced(items: Iterable[_Each], checkpoint: Checkpoint) -> Iterator[_Each]:
    for item in items:
        checkpoint()
        yield item


def _wait(
    state: State, demand: Demand, faults: Sequence[Fault], now: datetime, checkpoint: Checkpoint
) -> Wait | None:
    """Return the wait of a refused demand if it lacks only room and may wait."""
    # the reference's action names no demand that could wait
    if demand.operation != "put" or any(each.code != NO_ROOM for each in faults):
        return None
    # a demand that holds claims keeps them when it is refused, so it cannot wait as well
    if state.ledger.claims_with("demand", demand.demand):
        return None
    if strangers := list(permission.owner_faults(demand, state.ledger, state.config)):
        raise Refused(strangers)
    asked = with_separate_instances(demand, state.config)
    if not placement.may_wait(asked, state, checkpoint):
        return None
    before = state.ledger.waiting.get(demand.demand)
    # a demand that is sent again keeps its place among those that wait
    waiting = WaitingDemand(demand, before.since if before else now)
    reasons, who = tuple(each.message for each in faults), waiting.requesters
    return Wait("wait", demand.id, (), demand.demand, who, waiting=waiting, notes=reasons)


# ---- book and plan ----


@dataclass(frozen=True, slots=True)
class _Booked:
    """A request that is booked and planned, and refused by nothing; it is not rendered yet."""

    request: Demand
    after: State
    changes: Changes
    planned: PlannedChange
    differing: Sequence[Difference]
    makes_room: bool


def _booked(  # noqa: PLR0915 - one story, from the claims to what the releases request
    state: State, request: Demand, now: datetime, read: FileReader, checkpoint: Checkpoint
) -> _Booked:
    if isinstance(request, Drain):
        request = relocation.with_moves(
            request, state, state.usage, state.names, placement.MOST_ATTEMPTS
        )
    if isinstance(request, Restoration):
        # claims of before the upgrade may carry a route twice
        then, _ = carriers.with_one_carrier(ledger_of(request.claims))
        then = replace(then, ended=state.ledger.ended)
        moved = relocation.following_overrides(replace(state, ledger=then))
        request = replace(request, claims=tuple(moved.ledger))
        if faults := list(restoration_faults(request, state)):
            raise Refused(faults)
    checkpoint()
    if strangers := list(permission.owner_faults(request, state.ledger, state.config)):
        raise Refused(strangers)
    subjects = request.subjects()
    # Claims of the request replace those that overrides kept. Else a kept claim, which nobody
    # demands any longer, would contradict the request.
    ledger = state.ledger
    for subject in subjects:
        ledger = ledger.without(ledger.kept_claims(subject))
    ledger, changes = apply(ledger, request, now)
    if not isinstance(request, Restoration):
        ledger, idle = flows.without_idle_holds(ledger, changes.claims)
        ends = [*idle, *(change.key for change in changes.claims)]
        ended = claim_changes(state.ledger, ledger, ends)
        ledger, routes = carriers.without_idle_routes(ledger, state.config, ended)
        changes = replace(changes, claims=claim_changes(state.ledger, ledger, [*routes, *ends]))
    after = replace(state, ledger=ledger)
    checkpoint()
    refusals = list(forbidden.denial_faults(request, after, changes))
    checkpoint()
    refusals = refusals or list(forbidden.quota_faults(state, after, changes))
    if refusals:
        raise Refused(refusals)
    # overrides may keep what the request releases
    changed = [change.key for change in changes.claims]
    touched = dict.fromkeys((*changes.subjects(), *subjects))
    ledger, kept_keys = update_kept_claims(state.ledger, after, touched, now)
    changes = replace(changes, claims=claim_changes(state.ledger, ledger, [*changed, *kept_keys]))
    checkpoint()
    after = replace(state, ledger=ledger)
    # a service whose node is to be chosen later has no release yet
    affected = affected_keys(state, after, changes.claims)
    keys = [key for key in affected if isinstance(key, ClientKey) or key.node]
    names = collisions.followed(state.names, state, after, keys)
    clashes = [
        *collisions.topic_faults(request, state, after, _paced(keys, checkpoint), names),
        *collisions.name_faults(
            request, state, after, _paced(keys, checkpoint), changes, state.names
        ),
    ]
    claims = filter(None, (change.after for change in changes.claims))
    for claim in claims if isinstance(request, Restoration) else ():
        clashes += collisions.faults_of_claim(claim, state, after, names)
    clashes = clashes or list(collisions.faults_in_files(request, changes, read))
    if clashes:
        raise Refused(clashes)
    planned = plan_change(state, after, changes, keys, read, state.plans, checkpoint)
    differing = [*forbidden.differences(request, state, after, changes.claims, planned.plans)]
    if refused := [difference.fault for difference in differing if difference.is_refused]:
        raise Refused(refused)
    grown = forbidden.growth(planned.former, planned.plans, state.config)
    refusal = forbidden.NoRoom(state.usage, grown, state.config)
    # a drain was tried on its nodes already, and what releases claims makes room
    if refusal.full and (request.adds_claims or isinstance(request, Restoration)):
        raise refusal
    after = state.followed_by(ledger, planned, state.usage.plus(grown), names)
    makes_room = any(amount < 0 for amount in grown.values())
    return _Booked(request, after, changes, planned, differing, makes_room)


# ---- notes for the requester, in addition to the outcome ----


def notes_on(
    request: Demand, before: World, after: State, changes: Changes, rendered: Changeset
) -> Iterator[str]:
    for app in request.applications:
        if app.separate:
            id, _, version = app.id.rpartition("@")
            yield f"application '{id}' in version {version} runs separately, as '{app.id}'"
    # a connection that an override denies carries nothing
    ledger = without_suspended(after).ledger
    for app in request.applications if request.adds_claims else ():
        for flow in flows.flows_without_carrier(after.config, app, ledger):
            yield (
                f"application '{app.id}': no connection carries {flow.key.topic} ({flow.name}) of "
                f"'{flow.key.sender}' to '{flow.key.receiver}'"
            )
    yield from request.notes
    for change in changes.claims:
        if change.after and not change.after.is_on_application:
            former = change.before.connection.topics if change.before else ()
            for index, words in carriers.brought_twice(change.after.connection, ledger):
                if change.after.connection.topics[index] not in former:
                    yield f"{words}; a subscriber gets the messages of both"
    yield from warnings.notes(request, before)
    for item in request.demanded if request.adds_claims else ():
        demand = request.demand or demand_id(request.id, item.requesters)
        yield from warnings.unheld_outputs(item.held, demand, after)
    yield from warnings.lost_output_notes(changes, after)
    yield from rendered.blocked
    if isinstance(request, Drain):
        yield from request.stays
    yield from forbidden.warnings(request, after)


# ---- may a requester demand it? the rule, quota, override or approval that decides ----


@dataclass(frozen=True, slots=True)
class Answer:
    node: str
    faults: tuple[Fault, ...]  # why not
    rules: tuple[str, ...]  # what allows it
    approval: tuple[str, ...]  # what requires that a person approves it
    approved_by: tuple[str, ...] = ()  # the rules without which a person would have to


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
            is_node = known is config.nodes
            why = config.why_no_node(word) if is_node else f"is not known{suggestion(word, known)}"
            raise Refused.at(field, f"{quoted(word)} {why}")
    answer = Answer(node, (fault("node", "no node is in an access domain"),), (), ())
    for name in [node] if node else config.usable_nodes():
        held = Application(f"may/{requester}", appdef, name, version=version)
        demanded = (Item(held, (requester,)),)
        demand = Demand("put", "may", demanded, f"may/{requester}", (requester,))
        faults = list(permission.faults(demand, config))
        if name not in config.domain_of:
            faults.append(fault("node", f"'{name}' is in no access domain; see policy/"))
        ledger, changes = apply(state.ledger, demand, now)
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
        approval = permission.approval(demand, changes.claims, config)
        answer = Answer(name, tuple(dict.fromkeys(faults)), tuple(rules), *approval)
        if not faults:
            break
    return answer
