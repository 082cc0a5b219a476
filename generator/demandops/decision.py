"""The decision on one demand: from the goal to the files of a commit.

It composes the stages before it into a pure function: parse, admit, book, plan, render. It reads
the state repo only through ``read`` and writes nothing. So a dry run, a replay on a moved remote
and the real run are the same call.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from itertools import chain
from types import MappingProxyType
from typing import Literal

from rpds import HashTrieMap

from demandops.config.config import Config
from demandops.demand import admission, demand_goal, deployment_request_goal, permission
from demandops.demand.application import Application
from demandops.demand.demand_request import Decommission, DemandRequest
from demandops.errors import Fault, InvalidInput, Refused
from demandops.ledger import claim_file
from demandops.ledger.apply import apply
from demandops.ledger.ledger import Changes, ClaimChange, Ledger, changes_on
from demandops.ledger.operations import restoration
from demandops.ledger.operations.restoration import Restoration
from demandops.ledger.world import World
from demandops.plan import implied_connections, output_topics, placement
from demandops.plan.checks import denial, quota, topic_clash, version_difference
from demandops.plan.flows import flows
from demandops.plan.overrides.claim_overrides import (
    with_kept_claims,
    without_kept_claims,
    without_suspended,
)
from demandops.plan.planner import is_bridged
from demandops.plan.release import Release
from demandops.plan.release_keys import ReleaseKey, affected_keys, all_keys
from demandops.render import trial_render
from demandops.render.changes import changeset
from demandops.render.changes.changeset import FileReader, ReleaseChange
from demandops.render.engine import Engine
from demandops.subject import Subject

_SUBJECT = re.compile(r"(apps|applications|connections)\[(\d+)\]")

Stage = Literal["admitted", "booked"]
Outcome = Literal["booked", "released", "restored", "unchanged"]

_OUTCOMES: dict[str, Outcome] = {
    "join": "booked",
    "put": "booked",
    "renew": "booked",
    "rollback": "restored",
}
"""The outcomes of operations; that of any other is ``released``."""

Throttle = Callable[[DemandRequest, Config], Iterable[Fault]]
"""Yields a fault if a request comes too soon after others of its requesters."""


@dataclass(frozen=True, slots=True)
class State(World):
    """The world at one commit, with the engine of its configuration.

    ``plans`` are the releases that earlier decisions on this configuration planned. A replaced
    state has none: only :func:`decide` knows which of them are still right.
    """

    engine: Engine
    plans: HashTrieMap[ReleaseKey, Release] = field(
        default_factory=HashTrieMap, init=False, compare=False, repr=False
    )

    @classmethod
    def of(cls, config: Config, ledger: Ledger) -> State:
        """Return a state with a fresh engine for ``config``."""
        return cls(config, ledger, Engine(config.files))

    def followed_by(self, ledger: Ledger, plans: Mapping[ReleaseKey, Release | None]) -> State:
        """Return the state after a decision; ``plans`` has every release that it affects."""
        known = self.plans
        for key, release in plans.items():
            known = known.insert(key, release) if release else known.discard(key)
        state = replace(self, ledger=ledger)
        object.__setattr__(state, "plans", known)
        return state


@dataclass(frozen=True, slots=True)
class Decision:
    """The effect of a demand. ``files`` is empty if it changes nothing.

    ``approval`` names the access domains, rules and appdefs that require a person's approval first.
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
    """The files of the overrides that shaped the rendered files."""

    @property
    def placed(self) -> tuple[str, ...]:
        """Where the generator placed applications whose node the demand does not name, and why."""
        listed = self.request.demanded
        return tuple(f"application '{one.held.id}' {one.placed}" for one in listed if one.placed)

    @property
    def lease_s(self) -> int | None:
        """The shortest lease of the demand, in seconds; ``None`` if it has no lease."""
        claims = (
            self.state.ledger.claims_of_demand(self.request.demand) if self.request.demand else ()
        )
        claims = claims or tuple(change.after for change in self.changes.claims if change.after)
        return min((claim.lease.seconds for claim in claims if claim.lease), default=None)


def decide(
    state: State,
    goal: object,
    now: datetime,
    read: FileReader,
    on_stage: Callable[[Stage], None] = lambda stage: None,
    throttle: Throttle = lambda request, config: (),
) -> Decision:
    """Decide on a goal of the reference's action or of our own.

    Args:
        state: the configuration and ledger to decide on.
        goal: the goal as plain data (:mod:`demandops.demand.deployment_request_goal`,
            :mod:`demandops.demand.demand_goal`), or a request that the generator makes itself,
            which is not checked again.
        now: when the demand was received, with time zone.
        read: returns the current text of a file in the state repo, or ``None``.
        on_stage: called when the demand is admitted and when it is booked.
        throttle: checked last before a request is admitted.

    Raises:
        Refused: with every fault, by the goal's fields. Nothing may be written then.
        InvalidInput: if a file of the state repo prevents the rendering of a valid demand.
    """
    request = goal if isinstance(goal, DemandRequest) else admit(state, goal, throttle)
    if isinstance(request, Restoration):
        faults = list(restoration.faults(request, state))
        if faults:
            raise Refused(faults)
    on_stage("admitted")
    ledger, changes = _book(state, request, now)
    after = replace(state, ledger=ledger)
    keys = affected_keys(state, after, changes.claims)
    clashes = list(topic_clash.faults(request, state, after, keys))
    for change in changes.claims if isinstance(request, Restoration) else ():
        clashes += topic_clash.faults_of_claim(change.after, state, after) if change.after else ()
    if clashes:
        raise Refused(clashes)
    rendered = changeset.build_changeset(
        state, after, changes, keys, state.engine, read, state.plans
    )
    differing = list(
        version_difference.differences(request, state, after, changes.claims, rendered.plans)
    )
    refused = [found.fault for found in differing if found.policy == "refuse"]
    if refused:
        raise Refused(refused)
    after = state.followed_by(ledger, rendered.plans)
    on_stage("booked")
    outcome: Outcome = "unchanged"
    if changes.claims:
        outcome = _OUTCOMES.get(request.operation, "released")
    return Decision(
        request=request,
        outcome=outcome,
        state=after,
        changes=changes,
        files=rendered.files if changes.claims else {},
        releases=rendered.releases,
        warnings=(
            *_connection_warnings(request, after),
            *rendered.blocked,
            *_repeat(changes),
            *denial.warnings(request, after),
            *filter(None, (found.warning() for found in differing)),
        ),
        approval=(
            *permission.approval_reasons(
                request, ((c.before, c.after) for c in changes.claims), state.config
            ),
            *filter(None, (found.approval_reason() for found in differing)),
        ),
        overrides=rendered.overrides,
    )


def _book(state: State, request: DemandRequest, now: datetime) -> tuple[Ledger, Changes]:
    """Book a request. Its claims replace kept ones; overrides may keep claims that it releases.

    Raises:
        Refused: if existing claims, an override or a quota forbid it.
    """
    subjects = request.subjects()
    ledger, changes = apply(without_kept_claims(state.ledger, subjects), request, now)
    if isinstance(request, Decommission):
        ledger, changes = implied_connections.without_idle_deliveries(
            state.ledger, replace(state, ledger=ledger), changes
        )
    after = replace(state, ledger=ledger)
    refusals = list(denial.faults(request, after, changes))
    refusals = refusals or list(quota.faults(state, after, changes))
    if refusals:
        raise Refused(refusals)
    return with_kept_claims(state.ledger, after, changes, subjects, now)


def admit(
    state: State, goal: object, throttle: Throttle = lambda request, config: ()
) -> DemandRequest:
    """Parse a goal and check it against the configuration, its access domains and the throttle.

    Raises:
        Refused: with every fault, of form and of content.
    """
    config, ledger = state.config, state.ledger
    not_placed: list[Fault] = []
    if isinstance(goal, dict) and Decommission.is_goal(goal):
        return Decommission.parse(goal)
    if isinstance(goal, dict) and demand_goal.is_demand_goal(goal):
        parsed, faults = demand_goal.parse(goal)
        _refuse_large(parsed, config)
        request, not_placed = placement.with_chosen_nodes(parsed, ledger, config)
        request = permission.with_lease_terms(request, config)
        request = output_topics.with_further_topics(request, ledger, config)
        request = implied_connections.with_implied_connections(request, ledger, config)
    else:
        wired, faults = deployment_request_goal.parse(goal, config.appdef_by_wire_type)
        if wired is None:
            raise Refused(faults)
        _refuse_large(wired, config)
        request = permission.with_lease_terms(wired, config)
        request = output_topics.with_further_topics(request, ledger, config)
    request = admission.with_chosen_types(request, config, ledger.connection)
    malformed = {found.field for found in faults}
    around_malformed = {parent for field in malformed for parent in _with_parents(field)}
    content = [*not_placed, *admission.faults(request, config), *permission.faults(request, config)]
    # do not report as missing what could not be read
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


def _refuse_large(request: DemandRequest, config: Config) -> None:
    """Refuse a request that is too large, before other checks read all that it lists."""
    faults = list(admission.size_faults(request, config.repo_settings.limits))
    if faults:
        raise Refused(faults)


def form_faults(goal: object) -> list[Fault]:
    """Return the faults in a goal's form: unknown fields, wrong types."""
    if isinstance(goal, dict) and demand_goal.is_demand_goal(goal):
        return demand_goal.form_faults(goal)
    return deployment_request_goal.form_faults(goal)


def changeset_of_edit(
    state: State, before: Ledger, subjects: Iterable[Subject], read: FileReader
) -> changeset.Changeset:
    """Return the changes to rendered files that follow when a person changes claims."""
    old = replace(state, ledger=before)
    keys = affected_keys(old, state, changes_on(before, state.ledger, subjects))
    return changeset.build_changeset(old, state, Changes(), keys, state.engine, read)


def faults_of_edit(before: World, after: World, changes: Iterable[ClaimChange]) -> Iterator[Fault]:
    """Yield why claims that a person wrote are refused, each located in the claim's file.

    A claim must be valid, permitted, within the quotas and without a topic clash, as if a demand
    asked for it. An edit that only takes requesters away is always allowed, like a release.

    Args:
        before, after: the world before and after the edit.
        changes: each claim as it was booked, and as the person wrote it.
    """
    for change in changes:
        claim = change.after
        if claim is None or _only_reduces(change):
            continue
        wanted, config = restoration.request_for(claim), after.config
        malformed = list(admission.faults(wanted, config))
        allowed = chain(
            permission.faults(wanted, config), quota.faults(before, after, Changes((change,)))
        )
        for each in malformed or allowed:
            yield each.within(claim_file.path_of(claim.key))
        yield from topic_clash.faults_of_claim(claim, before, after)


def _only_reduces(change: ClaimChange) -> bool:
    before, after = change.before, change.after
    if before is None or after is None:
        return False
    as_before = replace(after, requesters=before.requesters, partial=before.partial)
    return as_before == before and {*after.requesters} <= {*before.requesters}


def rendered_files(
    state: State, current: Mapping[str, str] = MappingProxyType({})
) -> dict[str, str]:
    """Return every generated file that the state requires, path → text.

    Args:
        current: the current generated files; an override with ``hold`` keeps some of them.
    """
    return changeset.render_all(state, state.engine, all_keys(state), current)


def _with_parents(field: str) -> Iterator[str]:
    """Yield a field and every field that contains it."""
    yield field
    for match in re.finditer(r"[.\[]", field):
        yield field[: match.start()]


def _subject_of(field: str) -> tuple[str, int]:
    """Return the subject of a field, to report faults of one subject together."""
    match = _SUBJECT.match(field)
    return (match[1], int(match[2])) if match else ("", 0)


def _connection_warnings(request: DemandRequest, world: World) -> Iterator[str]:
    """Yield warnings: inputs without a connection, topics that are bridged already, and notes."""
    ledger = without_suspended(world).ledger
    for one in request.demanded if request.adds_claims else ():
        held = one.held
        if isinstance(held, Application):
            for flow in flows(world.config, held):
                if not ledger.is_carried_to(flow.receiver, flow.target):
                    yield (
                        f"application '{held.id}': no connection carries {flow.name} "
                        f"{flow.topic} of '{flow.sender}' to '{flow.receiver}'"
                    )
            continue
        if one.note:
            yield f"connection '{held.id}' {one.note}"
        for route in held.topics:
            if is_bridged(route, *held.nodes, world.config):
                yield (
                    f"connection '{held.id}': {route.read_topic} is bridged between "
                    f"'{held.source}' and '{held.target}' already, so no client carries it"
                )


def _repeat(changes: Changes) -> Iterator[str]:
    """Yield a warning if the same shutdown was carried out before."""
    if changes.repeats is not None:
        at = f"{changes.repeats.at:%Y-%m-%d %H:%M:%S} UTC"
        yield f"the same shutdown was carried out at {at}; this one releases nothing more"


def refusal_text(error: InvalidInput) -> str:
    """Return a refusal as ``<code>: <field>: <remedy>``, one line for each fault."""
    return "\n".join(f"{found.code}: {found}" for found in error.faults)


def try_configuration(state: State) -> None:
    """Render trial demands for every appdef and every override in effect.

    Raises:
        Refused, InvalidInput: with the template, the values or the override that does not work.
    """
    trial_render.render_trial_demands(state, state.engine)
