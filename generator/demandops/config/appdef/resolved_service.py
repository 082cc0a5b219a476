"""The services of an appdef, and where the inputs of each service come from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from typing import TypeAlias

from pydantic import Field

from demandops.config.appdef.application_definition import ApplicationDefinition
from demandops.config.appdef.service_definition import Deployed, Parameter, Scope, ServiceDefinition
from demandops.errors import suggestion


class Service(Deployed):
    """A service of one appdef, with the origins of its inputs."""

    name: str
    # The folder in `appdefs/` that has the service's definition
    folder: str
    shared: bool
    scope: Scope
    # The origin of each input: a role of the appdef, or `<service>.<output>`
    inputs: dict[str, str]
    parameters: dict[str, Parameter]
    # For a service that runs once for each topic of a role: that role
    root: str | None = None
    # If each instance has only one source: the roles of the source's topics that the instance
    # reads, directly or through other services. Empty for any other service.
    roots: tuple[str, ...] = ()
    # For a service that runs once for each cluster: the service's node in each cluster
    nodes: dict[str, str] = Field(default_factory=dict)
    # For a service that runs once for each cluster: a map from the node of an application to the
    # node of the service in the same cluster
    runs_at: dict[str, str] = Field(default_factory=dict)

    @property
    def at_source(self) -> bool:
        """Whether the service runs on the nodes that its inputs come from."""
        return self.placement == "source"

    @property
    def is_movable(self) -> bool:
        return not self.at_source and not self.nodes

    @property
    def is_placeable(self) -> bool:
        """Whether the generator may choose the service's node separately from the application's."""
        # What several appdefs share is not placed: a demand could be refused because of a node that
        # somebody else's demand had chosen.
        return self.scope == "application" or not (self.shared or self.at_source)

    @property
    def file(self) -> str:
        return f"appdefs/{self.folder}/{'service' if self.shared else 'appdef'}.yaml"


# All services of an appdef, by name: those that it defines, and the shared ones that it uses
Services: TypeAlias = "Mapping[str, Service]"

# The path of a field of an appdef, and a message about the field
Problem: TypeAlias = "tuple[str, str]"


def resolved_services(
    appdef: ApplicationDefinition, definitions: Mapping[str, ServiceDefinition]
) -> tuple[Services, list[Problem]]:
    """Return all services of an appdef and no problem, or no service and the problems.

    Some problems are found only after a person has mended others.
    """
    services = {
        name: Service.model_construct(
            # a role in `each` is an input, even if `inputs` lacks it
            **{**dict(own), "inputs": ({own.each: own.each} if own.each else {}) | own.inputs},
            name=name,
            folder=appdef.name,
            shared=False,
            scope="topic" if own.each else "application",
            parameters=appdef.parameters,
        )
        for name, own in appdef.services.items()
    }
    for name, bound in appdef.uses.items():
        if name in definitions:
            used = {**dict(definitions[name]), "inputs": bound}
            services[name] = Service.model_construct(**used, folder=name, shared=True)
    problems = [*_input_problems(appdef, definitions, services)]
    if problems:
        return {}, problems
    graph = {
        name: [origin.partition(".")[0] for origin in service.inputs.values() if "." in origin]
        for name, service in services.items()
    }
    try:  # the roots of a service follow from those of the services that it reads
        order = list(TopologicalSorter(graph).static_order())
    except CycleError as error:
        circle = " reads ".join(f"'{name}'" for name in reversed(error.args[1]))
        problem = f"read each other in a circle: {circle}; remove one of these inputs"
        return {}, [("services", problem)]
    for name in order:
        problems += _set_roots(name, services)
    return ({}, problems) if problems else (services, [])


def _input_problems(
    appdef: ApplicationDefinition,
    definitions: Mapping[str, ServiceDefinition],
    services: Services,
) -> Iterator[Problem]:
    for name, bound in appdef.uses.items():
        if name not in definitions:
            hint = suggestion(name, definitions)
            yield f"uses.{name}", f"appdefs/{name}/service.yaml does not exist; add it{hint}"
            continue
        inputs = definitions[name].inputs
        for role in inputs.keys() - bound.keys():
            yield (
                f"uses.{name}.{role}",
                "is missing; say where the input comes from: an input of this definition, or "
                "<service>.<output>",
            )
        for role in bound.keys() - inputs.keys():
            hint = suggestion(role, inputs)
            yield f"uses.{name}.{role}", f"'{name}' has no input '{role}'; leave it out{hint}"
    for service in services.values():
        for role, origin in service.inputs.items():
            name, _, output = origin.partition(".")
            outputs = services[name].outputs if name in services else {}
            if not output and origin not in appdef.inputs:
                problem = f"'{origin}' is not an input{suggestion(origin, appdef.inputs)}"
            elif output and name not in services:
                problem = f"'{name}' is not a service{suggestion(name, services)}"
            elif output and output not in outputs:
                problem = f"'{name}' has no output '{output}'{suggestion(output, outputs)}"
            else:
                continue
            yield _place(service, role), problem


def _place(service: Service, role: str) -> str:
    if service.shared:
        return f"uses.{service.name}.{role}"
    of_each = role == service.each == service.inputs[role]
    return f"services.{service.name}.{'each' if of_each else f'inputs.{role}'}"


def _set_roots(name: str, services: dict[str, Service]) -> Iterator[Problem]:
    """Set ``root`` and ``roots`` of a service, after those of the services that it reads."""
    service, root = services[name], None
    made_from: dict[str, tuple[str, ...]] = {}
    for role, origin in service.inputs.items():
        producer = services.get(origin.partition(".")[0]) if "." in origin else None
        made_from[role] = producer.roots if producer else (origin,)
        apart = service.at_source or service.nodes
        if apart and producer and producer.root and not producer.at_source:
            other = (
                f"give '{name}' another scope"
                if service.nodes
                else f"run '{name}' at the application's node"
            )
            yield (
                _place(service, role),
                f"'{origin}' is published at the application's node, so '{name}' could get it "
                f"from several nodes under one name; run '{producer.name}' at the source, or "
                f"{other}",
            )
        if role == service.each:
            root = producer.root if producer else origin
            if root is None:
                yield (
                    _place(service, role),
                    f"'{origin}' is published once for the application or the node, not for each "
                    "topic; name another input in 'each', or leave out 'each'",
                )
                return
    roots: tuple[str, ...] = ()
    if service.scope == "topic":
        roots = (str(root),)
        for role, others in made_from.items():
            if others and root not in others:
                yield (
                    _place(service, role),
                    f"the service runs once for each topic of '{root}', but "
                    f"'{service.inputs[role]}' does not come from such a topic; read "
                    f"'{service.inputs[role]}' in a service that runs once for the application "
                    "or the node",
                )
    elif service.at_source:
        roots = tuple(sorted({role for roles in made_from.values() for role in roles}))
        if not roots:
            yield (
                f"uses.{name}",
                "runs at the sources of its inputs, but none of its inputs has a source; connect "
                "at least one input to an input of the application",
            )
    services[name] = service.model_copy(update={"root": root, "roots": roots})
