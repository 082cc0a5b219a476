"""The choice of an access domain if a demand names a node that is in several domains.

In each further domain the node has the name ``<node>@<domain>``, which a demand may give wherever
it names a node. ``<node>@<first domain>`` means the same as ``<node>``.

A demand may name a node without a domain: as the node of an application or of a service, or as an
end of a connection. If the application or connection is booked already, its domain stays. If it is
not booked yet, the domain is the only one in which the rules let the requesters use the node. If
there is no such domain, the node's first domain is meant. If there are several, the demand is
refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from types import MappingProxyType

from demandops.config.config import Config
from demandops.config.inventory import id_in_domain
from demandops.connections.connection import Connection
from demandops.demand.application import Application
from demandops.demand.demand_request import AnyRequest, Demanded
from demandops.demand.permission import may_place
from demandops.errors import Fault
from demandops.subject import Subject

Held = Application | Connection
# returns the application or connection that a subject's first claim holds
Booked = Callable[[Subject], "Held | None"]


def with_chosen_domains(
    request: AnyRequest, config: Config, booked: Booked
) -> tuple[AnyRequest, list[Fault]]:
    """Return the request with a chosen access domain for each node.

    There is a fault for each node for which several access domains are possible. In a request that
    adds no claims, such a node stays as it is named.
    """
    if not config.hosts:
        return request, []
    faults: list[Fault] = []
    demanded = []
    for item in request.demanded:
        held = _with_short_names(item.held, config)
        booked_nodes = dict(_named(at)) if (at := booked(held.subject)) else {}
        chosen = dict(_chosen(item, booked_nodes, config, request.adds_claims, faults))
        if isinstance(held, Application):
            services = {name: chosen.get(_field(name), n) for name, n in held.services.items()}
            node = chosen.get("node", held.node)
            held = replace(held, node=node, services=MappingProxyType(services))
        else:
            source, target = chosen.get("source", held.source), chosen.get("target", held.target)
            held = replace(held, source=source, target=target)
        demanded.append(replace(item, held=held))
    return replace(request, demanded=tuple(demanded)), faults


def _with_short_names(held: Held, config: Config) -> Held:
    # <node>@<first domain> is the same node as <node>, which is the name in the configuration
    def short(name: str) -> str:
        node, _, domain = name.rpartition("@")
        own = config.domain_of.get(node)
        return node if own and name not in config.nodes and own.name == domain else name

    if isinstance(held, Connection):
        source, target, broker = map(short, (held.source, held.target, held.broker))
        return replace(held, source=source, target=target, broker=broker)
    inputs = {
        role: tuple(topic._replace(source=short(topic.source)) for topic in topics)
        for role, topics in held.inputs.items()
    }
    deliver = tuple(each._replace(node=short(each.node)) for each in held.deliver)
    services = MappingProxyType({name: short(node) for name, node in held.services.items()})
    held = replace(held, node=short(held.node), services=services, deliver=deliver)
    return held.with_inputs(inputs)


def _named(held: Held) -> Iterator[tuple[str, str]]:
    """Yield (field, node) for both ends of a connection, or for an application and its services."""
    if isinstance(held, Connection):
        yield from (("source", held.source), ("target", held.target))
    else:
        yield "node", held.node
        yield from ((_field(name), node) for name, node in held.services.items())


def _field(service: str) -> str:
    return f"services.{service}"


def _chosen(
    item: Demanded,
    booked_nodes: Mapping[str, str],
    config: Config,
    adds: bool,
    faults: list[Fault],
) -> Iterator[tuple[str, str]]:
    """Yield (field, the node's name in the chosen domain) for each node in several domains."""
    held = item.held
    for field, node in _named(held):
        choices = config.nodes_of(node)
        if len(choices) < 2:
            continue
        # A demand that is sent again must mean what is booked, even if the rules changed since
        if booked_nodes.get(field) in choices:
            yield field, booked_nodes[field]
            continue
        appdef = held.appdef if isinstance(held, Application) else ""
        allowed = [choice for choice in choices if may_place(item, appdef, choice, config)]
        if len(allowed) == 1:
            yield field, allowed[0]
        elif allowed and adds and item.requesters:
            domains = [config.domain_of[choice].name for choice in allowed]
            named = " or ".join(id_in_domain(node, domain) for domain in domains)
            message = (
                f"'{node}' is in the access domains {' and '.join(domains)}, and their rules let "
                f"the requesters use the node in each; name it as {named}"
            )
            faults.append(item.fault(field, message, code="several-access-domains"))
