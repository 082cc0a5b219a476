"""The decision on one demand: from the goal to the files of a commit.

:func:`decide` is one pure function with these stages: parse, admit, book, plan, render. It reads
the state repo only through ``read`` and writes nothing. So the real run, a dry run, and a replay
after the remote got newer commits all call the same function.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import chain
from typing import Literal, TypeVar

from demandops.base.errors import Fault, OverBudget, Refused, fault
from demandops.base.naming import Subject
from demandops.decide import carriers, changeset, rollback, warnings
from demandops.decide.admission import admission, permission
from demandops.decide.admission.completing import (
    completed,
    notes_on_instances,
    placed,
    with_definitions,
    with_separate_instances,
)
from demandops.decide.booking import Drain, apply
from demandops.decide.changeset import Changeset, FileReader, ReleaseChange
from demandops.decide.checks import collisions, quotas, version_difference
from demandops.decide.placement import capacity, placement, relocation
from demandops.decide.placement.candidates import NO_ROOM
from demandops.decide.planning.flows import flows_without_carrier
from demandops.decide.planning.overrides import update_kept_claims, without_suspended
from demandops.decide.planning.release_keys import ReleaseKey, affected_keys, keys_of_claims
from demandops.decide.rollback import Restoration
from demandops.decide.state import State
from demandops.model.config.config import Config
from demandops.model.demand.demand import Application, Decommission, Demand
from demandops.model.demand.goals import goal_field, read_goal
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger import ledger as ledgers
from demandops.model.ledger.ledger import Changes, ClaimChange, Ledger, World
from demandops.model.ledger.records import Wait, WaitingDemand

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
    ``approval`` has the reasons why a person must approve the demand before it is booked.
    """

    request: Demand
    outcome: Outcome
    state: State
    changes: Changes
    files: Mapping[str, str | None]
    releases: tuple[ReleaseChange, ...]
    warnings: tuple[str, ...]
    approval: tuple[str, ...] = ()
    # the paths of the overrides that change the content of the rendered files
    overrides: tuple[str, ...] = ()
    # whether waiting demands are tried again: services now request less of a node, or one of the
    # demands shares an application that was booked
    awaited: bool = False

    @property
    def placed(self) -> tuple[str, ...]:
        """A sentence for each placed application or service: the chosen node and the reason."""
        if isinstance(self.request, Drain):
            return self.request.moved
        return _once(*(text for item in self.request.demanded for text in item.placed))

    @property
    def lease_s(self) -> int | None:
        """The shortest lease of the demand in seconds: the client must renew as often."""
        waiting = self.state.ledger.waiting.get(self.request.demand)
        if waiting is not None:
            # which domain it will get is open, so any in which it may wait counts
            put, config = waiting.put, self.state.config
            domains = (domain for domain in config.domains.values() if domain.when_full == "wait")
            terms = (permission.term(put, domain) for domain in domains)
            return min((term.seconds for term in terms if term), default=None)
        claims = (
            self.state.ledger.claims_of_demand(self.request.demand) if self.request.demand else ()
        )
        claims = claims or tuple(change.after for change in self.changes.claims if change.after)
        return min((claim.lease.seconds for claim in claims if claim.lease), default=None)


# Yields faults if a demand comes too soon after others of its requesters.
Throttle = Callable[[Demand, Config], Iterable[Fault]]
# Is called often during a decision, and raises OverBudget to end it.
Checkpoint = Callable[[], None]


def decide(
    state: State,
    goal: object,
    now: datetime,
    read: FileReader,
    on_stage: Callable[[Stage], None] = lambda stage: None,
    throttle: Throttle = lambda demand, config: (),
    checkpoint: Checkpoint = lambda: None,
) -> Decision:
    """Return the decision on a demand, or on its goal as plain data.

    A demand that is complete is not checked against the configuration and its policy again.

    Args:
        now: when the demand was received, with time zone.
        on_stage: called when the demand is admitted and when it is booked, each at most once.
            Later checks may still refuse an admitted demand.
        throttle: called if all other checks of admission find no fault, perhaps twice for one
            demand. It is not called for a :class:`Decommission` and for the generator's own.
        checkpoint: called often while a demand that may add claims is decided, and raises
            :class:`OverBudget` to end the decision. It can only refuse a demand, never change what
            is decided.

    Raises:
        Refused: with every fault, each with its field in the goal; with the code ``too-large``, if
            the demand takes too much work.
        InvalidInput: if a file of the state repo prevents the rendering of a valid demand.
    """
    demand = read_goal(goal, state.config.repo_settings.limits)
    if demand.is_complete:
        try:
            return _carried_out(state, demand, now, read, on_stage)
        except Refused as refused:
            raise _refused(state, demand, refused.faults) from None
    if not demand.adds_claims:  # what was booked must be released, however long that takes
        checkpoint = _no_limit
    throttled, told = list[Fault](), set[Stage]()

    # who was throttled must not get another try on other nodes
    def noted(demand: Demand, config: Config) -> list[Fault]:
        throttled[:] = throttle(demand, config)
        return throttled

    def once(stage: Stage) -> None:
        if stage not in told:
            told.add(stage)
            on_stage(stage)

    try:
        request = _admitted_or_waiting(state, demand, now, noted, checkpoint)
        return _carried_out(state, request, now, read, once, checkpoint)
    except OverBudget as spent:
        raise _refused(state, demand, [_too_large(spent)]) from None
    except Refused as refused:
        faults = refused.faults
        try:
            checkpoint()
            # Look for nodes on which the demand is not refused. To try many nodes takes time, but
            # only a demand that is refused on the nodes chosen first takes this time.
            if (
                not throttled
                and all(each.code in _BY_NODE for each in faults)
                and placement.needs_placement(
                    defined := with_definitions(demand, state.config), state
                )
                and defined.adds_claims
            ):
                checkpoint()
                with suppress(Refused):
                    trials = _Trials(state, now, checkpoint)
                    request = admit(state, demand, throttle, trials.succeeds, checkpoint)
                    return _carried_out(state, request, now, read, once, checkpoint)
        except OverBudget as spent:
            # keep the faults of the first refusal: they tell the requester what to change
            faults = (_too_large(spent), *faults)
        raise _refused(state, demand, faults) from None


def _no_limit() -> None:
    pass


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


def _admitted_or_waiting(
    state: State, demand: Demand, now: datetime, throttle: Throttle, checkpoint: Checkpoint
) -> Demand:
    """Return the completed demand, or its wait if it lacks only room and may wait."""
    try:
        return admit(state, demand, throttle, None, checkpoint)
    except Refused as refused:
        # the reference's action names no demand that could wait
        if demand.operation != "put" or any(each.code != NO_ROOM for each in refused.faults):
            raise
        # a demand that holds claims keeps them when it is refused, so it cannot wait as well
        if state.ledger.claims_of_demand(demand.demand):
            raise
        if strangers := list(permission.owner_faults(demand, state.ledger, state.config)):
            raise Refused(strangers) from None
        asked = with_separate_instances(demand, state.config)
        if not placement.may_wait(asked, state, checkpoint):
            raise
        if faults := list(throttle(asked, state.config)):
            raise Refused(faults) from None
        # a demand that is sent again keeps its place among those that wait
        before = state.ledger.waiting.get(demand.demand)
        waiting = WaitingDemand(demand, before.since if before else now)
        reasons = tuple(each.message for each in refused.faults)
        who = waiting.requesters
        return Wait("wait", demand.id, (), demand.demand, who, waiting=waiting, reasons=reasons)


_ITEM = re.compile(r"(applications|connections)\[(\d+)\]")


def admit(
    state: State,
    demand: Demand,
    throttle: Throttle = lambda demand, config: (),
    trial: placement.Trial | None = None,
    checkpoint: Checkpoint = _no_limit,
) -> Demand:
    """Return the completed demand, or raise Refused with all faults against the configuration.

    If ``trial`` is given, a node is chosen only if ``trial`` accepts the demand with this node.
    """
    config = state.config
    limits = config.repo_settings.limits
    if faults := list(admission.size_faults(demand, limits)):
        raise Refused(faults)
    checkpoint()
    request, faults = completed(demand, state, trial, checkpoint)
    if isinstance(request, Decommission):
        return request
    # derived connections count as well
    if large := list(admission.size_faults(request, limits)):
        raise Refused(large)
    checkpoint()
    faults += _paced(admission.faults(request, config), checkpoint)
    for item in _paced(request.demanded, checkpoint):  # an access domain may have many rules
        faults += permission.faults(replace(request, demanded=(item,)), config)
    # last, because a demand with faults does not count against the limits of its requesters
    faults = faults or list(throttle(request, config))
    if faults:

        def item_of(each: Fault) -> tuple[str, int]:
            match = _ITEM.match(each.field)
            return (match[1], int(match[2])) if match else ("", 0)

        # the faults of one application or connection are reported together
        raise Refused(sorted(dict.fromkeys(faults), key=item_of))
    return request


_Each = TypeVar("_Each")


def _paced(items: Iterable[_Each], checkpoint: Checkpoint) -> Iterator[_Each]:
    for item in items:
        checkpoint()
        yield item


def _too_large(spent: OverBudget) -> Fault:
    return fault("", str(spent), code="too-large")


def _once(*texts: str) -> tuple[str, ...]:
    return tuple(filter(None, dict.fromkeys(texts)))


# The codes of faults that might not occur if other nodes were chosen for the demand
_BY_NODE = frozenset(
    ("not-allowed", "quota", "denied", "conflict", "unsupported-connection-type", "no-broker")
)


# How many bookings one demand, or one drain of a node, may try while nodes are looked for. Each
# trial books all that is placed so far. So the trials of one demand together may also book no more
# items than the largest demand may list.
MOST_TRIALS = 64


class _Trials:
    def __init__(self, state: State, now: datetime, checkpoint: Checkpoint) -> None:
        self._state, self._now, self._checkpoint = state, now, checkpoint
        self._tried = self._items = 0

    def succeeds(self, request: Demand) -> bool:
        """Return whether a request, which names a node for each application, can be booked."""
        self._tried += 1
        self._items += admission.items_of(request)
        most = self._state.config.repo_settings.limits.demand_items
        if self._tried > MOST_TRIALS or self._items > most:
            raise OverBudget(
                "too many nodes would have to be tried for this demand; name a node for each "
                "application, or split the demand"
            )
        config = self._state.config
        request = placed(request, self._state, self._checkpoint)
        if next(admission.faults(request, config), None):
            return False
        for item in _paced(request.demanded, self._checkpoint):
            if next(permission.faults(replace(request, demanded=(item,)), config), None):
                return False
        try:
            _booked(self._state, request, self._now, self._checkpoint)
        except Refused:
            return False
        return True


def _carried_out(
    state: State,
    request: Demand,
    now: datetime,
    read: FileReader,
    on_stage: Callable[[Stage], None] = lambda stage: None,
    checkpoint: Checkpoint = _no_limit,
) -> Decision:
    """Return the decision on a demand that is admitted: book, plan and render it."""
    config = state.config
    if isinstance(request, Drain):
        request = relocation.with_moves(request, state, state.usage(), state.names(), MOST_TRIALS)
    if isinstance(request, Restoration):
        # claims of before the upgrade may carry a route twice
        united, _ = carriers.with_one_carrier(ledgers.ledger_of(request.claims))
        request = replace(request, claims=tuple(united))
        request = relocation.with_restored_moves(request, state)
        faults = list(rollback.faults(request, state))
        if faults:
            raise Refused(faults)
    on_stage("admitted")
    after, changes, keys = _booked(state, request, now, checkpoint)
    if taken := list(collisions.faults_in_files(request, changes, read)):
        raise Refused(taken)
    rendered = changeset.build_changeset(
        state,
        after,
        changes,
        keys,
        state.evaluate,
        read,
        state.plans,
        keeps_late=request.operation not in _OUTCOMES,  # a release waits for no template
        checkpoint=checkpoint,
    )
    differing = list(
        version_difference.differences(request, state, after, changes.claims, rendered.plans)
    )
    refused = [difference.fault for difference in differing if difference.is_refused]
    grown = capacity.growth(rendered.former, rendered.plans, config)
    # a drain was tried on its nodes already, and what releases claims makes room
    if request.adds_claims or isinstance(request, Restoration):
        refused = refused or list(capacity.faults(state.usage(), grown, config))
    if refused:
        raise Refused(refused)
    checkpoint()
    after = state.followed_by(after.ledger, rendered, state.usage().plus(grown))
    checkpoint()
    on_stage("booked")
    outcome: Outcome = "unchanged"
    if changes.claims or changes.waiting or isinstance(request, Wait):
        outcome = _OUTCOMES.get(request.operation, "released")
    return Decision(
        request=request,
        outcome=outcome,
        state=after,
        changes=changes,
        files=rendered.files if changes.claims or changes.waiting else {},
        releases=rendered.releases,
        # a demand may list one thing twice, and several releases may have one reason
        warnings=_once(
            *notes_on(request, state, after, changes, rendered),
            *(difference.warning() for difference in differing),
        ),
        approval=_once(
            *permission.approval_reasons(
                request, ((c.before, c.after) for c in changes.claims), config
            ),
            *(difference.approval_reason() for difference in differing),
        ),
        overrides=rendered.overrides,
        awaited=any(amount < 0 for amount in grown.values())
        # a demand that waits for room for an application runs wherever another demand books it
        or any(
            subject in changes.subjects()
            for waiting in state.ledger.waiting.values()
            if waiting.demand != request.demand
            for subject in waiting.put.subjects()
        ),
    )


def _booked(
    state: State, request: Demand, now: datetime, checkpoint: Checkpoint
) -> tuple[State, Changes, tuple[ReleaseKey, ...]]:
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
        ledger, idle = carriers.without_idle_routes(ledger, state.config, changes.claims)
        idle += [change.key for change in changes.claims]
        changes = replace(changes, claims=ledgers.claim_changes(state.ledger, ledger, idle))
    after = replace(state, ledger=ledger)
    checkpoint()
    refusals = list(quotas.denial_faults(request, after, changes))
    checkpoint()
    refusals = refusals or list(quotas.quota_faults(state, after, changes))
    if refusals:
        raise Refused(refusals)
    # overrides may keep what the request releases
    changed = [change.key for change in changes.claims]
    touched = dict.fromkeys((*changes.subjects(), *subjects))
    ledger, kept_keys = update_kept_claims(state.ledger, after, touched, now)
    changes = replace(
        changes, claims=ledgers.claim_changes(state.ledger, ledger, [*changed, *kept_keys])
    )
    checkpoint()
    after = replace(state, ledger=ledger)
    keys = affected_keys(state, after, changes.claims)
    clashes = list(collisions.topic_faults(request, state, after, _paced(keys, checkpoint)))
    clashes += collisions.name_faults(
        request, state, after, _paced(keys, checkpoint), changes, state.names()
    )
    for change in changes.claims if isinstance(request, Restoration) else ():
        clashes += collisions.faults_of_claim(change.after, state, after) if change.after else ()
    if clashes:
        raise Refused(clashes)
    return after, changes, keys


# ---- notes for the requester, in addition to the outcome ----


def notes_on(
    request: Demand, before: World, after: World, changes: Changes, rendered: Changeset
) -> Iterator[str]:
    yield from notes_on_instances(request)
    # a connection that an override denies carries nothing
    ledger = without_suspended(after).ledger
    for item in request.demanded if request.adds_claims else ():
        if isinstance(item.held, Application):
            for flow in flows_without_carrier(after.config, item.held, ledger):
                yield (
                    f"application '{item.held.id}': no connection carries {flow.topic} "
                    f"({flow.name}) of '{flow.sender}' to '{flow.receiver}'"
                )
    yield from request.notes
    for change in changes.claims:
        if change.after and not change.after.is_on_application:
            former = change.before.connection.topics if change.before else ()
            for index, words in carriers.brought_twice(change.after.connection, ledger):
                if change.after.connection.topics[index] not in former:
                    yield f"{words}; a subscriber gets the messages of both"
    yield from warnings.notes(request, before)
    yield from warnings.unheld_output_notes(request, after)
    yield from warnings.lost_output_notes(changes, after)
    yield from rendered.blocked
    if isinstance(request, Drain):
        yield from request.stays
    if isinstance(request, Wait):
        yield from request.reasons
    yield from quotas.warnings(request, after)


# ---- claims that a person edits in the ledger ----


def changeset_of_edit(
    state: State, before: Ledger, subjects: Iterable[Subject], read: FileReader
) -> changeset.Changeset:
    old = replace(state, ledger=before)
    keys = affected_keys(old, state, ledgers.changes_on(before, state.ledger, subjects))
    # a template that takes too long is no fault of the claim, so its release keeps its file
    return changeset.build_changeset(
        old, state, Changes(), keys, state.evaluate, read, keeps_late=True
    )


def faults_of_edit(before: World, after: State, changes: Iterable[ClaimChange]) -> Iterator[Fault]:
    """Yield the faults of claims that a person wrote, each located in the claim's file."""
    for change in changes:
        claim = change.after
        if claim is None:
            continue
        # an edit that only takes requesters away has the effect of a release, which is allowed
        if (
            (old := change.before)
            and replace(claim, requesters=old.requesters) == old
            and {*claim.requesters} <= {*old.requesters}
        ):
            continue
        wanted, config = rollback.request_for(claim), after.config
        malformed = list(admission.faults(wanted, config))
        allowed = chain(
            permission.faults(wanted, config),
            quotas.quota_faults(before, after, Changes((change,))),
        )
        for each in malformed or allowed:
            yield each.within(claim_files.path_of(claim.key))
        yield from collisions.faults_of_claim(claim, before, after)
        keys, changed = keys_of_claims(after, [claim]), Changes((change,))
        faults = list(collisions.name_faults(wanted, before, after, keys, changed, after.names()))
        without = replace(after, ledger=after.ledger.replace(change.key, change.before))
        with suppress(Refused):  # other checks report a claim that cannot be planned
            grown = capacity.growth_by(without, after, [change])
            # only growth is a fault: the nodes may be full because of other claims
            usage = after.usage().plus({need: -amount for need, amount in grown.items()})
            faults += capacity.faults(usage, grown, config)
        for each in faults:
            yield each.within(claim_files.path_of(claim.key))
