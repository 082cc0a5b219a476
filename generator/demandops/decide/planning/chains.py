"""Applications on applications: inputs that are outputs of other applications.

Such an input becomes the topics of the output, on the nodes that publish them. Its demand holds
the other application too, so that the topics last as long as the demand. What it holds is a claim
like any other, marked with who reads it.
"""

from __future__ import annotations

from collections.abc import Callable
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
from demandops.model.ledger.claim import Claim, ClaimKey
from demandops.model.ledger.ledger import Ledger


class Problem(NamedTuple):
    field: str  # of the application that reads
    message: str
    code: str = "invalid"


def with_topics_of_outputs(
    request: AnyDemand, ledger: Ledger, config: Config
) -> tuple[AnyDemand, list[Fault]]:
    """Return the request with the topics of the outputs that its inputs name, and the faults.

    A topic has no source yet if the node of a listed application is still open. All inputs are
    marked as usual or further, because the names of outputs follow from these marks.
    """
    listed = _listed(request)
    if not request.adds_claims or not any(app.read_outputs for app in listed.values()):
        return with_further_topics(request, ledger, config), []
    # Who reads whom, also by the claims of others: none of them may close a cycle.
    graph, todo = dict[str, list[str]](), [*listed]
    while todo:
        if (id := todo.pop()) not in graph:
            others = ledger.application_claims(id)
            apps = [claim.application for claim in others if claim.demand != request.demand]
            apps += [listed[id]] if id in listed else []
            graph[id] = sorted({_id_of(read, listed) for app in apps for read in app.read_outputs})
            todo += graph[id]
    order = TopologicalSorter(graph)
    try:
        order.prepare()
    except CycleError as error:
        *ring, _ = reversed(error.args[1])  # each reads the next
        # the claims of others may also make one, if people wrote them
        item = next((i for i in request.demanded if i.held.id in ring), request.demanded[0])
        start = ring.index(item.held.id) if item.held.id in ring else 0
        ids = [quoted(id) for id in (*ring[start:], *ring[: start + 1])]
        message = ", which reads ".join((f"{ids[0]} reads an output of {ids[1]}", *ids[2:]))
        remedy = "read none that depends on this application's own"
        return request, [item.fault("inputs", f"{message}; {remedy}", code="conflict")]
    # First those that read no outputs, then those that read only theirs, and so on.
    faults, complete = list[Fault](), dict[int, Item]()

    def producer(name: str) -> Application | Problem:
        id = _id_of(name, listed)
        if app := listed.get(id) or _as_booked(id, request.demand, ledger, config):
            return app
        close = suggestion(name, {*listed, *ledger.subjects(SubjectKind.APPLICATION)})
        message = f"{quoted(name)} is neither listed in this demand nor booked{close}"
        return Problem(".application", message, "unknown-application")

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


def _id_of(id: str, listed: dict[str, Application]) -> str:
    # the demand may list it in a version that runs as a separate instance
    separate = (app.id for app in listed.values() if app.separate)
    return id if id in listed else next((own for own in separate if own.startswith(f"{id}@")), id)


def _with_topics(
    app: Application, producer: Callable[[str], Application | Problem], config: Config
) -> tuple[Application, list[Problem]]:
    """Return an application with the topics that the outputs it reads have now.

    Further topics of an output come last, so that the others keep their places in the demand.
    """
    problems, inputs = list[Problem](), dict[str, tuple[InputTopic, ...]]()
    for role, topics in app.inputs.items():
        groups: dict[tuple[str, str, int], list[InputTopic]] = {}
        for index, topic in enumerate(topics):
            named = (topic.application, topic.output, -1 if topic.application else index)
            groups.setdefault(named, []).append(topic)
        for index, (named, group) in enumerate(groups.items()):
            if not named[0]:
                continue
            made = _current(group, producer(named[0]), config)
            if isinstance(made, Problem):
                problems.append(made._replace(field=f"inputs.{role}[{index}]{made.field}"))
            else:
                groups[named] = made
        first = (group[0] for group in groups.values())
        inputs[role] = (*first, *(topic for group in groups.values() for topic in group[1:]))
    return app.with_inputs(inputs), problems


def _current(
    group: list[InputTopic], app: Application | Problem, config: Config
) -> list[InputTopic] | Problem:
    read = group[0]
    if isinstance(app, Problem):
        return app
    if app.appdef not in config.services:
        return group  # admission reports it
    services = config.services[app.appdef].values()
    outputs = [f"{service.name}.{output}" for service in services for output in service.outputs]
    meant = [each for each in outputs if read.output in (each, each.partition(".")[2])]
    if len(meant) != 1:
        close = suggestion(read.output, outputs) or f"; {app.appdef} has none"
        problem = f"is not an output of {quoted(app.id)}{close}"
        if meant:
            problem = f"is an output of several services; write {' or '.join(meant)}"
        return Problem(".output", f"{quoted(read.output)} {problem}")
    topics = [
        InputTopic(published.topic.topic, published.node, read.type, False, app.id, meant[0])
        for published in topics_of_origin(config, app, meant[0])
    ]
    message = f"{meant[0]} of {quoted(app.id)} has no topic, because nothing is demanded for it"
    return topics or Problem(".output", f"{message}; demand that first, or name another output")


def _as_booked(id: str, demand: str, ledger: Ledger, config: Config) -> Application | None:
    """Return what a demand that reads an application's outputs holds of it.

    It is all that others demand. What they only hold for readers, and what the demand held so far,
    counts only if nobody demands the application any longer: else a topic would never end.
    """
    claims = ledger.application_claims(id)
    claims = tuple(c for c in claims if c.demand != demand and not c.application.held_for) or claims
    if not claims:
        return None
    versions = config.application_versions.get(claims[0].application.appdef, {})

    def newest_last(claim: Claim) -> tuple[object, ...]:
        version = versions.get(claim.application.version)
        return version.rank if version else ()

    apps = [claim.application for claim in sorted(claims, key=newest_last)]
    united = reduce(Application.extended, apps).moved_to_nodes_of(claims[0].application)
    return replace(united, parameters={}, deliver=(), held_for={}).booked()


def with_held_applications(request: AnyDemand, ledger: Ledger, config: Config) -> AnyDemand:
    """Return the request with the applications that it does not list, but whose outputs it reads.

    Their parameters and deliveries stay those of their own demands.
    """
    listed = _listed(request)
    held, readers = dict[str, tuple[Item, Application]](), dict[str, dict[str, tuple[str, ...]]]()
    reading = [(i, i.held) for i in request.demanded if isinstance(i.held, Application)]
    for item, reader in reading if request.adds_claims else ():  # grows by what they hold
        for id, outputs in reader.read_outputs.items():
            if id in listed:
                continue
            readers.setdefault(id, {})[reader.id] = outputs
            if id not in held and (app := _as_booked(id, request.demand, ledger, config)):
                held[id] = replace(item, needed_by=item.needed_by or _place(reader, id)), app
                reading.append(held[id])
    more = (replace(i, held=replace(app, held_for=readers[app.id])) for i, app in held.values())
    return replace(request, demanded=(*request.demanded, *more))


def _place(app: Application, read: str) -> str:
    return next(
        f"inputs.{role}[{index}]"
        for role, topics in app.inputs.items()
        for index, topic in enumerate(topics)
        if topic.application == read
    )


def followed(app: Application, demand: str, ledger: Ledger, config: Config) -> Application:
    """Return a booked application with the topics of the outputs that it reads of ``ledger``."""

    def producer(id: str) -> Application | Problem:
        claim = ledger.get(ClaimKey(Subject(SubjectKind.APPLICATION, id), demand))
        return claim.application if claim else Problem("", "")

    moved, _ = _with_topics(app, producer, config)
    put = Demand("put", demand=demand, demanded=(Item(moved, ()),))
    (item,) = with_further_topics(put, ledger, config).demanded
    assert isinstance(item.held, Application)  # noqa: S101 - see above
    return item.held.booked()
