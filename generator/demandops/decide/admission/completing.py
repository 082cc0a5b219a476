"""A demand is completed: with all that it leaves open, in one order for both actions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

from demandops.base.errors import Fault
from demandops.connections.connection import Connection
from demandops.decide import carriers
from demandops.decide.admission import admission, permission
from demandops.decide.admission.permission import may_place
from demandops.decide.planning import flows
from demandops.decide.planning.overrides import with_overridden_nodes
from demandops.decide.state import State
from demandops.model.config.config import Config
from demandops.model.config.inventory import id_in_domain
from demandops.model.demand.demand import AnyDemand, Application, Held, InputTopic, Item
from demandops.model.ledger.ledger import Ledger


def completed(demand: AnyDemand, state: State, checkpoint: Callable[[], None]) -> AnyDemand:
    """Return a prepared demand, whose nodes are chosen, with all else that the generator adds."""
    if not demand.adds_claims:
        return replace(demand, is_complete=True)
    config, ledger = state.config, state.ledger

    def moved(app: Application) -> Application:
        # The moved services of a booked application stay on the booked nodes. Only a change of an
        # override or of a definition moves them again, and not a further demand.
        if booked := ledger.application(app.id):
            stays = replace(app, moved=booked.moved)
            if stays.has_same_definition_and_nodes(booked):
                return stays
        return with_overridden_nodes(app, state)

    demand = demand.with_each(moved)
    if flows.reads_outputs(demand):
        # again, because the nodes of listed applications may have been open
        demand, _ = flows.with_topics_of_outputs(demand, ledger, config)
        demand = flows.with_held_applications(demand, ledger, config)
    demand = carriers.with_implied_routes(demand, ledger, config)
    checkpoint()
    # before what depends on the connection: its lease, permission, quota and approval
    demand = carriers.with_carriers(demand, ledger, config)
    checkpoint()
    demanded = []
    for item in demand.demanded:
        # A client of the reference does not ask for the connections that it does not list, and gets
        # a warning where there can be none.
        topics = item.held.topics if isinstance(item.held, Connection) else ()
        if demand.operation == "join" and topics and all(route.implied for route in topics):
            alone = replace(demand, demanded=(item,))
            if [*admission.faults(alone, config), *permission.faults(alone, config)]:
                continue
        home = config.domain_of.get(item.held.home)
        lease = permission.lease_in(home, demand) if home else None
        demanded.append(replace(item, lease=lease))
    return replace(demand, demanded=tuple(demanded), is_complete=True)


# ---- the definition that a goal of the reference's action means by a number ----


def with_definitions(demand: AnyDemand, config: Config) -> AnyDemand:
    if not demand.is_reference:
        return demand
    by_number = {
        f"#{wire.type}": (name, {str(listed): role for listed, role in wire.inputs.items()})
        for name, appdef in config.appdefs.items()
        if (wire := appdef.deployment_request)
    }

    def defined(app: Application) -> Application:
        if app.appdef not in by_number:
            return app
        name, roles = by_number[app.appdef]
        inputs: dict[str, tuple[InputTopic, ...]] = {}
        for listed, topics in app.inputs.items():  # both lists may be of one role
            role = roles.get(listed) or listed
            inputs[role] = (*inputs.get(role, ()), *topics)
        return replace(app, appdef=name, inputs=inputs)

    return demand.with_each(defined)


# ---- the choice of an access domain if a demand names a node that is in several domains ----
#
# In each further domain the node has the name ``<node>@<domain>``, which a demand may give wherever
# it names a node. ``<node>@<first domain>`` means the same as ``<node>``.
#
# A demand may name a node without a domain. If its application or connection is booked already, the
# domain stays. If not, it is the only domain in which the rules let the requesters use the node. If
# there is no such domain, the node's first domain is meant. If there are several, the demand is
# refused.


def with_chosen_domains(
    request: AnyDemand, config: Config, ledger: Ledger
) -> tuple[AnyDemand, list[Fault]]:
    """Choose a domain for each node; a node that may be used in several domains is a fault."""
    if not (config.hosts or config.node_patterns):
        return request, []
    faults: list[Fault] = []

    # so that a node has one name in claims: <node>@<first domain> is the same node as <node>
    def short(name: str) -> str:
        node, _, domain = name.rpartition("@")
        own = config.domain_of.get(node)
        return node if own and name not in config.nodes and own.name == domain else name

    demanded = []
    for item in request.demanded:
        held = item.held
        booked = ledger.first_claim(held.subject)
        booked_nodes = _named(booked.held) if booked else {}
        nodes = {field: short(node) for field, node in _named(held).items()}
        nodes |= _chosen(item, booked_nodes, config, request.adds_claims, faults)
        if isinstance(held, Connection):
            source, target, broker = nodes["source"], nodes["target"], short(held.broker)
            held = replace(held, source=source, target=target, broker=broker)
        else:
            inputs = {
                role: tuple(replace(topic, source=short(topic.source)) for topic in topics)
                for role, topics in held.inputs.items()
            }
            deliver = tuple(replace(each, node=short(each.node)) for each in held.deliver)
            services = {name: nodes[f"services.{name}"] for name in held.services}
            held = replace(held, node=nodes["node"], services=services, deliver=deliver)
            held = held.with_inputs(inputs)
        demanded.append(replace(item, held=held))
    return replace(request, demanded=tuple(demanded)), faults


def _named(held: Held) -> dict[str, str]:
    if isinstance(held, Connection):
        return {"source": held.source, "target": held.target}
    services = {f"services.{name}": node for name, node in held.services.items()}
    return {"node": held.node, **services}


def _chosen(
    item: Item, booked_nodes: Mapping[str, str], config: Config, adds: bool, faults: list[Fault]
) -> Iterator[tuple[str, str]]:
    """Yield (field, the node's name in the chosen domain) for each node in several domains."""
    for field, node in _named(item.held).items():
        choices = config.nodes_of(node)
        if len(choices) < 2:
            continue
        # A demand that is sent again must mean what is booked, even if the rules changed since
        if booked_nodes.get(field) in choices:
            yield field, booked_nodes[field]
            continue
        allowed = [choice for choice in choices if may_place(item, choice, config)]
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


# ---- separate instances: applications that run another version beside the default version ----
#
# With ``versions: separate`` in the appdef, a demand for a version other than the default gets an
# application of its own. This application has the version in its id (``edge/fusion@1.1.0``), so its
# services, topics and connections have names of their own. It is removed with its last claim. A
# service that several appdefs share still runs only once, for all versions.
#
# With ``versions: separate``, a claim records the version, not the channel that the demand named.
# It does so for the default version too. If claims recorded the channel, a channel that moves to
# another version would change an application that others share.


def with_separate_instances(request: AnyDemand, config: Config) -> AnyDemand:
    def separated(app: Application) -> Application:
        appdef = config.appdefs.get(app.appdef)
        versions = config.application_versions.get(app.appdef, {})
        version = versions.get(app.version) if app.version else None
        if appdef is None or appdef.versions != "separate" or version is None:
            return app
        # the default may have several names, such as channels; they have the same rank
        if version.rank == versions[""].rank:
            return replace(app, version=version.name)
        suffix = f"@{version.name}"
        id = app.id.removesuffix(suffix) + suffix
        return replace(app, id=id, version=version.name, separate=True)

    return request.with_each(separated)
