"""Notes that the requester gets about a decision, in addition to the outcome."""

from __future__ import annotations

from collections.abc import Iterator

from demandops.decide import warnings
from demandops.decide.admission import admitted_request
from demandops.decide.booking.leaving import Drain
from demandops.decide.changes.changeset import Changeset
from demandops.decide.checks import quotas
from demandops.decide.planning.flows import flows
from demandops.decide.planning.overrides import without_suspended
from demandops.decide.planning.planner import is_bridged
from demandops.model.config.override import format_time
from demandops.model.demand.application import Application
from demandops.model.demand.demand_request import DemandRequest
from demandops.model.ledger.ledger import Changes, World
from demandops.model.ledger.records import Wait
from demandops.model.release import ServiceKey, ServiceRelease


def notes_on(
    request: DemandRequest, after: World, changes: Changes, rendered: Changeset
) -> Iterator[str]:
    """Yield notes for the requester of a demand that is booked and rendered, or that waits."""
    yield from admitted_request.notes(request)
    yield from _connection_warnings(request, after)
    yield from warnings.notes(request, after)
    yield from rendered.blocked
    if changes.repeats is not None:
        at = f"{changes.repeats.at:%Y-%m-%d %H:%M:%S} UTC"
        yield f"the same shutdown was carried out at {at}, so this one releases nothing more"
    if isinstance(request, Drain):
        yield from request.stays
    if isinstance(request, Wait):
        yield from request.reasons
    yield from quotas.warnings(request, after)
    for release in (rendered.plans.get(ServiceKey.of(instance)) for instance in changes.kept):
        if isinstance(release, ServiceRelease) and release.keeps:
            until = format_time(release.keeps.until)
            yield (
                f"{release.name} keeps {release.replicas} replicas until {until} (downAfter in its "
                "definition), although its demands need fewer"
            )


def _connection_warnings(request: DemandRequest, world: World) -> Iterator[str]:
    # a connection that an override denies carries nothing
    ledger = without_suspended(world).ledger
    for item in request.demanded if request.adds_claims else ():
        held = item.held
        if isinstance(held, Application):
            for flow in flows(world.config, held):
                if not ledger.is_carried_to(flow.receiver, flow.target):
                    yield (
                        f"application '{held.id}': no connection carries {flow.topic} "
                        f"({flow.name}) of '{flow.sender}' to '{flow.receiver}'"
                    )
            continue
        if item.note:
            yield f"connection '{held.id}' {item.note}"
        for route in held.topics:
            if is_bridged(route, *held.nodes, world.config):
                yield (
                    f"connection '{held.id}': the initial deployment already carries "
                    f"{route.read_topic} between '{held.source}' and '{held.target}' (bridged in "
                    "the inventory), so no client of this connection carries it"
                )
