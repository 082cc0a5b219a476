"""Missing inputs: topics that applications read or deliver, but that do not arrive.

A demand that needs a connection gets the connection, or its requester gets a warning. Later an
override may suspend the connection, demands may release the connection, or people may remove a node
or an output from the configuration. Then a topic no longer arrives.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from demandops.demand.application import Application
from demandops.errors import Fault, fault
from demandops.ledger import claim_file
from demandops.ledger.world import World
from demandops.plan.flows import flows
from demandops.plan.overrides.claim_overrides import without_suspended


@dataclass(frozen=True, slots=True)
class MissingInput:
    """A topic that does not arrive, or an output that is no longer delivered."""

    application: str
    file: str
    reason: str

    @property
    def warning(self) -> Fault:
        return fault(f"application '{self.application}'", self.reason).within(self.file)


def missing_inputs(world: World) -> list[MissingInput]:
    """Return the topics that do not arrive, sorted by application."""
    # Suspended claims need no topics, and suspended connections carry none.
    active = without_suspended(world)
    missing = {
        MissingInput(claim.application.id, claim_file.path_of(claim.key), reason)
        for claim in active.ledger
        if claim.is_on_application
        for reason in _reasons(claim.application, active)
    }
    return sorted(missing, key=lambda each: (each.application, each.reason, each.file))


def _reasons(app: Application, active: World) -> Iterator[str]:
    config = active.config
    for role, topic in app.all_inputs():
        if topic.source not in config.nodes:
            where = f"'{topic.source}' is not in the inventory"
            yield f"{role} {topic.topic} does not arrive: {where}"
    for flow in flows(config, app):
        sender = config.nodes.get(flow.sender)
        carried = active.ledger.is_carried_to(flow.receiver, flow.target)
        if sender is None or carried:
            continue
        # The initial deployment keeps topic names, so it carries no flow that renames a topic.
        bridged = sender.bridged.get(flow.receiver, ())
        if flow.topic != flow.target or flow.topic not in bridged:
            yield (
                f"{flow.name} {flow.topic} does not arrive: no connection carries it from "
                f"'{flow.sender}' to '{flow.receiver}'"
            )
    services = config.services.get(app.appdef, {})
    for delivery in app.deliver:
        name, _, output = delivery.output.partition(".")
        if name not in services or output not in services[name].outputs:
            yield (
                f"{delivery.output} is no longer delivered to '{delivery.node}': the application "
                f"definition '{app.appdef}' has no such output"
            )
