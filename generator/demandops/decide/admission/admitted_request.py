"""The first part of a decision: a goal becomes a request that is complete and allowed."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from datetime import datetime
from types import MappingProxyType
from typing import TypeVar

from demandops.base.errors import Fault, Refused
from demandops.connections.connection import Connection
from demandops.decide.admission import admission, permission
from demandops.decide.admission.permission import may_place
from demandops.decide.placement import placement
from demandops.decide.placement.candidates import NO_ROOM
from demandops.decide.planning import flows
from demandops.decide.state import State
from demandops.model.config.config import Config
from demandops.model.config.inventory import id_in_domain
from demandops.model.demand import demand_goal, deployment_request_goal
from demandops.model.demand.claim import Application
from demandops.model.demand.demand_request import (
    AnyRequest,
    Decommission,
    Demanded,
    DemandRequest,
    Put,
)
from demandops.model.ledger.ledger import Ledger
from demandops.model.ledger.records import Wait, WaitingDemand

# ---- the choice of an access domain if a demand names a node that is in several domains ----
#
# In each further domain the node has the name ``<node>@<domain>``, which a demand may give wherever
# it names a node. ``<node>@<first domain>`` means the same as ``<node>``.
#
# A demand may name a node without a domain. If its application or connection is booked already, the
# domain stays. If not, it is the only domain in which the rules let the requesters use the node. If
# there is no such domain, the node's first domain is meant. If there are several, the demand is
# refused.

Held = Application | Connection


def with_chosen_domains(
    request: AnyRequest, config: Config, ledger: Ledger
) -> tuple[AnyRequest, list[Fault]]:
    """Choose a domain for each node; a node that may be used in several domains is a fault."""
    if not config.hosts:
        return request, []
    faults: list[Fault] = []
    demanded = []
    for item in request.demanded:
        held = _with_short_names(item.held, config)
        booked = ledger.held(held.subject)
        booked_nodes = _named(booked) if booked else {}
        chosen = _chosen(item, booked_nodes, config, request.adds_claims, faults)
        nodes = {**_named(held), **dict(chosen)}
        if isinstance(held, Application):
            services = {name: nodes[f"services.{name}"] for name in held.services}
            held = replace(held, node=nodes["node"], services=MappingProxyType(services))
        else:
            held = replace(held, source=nodes["source"], target=nodes["target"])
        demanded.append(replace(item, held=held))
    return replace(request, demanded=tuple(demanded)), faults


def _with_short_names(held: Held, config: Config) -> Held:
    # so that a node has one name in claims: <node>@<first domain> is the same node as <node>
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


def _named(held: Held) -> dict[str, str]:
    if isinstance(held, Connection):
        return {"source": held.source, "target": held.target}
    services = {f"services.{name}": node for name, node in held.services.items()}
    return {"node": held.node, **services}


def _chosen(
    item: Demanded, booked_nodes: Mapping[str, str], config: Config, adds: bool, faults: list[Fault]
) -> Iterator[tuple[str, str]]:
    """Yield (field, the node's name in the chosen domain) for each node in several domains."""
    held = item.held
    for field, node in _named(held).items():
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


def with_separate_instances(request: AnyRequest, config: Config) -> AnyRequest:
    demanded = (
        replace(item, held=_separated(item.held, config))
        if isinstance(item.held, Application) and item.held.version
        else item
        for item in request.demanded
    )
    return replace(request, demanded=tuple(demanded))


def _separated(app: Application, config: Config) -> Application:
    appdef = config.appdefs.get(app.appdef)
    versions = config.application_versions.get(app.appdef, {})
    version = versions.get(app.version)
    if appdef is None or appdef.versions != "separate" or version is None:
        return app
    # the default may have several names, such as channels; they have the same rank
    if version.rank == versions[""].rank:
        return replace(app, version=version.name)
    suffix = f"@{version.name}"
    id = app.id if app.id.endswith(suffix) else f"{app.id}{suffix}"
    return replace(app, id=id, version=version.name, separate=True)


def notes(request: DemandRequest) -> Iterator[str]:
    for item in request.demanded:
        if isinstance(item.held, Application) and item.held.separate:
            id, _, version = item.held.id.rpartition("@")
            yield f"application '{id}' in version {version} runs separately, as '{item.held.id}'"


# ---- the request that a goal becomes: parsed, completed, checked against the configuration ----

_ITEM = re.compile(r"(apps|applications|connections)\[(\d+)\]")

# yields faults if a request comes too soon after others of its requesters
Throttle = Callable[[DemandRequest, Config], Iterable[Fault]]
# is called often during a decision, and raises OverBudget to end it
Checkpoint = Callable[[], None]


def admitted(
    state: State, goal: object, now: datetime, throttle: Throttle, checkpoint: Checkpoint
) -> DemandRequest:
    """Return the request that a goal becomes: to wait, if it lacks only room and may wait."""
    try:
        return admit(state, goal, throttle, None, checkpoint)
    except Refused as refused:
        if any(each.code != NO_ROOM for each in refused.faults):
            raise
        # the reference's action names no demand that could wait
        if not isinstance(goal, dict) or not demand_goal.is_demand_goal(goal):
            raise
        parsed = with_separate_instances(demand_goal.parse(goal)[0], state.config)
        before = state.ledger.waiting.get(parsed.demand)
        # a demand that holds claims keeps them when it is refused, so it cannot wait as well
        holds = state.ledger.claims_of_demand(parsed.demand)
        if not isinstance(parsed, Put) or holds:
            raise
        if strangers := list(permission.owner_faults(parsed, state.ledger, state.config)):
            raise Refused(strangers) from None
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
    """Return the request that a goal becomes, or raise Refused with all faults of the goal.

    If ``trial`` is given, a node is chosen only if ``trial`` accepts the request with this node.
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
        parsed = with_separate_instances(parsed, config)
        parsed, unclear = with_chosen_domains(parsed, config, ledger)
        request = flows.with_further_topics(parsed, ledger, config)
    else:
        wired, faults = deployment_request_goal.parse(goal, config.appdef_by_wire_type)
        if wired is None:
            raise Refused(faults)
        _refuse(admission.size_faults(wired, limits))
        request, unclear = with_chosen_domains(wired, config, ledger)
    request, not_placed = placement.with_chosen_nodes(
        request, state, state.usage(), trial, checkpoint
    )
    # a release has no budget: what was booked must be released, however long that takes
    checkpoint = checkpoint if request.adds_claims else lambda: None
    checkpoint()
    request = completed(request, state)
    _refuse(admission.size_faults(request, limits))  # derived connections count as well
    checkpoint()
    # The parser leaves out a malformed field, so faults of its content would be wrong. The faults
    # of form and of content that remain are reported together, to be mended in one go.
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

        def item_of(each: Fault) -> tuple[str, int]:
            match = _ITEM.match(each.field)
            return (match[1], int(match[2])) if match else ("", 0)

        # the faults of one application or connection are reported together
        raise Refused(sorted(dict.fromkeys(faults), key=item_of))
    return request


def completed(request: DemandRequest, state: State) -> DemandRequest:
    """Return a request, whose nodes are chosen, with all else that the generator adds."""
    config, ledger = state.config, state.ledger
    request = permission.with_lease_terms(request, config)
    # clients of the reference list their connections, and later shut down just what they listed
    if request.is_reference:
        request = flows.with_further_topics(request, ledger, config)
    else:
        request = flows.with_implied_connections(request, ledger, config)
    return admission.with_chosen_types(request, config, ledger.connection)


def leaves_nodes_open(state: State, goal: object) -> bool:
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
