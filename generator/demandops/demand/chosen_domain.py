"""The access domain of a demand for a node that is in several.

In each further domain the node has a name of its own, ``<node>@<domain>``, which a demand may give
wherever it names a node. ``<node>@<first domain>`` is the node itself. If a demand names only the
node for an application or for an end of a connection, the domain follows from what is booked
already, or else from the rules: it is the only one that lets the requesters use the node.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

from demandops.config.config import Config
from demandops.config.inventory import id_in_domain
from demandops.connections.connection import Connection
from demandops.demand.application import Application
from demandops.demand.demand_request import AnyRequest, Demanded
from demandops.demand.permission import may_place
from demandops.errors import Fault
from demandops.subject import Subject

Held = Application | Connection
Booked = Callable[[Subject], "Held | None"]
"""Returns the application or connection that a subject's first claim holds, or ``None``."""


def with_chosen_domains(
    request: AnyRequest, config: Config, booked: Booked
) -> tuple[AnyRequest, list[Fault]]:
    """Return the request with each node's access domain, and a fault where several are possible."""
    if not config.hosts:
        return request, []
    faults: list[Fault] = []
    demanded = []
    for one in request.demanded:
        held = _with_first_names(one.held, config)
        known = booked(held.subject)
        ends = dict(_chosen(one, known, config, request.adds_claims, faults))
        demanded.append(replace(one, held=_with_ends(held, ends)))
    return replace(request, demanded=tuple(demanded)), faults


def _with_ends(held: Held, ends: Mapping[str, str]) -> Held:
    if isinstance(held, Application):
        return replace(held, node=ends.get("node", held.node))
    source, target = ends.get("source", held.source), ends.get("target", held.target)
    return replace(held, source=source, target=target)


def _with_first_names(held: Held, config: Config) -> Held:
    """Return an application or connection with each ``<node>@<first domain>`` as ``<node>``."""

    def first(name: str) -> str:
        node, _, domain = name.rpartition("@")
        own = config.domain_of.get(node)
        return node if own and name not in config.nodes and own.name == domain else name

    if isinstance(held, Connection):
        source, target, broker = map(first, (held.source, held.target, held.broker))
        return replace(held, source=source, target=target, broker=broker)
    inputs = {
        role: tuple(one._replace(source=first(one.source)) for one in topics)
        for role, topics in held.inputs.items()
    }
    deliver = tuple(one._replace(node=first(one.node)) for one in held.deliver)
    return replace(held, node=first(held.node), deliver=deliver).with_inputs(inputs)


def _chosen(
    one: Demanded, booked: Held | None, config: Config, adds: bool, faults: list[Fault]
) -> Iterator[tuple[str, str]]:
    """Yield (field, ``<node>@<domain>``) for each field whose node is in several domains."""
    held = one.held
    is_application = isinstance(held, Application)
    for field in ("node",) if is_application else ("source", "target"):
        node, current = getattr(held, field), getattr(booked, field, "")
        choices = config.nodes_of(node)
        if len(choices) < 2:
            continue
        if current in choices:
            yield field, current
            continue
        appdef = held.appdef if isinstance(held, Application) else ""
        allowed = [choice for choice in choices if may_place(one, appdef, choice, config)]
        if len(allowed) == 1:
            yield field, allowed[0]
        elif allowed and adds and one.requesters:
            domains = [config.domain_of[choice].name for choice in allowed]
            named = " or ".join(id_in_domain(node, domain) for domain in domains)
            message = (
                f"'{node}' is in the access domains {' and '.join(domains)}, and their rules let "
                f"the requesters use it in each; name it as {named}"
            )
            faults.append(one.fault(field, message, code="several-access-domains"))
