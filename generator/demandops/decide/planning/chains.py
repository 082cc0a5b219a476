"""Applications on applications: inputs that are outputs of other applications.

Such an input becomes the topics of the output, on the nodes that publish them. Its demand holds
the other application too, so that the topics last as long as the demand. What it holds is a claim
like any other, marked with who reads it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import reduce
from graphlib import CycleError, TopologicalSorter
from typing import NamedTuple

from demandops.base.errors import Fault, suggestion
from demandops.base.naming import Subject, SubjectKind
from demandops.base.quoting import quoted
from demandops.decide.planning.flows import topics_of_origin, with_further_topics
from demandops.model.config.config import Config
from demandops.model.demand.demand import AnyDemand, Application, Demand, InputTopic, Item
from demandops.model.ledger.claim import ClaimKey
from demandops.model.ledger.ledger import ClaimChange, Ledger


class _Problem(NamedTuple):
    field: str
    message: str
    code: str = "invalid"


def reads_outputs(request: Demand) -> bool:
    return request.adds_claims and any(app.read_outputs for app in _listed(request).values())


def with_topics_of_outputs(
    request: AnyDemand, ledger: Ledger, config: Config
) -> tuple[AnyDemand, list[Fault]]:
    """Return the request with the topics of the outputs that its inputs name, and the faults.

    A topic has no source yet if the node of a listed application is still open. All inputs are
    marked as usual or further, because the names of outputs follow from these marks.
    """
    if not reads_outputs(request):
        return with_further_topics(request, ledger, config), []

    listed = _listed(request)

    def id_of(name: str) -> str:  # perhaps listed in a version that runs as a separate instance
        separate = (id for id, app in listed.items() if app.separate and id.startswith(f"{name}@"))
        return name if name in listed else next(separate, name)

    # Who reads whom, also by the claims of others: none of them may close a cycle.
    graph, todo = dict[str, list[str]](), [*listed]
    while todo:
        if (id := todo.pop()) not in graph:
            claims = ledger.application_claims(id)
            apps = [claim.application for claim in claims if claim.demand != request.demand]
            apps += [listed[id]] if id in listed else []
            graph[id] = sorted({id_of(read) for app in apps for read in app.read_outputs})
            todo += graph[id]
    order = TopologicalSorter(graph)
    try:
        order.prepare()
    except CycleError as error:
        *ring, _ = reversed(error.args[1])  # each reads the next
        item = next((i for i in request.demanded if i.held.id in ring), request.demanded[0])
        start = ring.index(item.held.id) if item.held.id in ring else 0
        ids = [quoted(id) for id in (*ring[start:], *ring[: start + 1])]
        message = ", which reads ".join((f"{ids[0]} reads an output of {ids[1]}", *ids[2:]))
        remedy = "read none that depends on this application's own"
        return request, [item.fault("inputs", f"{message}; {remedy}", code="conflict")]

    def producer(name: str) -> Application | _Problem:
        id = id_of(name)
        if app := listed.get(id) or _as_booked(id, request.demand, ledger, config):
            return app
        close = suggestion(name, {*listed, *ledger.subjects(SubjectKind.APPLICATION)})
        message = f"{quoted(name)} is neither listed in this demand nor booked{close}"
        return _Problem(".application", message, "unknown-application")

    # First those that read no outputs, then those that read only theirs, and so on.
    faults, complete = list[Fault](), dict[int, Item]()
    while order.is_active():
        order.done(*(ready := {*order.get_ready()}))
        for index, item in enumerate(request.demanded):
            if isinstance(item.held, Application) and item.held.id in ready:
                app, problems = _with_topics(item.held, producer, config)
                complete[index] = replace(item, held=app)
                faults += (item.fault(field, text, code=code) for field, text, code in problems)
        marked = replace(request, demanded=tuple(complete.values()))
        marked = with_further_topics(marked, ledger, config)
        complete = dict(zip(complete, marked.demanded, strict=True))
        listed |= _listed(marked)
    demanded = (complete.get(index, item) for index, item in enumerate(request.demanded))
    return replace(request, demanded=tuple(demanded)), faults


def _listed(request: Demand) -> dict[str, Application]:
    apps = (item.held for item in request.demanded if isinstance(item.held, Application))
    return {app.id: app for app in apps}


def _with_topics(
    app: Application, producer: Callable[[str], Application | _Problem], config: Config
) -> tuple[Application, list[_Problem]]:
    problems, inputs = list[_Problem](), dict[str, tuple[InputTopic, ...]]()
    for role, topics in app.inputs.items():
        kept, more, read = list[InputTopic](), list[InputTopic](), set[tuple[str, str]]()
        for index, topic in enumerate(topics):
            output = (topic.application, topic.output)
            if not topic.application:
                kept.append(topic)
            elif output not in read:
                read.add(output)
                made = _topics_of(topic, producer(topic.application), config)
                if isinstance(made, _Problem):
                    problems.append(made._replace(field=f"inputs.{role}[{index}]{made.field}"))
                    made = [each for each in topics if (each.application, each.output) == output]
                kept.append(made[0])
                more += made[1:]  # at the end, so that the others keep their places in the demand
        inputs[role] = (*kept, *more)
    return app.with_inputs(inputs), problems


def _topics_of(
    read: InputTopic, app: Application | _Problem, config: Config
) -> list[InputTopic] | _Problem:
    if isinstance(app, _Problem) or app.appdef not in config.services:
        return app if isinstance(app, _Problem) else [read]  # admission reports its type
    services = config.services[app.appdef].values()
    outputs = [f"{service.name}.{output}" for service in services for output in service.outputs]
    meant = [each for each in outputs if read.output in (each, each.partition(".")[2])]
    if len(meant) != 1:
        close = suggestion(read.output, outputs) or f"; {app.appdef} has none"
        several = f"is an output of several services; write {' or '.join(meant)}"
        problem = several if meant else f"is not an output of {quoted(app.id)}{close}"
        return _Problem(".output", f"{quoted(read.output)} {problem}")
    message = f"{meant[0]} of {quoted(app.id)} has no topic, because nothing is demanded for it"
    return [
        InputTopic(made.topic.topic, made.node, read.type, False, app.id, meant[0])
        for made in topics_of_origin(config, app, meant[0])
    ] or _Problem(".output", f"{message}; demand that first, or name another output")


def _as_booked(id: str, demand: str, ledger: Ledger, config: Config) -> Application | None:
    """Return what a demand that reads an application's outputs holds of it.

    It is all that others demand. What they only hold for readers, and what the demand held so far,
    counts only if nobody demands the application any longer: else a topic would never end.
    """
    if not (claims := ledger.application_claims(id)):
        return None
    demanded = [c for c in claims if c.demand != demand and not c.application.held_for]
    versions = config.application_versions.get(claims[0].application.appdef, {})
    apps = sorted(
        (claim.application for claim in demanded or claims),
        key=lambda app: versions[app.version].rank if app.version in versions else (),
    )
    united = reduce(Application.extended, apps)  # in the newest version
    united = replace(united, parameters={}, deliver=(), held_for={}).booked()
    return united.moved_to_nodes_of(claims[0].application)


def with_held_applications(request: AnyDemand, ledger: Ledger, config: Config) -> AnyDemand:
    """Return the request with the applications that it does not list, but whose outputs it reads.

    Their parameters and deliveries stay those of their own demands.
    """
    listed, held = _listed(request), dict[str, tuple[Item, Application]]()
    readers: dict[str, dict[str, tuple[str, ...]]] = {}
    reading = [(i, i.held) for i in request.demanded if isinstance(i.held, Application)]
    for item, reader in reading:  # grows by what they hold
        for id, outputs in reader.read_outputs.items():
            if id in listed:
                continue
            readers.setdefault(id, {})[reader.id] = outputs
            if id not in held and (app := _as_booked(id, request.demand, ledger, config)):
                places = item.places or (f"{item.field}.inputs",)
                held[id] = replace(item, places=places, is_listed=False), app
                reading.append(held[id])
    more = (replace(i, held=replace(app, held_for=readers[app.id])) for i, app in held.values())
    return replace(request, demanded=(*request.demanded, *more))


def without_idle_holds(
    ledger: Ledger, changes: Iterable[ClaimChange]
) -> tuple[Ledger, list[ClaimKey]]:
    """Return the ledger in which the changed demands hold applications only for readers they have.

    A decommission, and a lease that ends in one access domain, may take the reader alone.
    """
    keys = list[ClaimKey]()
    for demand in dict.fromkeys(change.key.demand for change in changes if change.before):
        while idle := [  # again, because what was held may have held more
            (claim, readers)
            for claim in ledger.claims_of_demand(demand)
            if claim.is_on_application and (held_for := claim.application.held_for)
            for readers in [{id: held_for[id] for id in held_for if _has(ledger, demand, id)}]
            if readers != held_for
        ]:
            for claim, readers in idle:
                left = replace(claim, held=replace(claim.application, held_for=readers))
                ledger = ledger.replace(claim.key, left if readers else None)
                keys.append(claim.key)
    return ledger, keys


def _has(ledger: Ledger, demand: str, application: str) -> bool:
    return ledger.get(ClaimKey(Subject(SubjectKind.APPLICATION, application), demand)) is not None


def followed(app: Application, demand: str, ledger: Ledger, config: Config) -> Application:
    """Return a booked application with the topics that the outputs it reads have in ``ledger``."""

    def producer(id: str) -> Application | _Problem:
        claim = ledger.get(ClaimKey(Subject(SubjectKind.APPLICATION, id), demand))
        return claim.application if claim else _Problem("", "")

    item = Item(_with_topics(app, producer, config)[0], ())
    put = with_further_topics(Demand("put", demand=demand, demanded=(item,)), ledger, config)
    return _listed(put)[app.id].booked()
