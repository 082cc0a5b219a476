"""One demand, decided: from the goal as it came to the files that a commit will hold.

The stages before this one composed into a pure function: parse, admit, book, plan, render. It
reads the state repo only through the ``read`` it is given and writes nothing, so a dry run, a
replay on a moved remote and the real thing are the same call.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from types import MappingProxyType
from typing import Literal

from demandops.config.config import Config
from demandops.demand import (
    admission,
    approval_rule,
    decommission_goal,
    demand_goal,
    deployment_request_goal,
    permission,
    transport_choice,
)
from demandops.demand.claim import Subject
from demandops.demand.demand_request import DemandRequest, Operation
from demandops.errors import Fault, InvalidInput, Refused
from demandops.ledger import apply as booking
from demandops.ledger import restoration
from demandops.ledger.apply import Changes, Ledger
from demandops.ledger.restoration import Restoration
from demandops.plan import implied_connections
from demandops.plan.checks import denial, quota
from demandops.plan.connection_clients import is_bridged
from demandops.plan.overrides import kept_claims
from demandops.plan.overrides.claims_in_force import in_force
from demandops.plan.release_keys import affected, all_keys
from demandops.render import trial_render
from demandops.render.changes import changeset
from demandops.render.changes.changeset import Read, ReleaseChange
from demandops.render.engine import Engine

_SUBJECT = re.compile(r"(apps|applications|connections)\[(\d+)\]")

Stage = Literal["admitted", "booked"]
Outcome = Literal["booked", "released", "restored", "unchanged"]

_OUTCOMES: dict[Operation, Outcome] = {
    Operation.SHUTDOWN: "released",
    Operation.RELEASE: "released",
    Operation.EXPIRE: "released",
    Operation.ROLLBACK: "restored",
    Operation.DECOMMISSION: "released",
}

Throttle = Callable[[DemandRequest, Config], Iterable[Fault]]
"""Yields why a request comes too soon after others of its requesters."""


@dataclass(frozen=True, slots=True)
class State:
    """What a demand is judged against: the configuration and the books at one commit."""

    config: Config
    engine: Engine
    ledger: Ledger

    @classmethod
    def of(cls, config: Config, ledger: Ledger) -> State:
        """Return a state with a fresh engine for ``config``."""
        return cls(config, Engine(config.files), ledger)


@dataclass(frozen=True, slots=True)
class Decision:
    """What a demand does. ``files`` is empty where it changes nothing.

    ``approval`` names what asks for a person's approval first: access domains, rules, appdefs.
    """

    request: DemandRequest
    outcome: Outcome
    state: State
    changes: Changes
    files: Mapping[str, str | None]
    releases: tuple[ReleaseChange, ...]
    warnings: tuple[str, ...]
    approval: tuple[str, ...] = ()
    overrides: tuple[str, ...] = ()
    """The files of the overrides that shaped what is written."""

    @property
    def lease_s(self) -> int | None:
        """For how many seconds the demand holds unless it is renewed; nothing: without end."""
        claims = self.state.ledger.of_demand(self.request.demand) if self.request.demand else ()
        claims = claims or tuple(change.after for change in self.changes.claims if change.after)
        return min((claim.lease.seconds for claim in claims if claim.lease), default=None)


def decide(
    state: State,
    goal: object,
    now: datetime,
    read: Read,
    on_stage: Callable[[Stage], None] = lambda stage: None,
    throttle: Throttle = lambda request, config: (),
) -> Decision:
    """Decide a goal of the reference's action or of our own.

    Args:
        state: configuration and books to judge against.
        goal: the goal as plain data (:mod:`demandops.demand.deployment_request_goal`,
            :mod:`demandops.demand.demand_goal`),
            or a request of the generator's own, which is not checked again.
        now: when the demand was received, with time zone.
        read: gives the text of a file of the state repo as it is, or nothing.
        on_stage: told when the demand is admitted and when it is booked.
        throttle: asked last before a request is admitted.

    Raises:
        Refused: with every fault, named by the wire's fields; nothing is to be written then.
        InvalidInput: where the state repo's own files keep a valid demand from being rendered.
    """
    request = goal if isinstance(goal, DemandRequest) else admit(state, goal, throttle)
    if isinstance(request, Restoration):
        impossible = list(restoration.faults(request, state.ledger, state.config))
        if impossible:
            raise Refused(impossible)
    on_stage("admitted")
    try:
        ledger, changes = _booked(state, request, now)
        keys = affected(state.ledger, ledger, state.config, changes.subjects())
        made = changeset.of_change(
            state.ledger, ledger, changes.claims, keys, (state.config, state.engine, read)
        )
    except Refused as error:
        raise Refused(_in_goals_words(error.faults, request, state.config)) from None
    on_stage("booked")
    outcome: Outcome = "unchanged"
    if changes.claims:
        outcome = _OUTCOMES.get(request.operation, "booked")
    return Decision(
        request=request,
        outcome=outcome,
        state=replace(state, ledger=ledger),
        changes=changes,
        files=made.files if changes.claims else {},
        releases=made.releases,
        warnings=(
            *_uncarried(request, ledger, state.config),
            *_bridged(request, state.config),
            *made.waiting,
            *denial.warnings(request, ledger, state.config),
        ),
        approval=approval_rule.approval_reasons(
            request, ((c.before, c.after) for c in changes.claims), state.config
        ),
        overrides=made.overrides,
    )


def _booked(state: State, request: DemandRequest, now: datetime) -> tuple[Ledger, Changes]:
    """Book a request; what overrides keep gives way to it, and what it gives up they may keep.

    Raises:
        Refused: where the books, an override or a quota do not allow it.
    """
    asked, config = kept_claims.requested(request), state.config
    ledger, changes = booking.apply(kept_claims.giving_way(state.ledger, asked), request, now)
    refusals = list(denial.faults(request, ledger, changes, config))
    refusals = refusals or list(quota.faults(state.ledger, ledger, changes, config))
    if refusals:
        raise Refused(refusals)
    return kept_claims.settled(state.ledger, ledger, changes, asked, (config, now))


def admit(
    state: State, goal: object, throttle: Throttle = lambda request, config: ()
) -> DemandRequest:
    """Parse a goal and check it against the configuration, its access domains and the throttle.

    Raises:
        Refused: with every fault of form and content together.
    """
    config = state.config
    if isinstance(goal, dict) and decommission_goal.is_decommission(goal):
        return decommission_goal.parse(goal)
    if isinstance(goal, dict) and demand_goal.is_demand_goal(goal):
        request, faults = demand_goal.parse(goal)
        request = permission.with_lease_terms(request, config)
        request = implied_connections.with_connections(request, state.ledger, config)
    else:
        parsed, faults = deployment_request_goal.parse(goal, config.appdef_by_wire_type)
        if parsed is None:
            raise Refused(faults)
        request = permission.with_lease_terms(parsed, config)
    request = transport_choice.with_chosen_types(request, config, state.ledger.type_of)
    told = {found.field for found in faults}
    found_in_content = [*admission.faults(request, config), *permission.faults(request, config)]
    content = _in_goals_words(found_in_content, request, config)
    # what could not be read is not said to be missing
    unread = bool(told & {"apps", "applications", "connections"})
    faults += [
        found
        for found in content
        if not _told(found.field, told) and not (unread and found.code == "empty")
    ]
    faults = faults or list(throttle(request, config))
    if faults:
        raise Refused(sorted(dict.fromkeys(faults), key=lambda found: _subject(found.field)))
    return request


def form_faults(goal: object) -> list[Fault]:
    """Return what of a goal has not the form of one: unknown fields, wrong types."""
    if isinstance(goal, dict) and demand_goal.is_demand_goal(goal):
        return demand_goal.form_faults(goal)
    return deployment_request_goal.form_faults(goal)


def consequence(
    state: State, before: Ledger, subjects: Iterable[Subject], read: Read
) -> changeset.Changeset:
    """Return what a change of the books that a person made asks of the rendered files."""
    keys = affected(before, state.ledger, state.config, subjects)
    return changeset.of_change(before, state.ledger, (), keys, (state.config, state.engine, read))


def rendered(state: State, standing: Mapping[str, str] = MappingProxyType({})) -> dict[str, str]:
    """Return every generated file that the state asks for.

    Args:
        standing: the generated files as they are, of which overrides may hold some.
    """
    keys = all_keys(state.ledger, state.config)
    return changeset.render_all(state.ledger, state.config, state.engine, keys, standing)


def _told(field: str, told: Iterable[str]) -> bool:
    """Tell whether a field, or one around or inside it, was faulted for its form already."""
    return any(
        field == known
        or field.startswith((f"{known}.", f"{known}["))
        or known.startswith((f"{field}.", f"{field}["))
        for known in told
    )


def _subject(field: str) -> tuple[str, int]:
    """Return what a fault is about, so that faults of one subject are told together."""
    match = _SUBJECT.match(field)
    return (match[1], int(match[2])) if match else ("", 0)


def _in_goals_words(faults: Iterable[Fault], request: DemandRequest, config: Config) -> list[Fault]:
    """Return faults named by the fields of the goal that the request came as."""

    def field(path: str) -> str:
        if request.operation is Operation.DECOMMISSION:
            return path
        if request.operation.is_reference:
            return deployment_request_goal.goal_field(path, request, config.appdefs)
        return demand_goal.goal_field(path, request)

    return [replace(found, field=field(found.field)) for found in faults]


def _uncarried(request: DemandRequest, ledger: Ledger, config: Config) -> Iterator[str]:
    """Yield a warning for each input that no connection brings to the application's node."""
    if not request.operation.adds_claims:
        return
    ledger = in_force(ledger, config)
    for app in request.applications:
        for foreign in implied_connections.foreign_inputs(app, config):
            topic = foreign.topic
            if not ledger.carries(app.node, topic.topic):
                yield (
                    f"application '{app.id}': no connection carries {foreign.name} {topic.topic} "
                    f"of '{topic.source}' to '{app.node}'"
                )


def _bridged(request: DemandRequest, config: Config) -> Iterator[str]:
    """Yield a warning for each topic that the initial deployment carries already."""
    if not request.operation.adds_claims:
        return
    for connection in request.connections:
        for route in connection.topics:
            if is_bridged(route, connection.source, connection.target, config):
                yield (
                    f"connection '{connection.id}': {route.read_topic} is bridged between "
                    f"'{connection.source}' and '{connection.target}' already, so no client "
                    "carries it"
                )


def explain(error: InvalidInput) -> str:
    """Return a refusal as ``<code>: <field>: <remedy>``, one line for each fault."""
    return "\n".join(f"{found.code}: {found}" for found in error.faults)


def rehearse(state: State) -> None:
    """Try every appdef and every override in force on invented demands.

    Raises:
        Refused, InvalidInput: naming the template, the values or the override that does not work.
    """
    trial_render.rehearse(state.config, state.engine)
