"""Application definitions (appdefs): a YAML file and a folder define a type of application.

An appdef lists inputs, parameters and services, which read inputs of the demand and outputs of each
other. Its own services run for its applications only. A service that several types of applications
share has a file of its own (paper, section on object detection), and each of them uses it by name.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import Field, StringConstraints, model_validator

from demandops import strict_yaml
from demandops.config.base_model import (
    Approval,
    CamelModel,
    DnsLabel,
    FileModel,
    Items,
    Positive,
    Text,
    Word,
)
from demandops.errors import suggestion

TopicPattern = Annotated[
    str,
    StringConstraints(
        pattern=r"^(/([A-Za-z_][A-Za-z0-9_]*|([A-Za-z_][A-Za-z0-9_]*)?\{instance\}[A-Za-z0-9_]*))+$"
    ),
]
"""A topic name; ``{instance}`` is replaced by the service's source or application."""


VersionPolicy = Literal["refuse", "update", "upgrade"]
"""What follows if demands ask for different versions of what they share.

``refuse``: the later one is refused. ``update``: the newest version runs; another major version
needs a person's approval. ``upgrade``: the newest version runs.
"""

Count = Annotated[int, Field(ge=0, le=1000)]
"""A number of replicas."""

Percent = Annotated[int, Field(ge=1, le=1000)]
"""A share of what a pod requests; it may use more than that."""

Measure = Literal["topics", "sources", "claims", "requesters"]
"""What the number of replicas may follow."""

Resource = Literal["cpu", "memory"]
"""What an autoscaler measures."""


class Input(CamelModel):
    """A role of demanded topics, for example ``point_cloud``."""

    description: Text = ""
    type: Text = ""


class Parameter(CamelModel):
    """A value that demands may set, and how the values of several demands are merged."""

    description: Text = ""
    default: Any = None
    merge: Literal["union", "max", "min", "latest"] | None = None


class Sizes(CamelModel):
    """The replicas of each size; a parameter of the demands names the size."""

    parameter: Word
    replicas: Annotated[dict[Word, Count], Field(min_length=1)]

    def replicas_for(self, value: object) -> int | None:
        """Return the replicas for a parameter's value; of a list, for the largest size.

        ``None`` means that the value is not a size.
        """
        names = value if isinstance(value, list) else [value]
        known = [self.replicas[name] for name in names if name in [*self.replicas]]
        return max(known) if known and len(known) == len(names) else None


class Scaling(CamelModel):
    """How many replicas a service has: ``min``, if nothing else decides.

    ``per`` gives one replica for that many topics, sources, claims or requesters, ``sizes`` as many
    as a parameter's value stands for. ``autoscaler`` has the targets of a HorizontalPodAutoscaler,
    in percent of what the pods request. ``divides_work`` says that replicas publish nothing twice.
    """

    min: Count = 1
    max: Annotated[Count, Field(ge=1)] = 1
    per: Annotated[dict[Measure, Positive], Field(min_length=1)] | None = None
    sizes: Sizes | None = None
    autoscaler: Annotated[dict[Resource, Percent], Field(min_length=1)] | None = None
    may_depend_on_requesters: bool = False
    divides_work: bool = False

    @model_validator(mode="before")
    @classmethod
    def _renamed(cls, data: object) -> object:
        if isinstance(data, dict) and "topicsPerReplica" in data:
            per = strict_yaml.short_repr(data["topicsPerReplica"])
            raise ValueError(f"topicsPerReplica has a new name; write per: {{topics: {per}}}")
        return data

    @model_validator(mode="after")
    def _consistent(self) -> Scaling:
        if problems := [*self._problems()]:
            raise ValueError("; ".join(problems))
        return self

    def _problems(self) -> Iterator[str]:
        if self.min > self.max:
            yield f"min {self.min} is above max {self.max}; lower min or raise max"
        deciding = [f"per: {measure}" for measure in self.per or ()]
        deciding += [name for name in ("sizes", "autoscaler") if getattr(self, name)]
        if len(deciding) > 1:
            yield f"{' and '.join(deciding)} each decide the number of replicas; keep one"
        for name in sorted({"min", "max"} & self.model_fields_set) if self.sizes else ():
            yield f"sizes list every number of replicas, so {name} does nothing; remove it"
        for name in ("per", "autoscaler"):
            if getattr(self, name) and self.min == self.max:
                yield f"{name} has no choice between min {self.min} and max {self.max}; raise max"
        if self.autoscaler and self.min == 0:
            yield "an autoscaler keeps at least one replica; raise min to 1"
        by_requesters = "requesters" in (self.per or {})
        if by_requesters and not self.may_depend_on_requesters:
            yield (
                "per: requesters shows in the rendered files how many requesters there are; allow "
                "it with mayDependOnRequesters: true"
            )
        if self.may_depend_on_requesters and not by_requesters:
            yield "mayDependOnRequesters does nothing without per: requesters; remove it"

    @property
    def most(self) -> int:
        """The highest number of replicas that it may give."""
        if self.sizes:
            return max(self.sizes.replicas.values())
        return self.max if self.per or self.autoscaler else self.min


Scope = Literal["application", "topic", "node"]
"""What one instance of a service is for."""


class Deployed(CamelModel):
    """How a service runs: its releases' names, chart and values, and what it publishes.

    ``each`` names an input; the service then runs once for every topic of it.
    """

    prefix: Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9]{0,9}$")]
    description: Text = ""
    each: Word | None = None
    outputs: dict[Word, TopicPattern] = Field(default_factory=dict)
    placement: Literal["application", "source"] = "application"
    scaling: Scaling = Scaling()
    chart: DnsLabel
    images: Items[DnsLabel] = ()
    values: Annotated[str, StringConstraints(pattern=r"^values/[A-Za-z0-9_.-]+$")]

    @model_validator(mode="after")
    def _published_once(self) -> Deployed:
        if self.outputs and self.scaling.most > 1 and not self.scaling.divides_work:
            raise ValueError(
                f"scaling: gives up to {self.scaling.most} replicas, each of which would publish "
                "every output; keep one, or say dividesWork: true if the program divides its work"
            )
        return self


class OwnService(Deployed):
    """A service of one appdef. Its ``inputs`` name roles of the appdef or ``<service>.<output>``.

    ``each`` names one of these inputs, or a role that is then an input too.
    """

    inputs: dict[Word, str] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _consistent(self) -> OwnService:
        if self.placement == "source" and not self.each:
            raise ValueError("placement 'source' needs 'each': an application has no single source")
        return self


class ServiceDefinition(Deployed, FileModel):
    """A service that several appdefs may use: ``appdefs/<name>/service.yaml``."""

    kind: Literal["ServiceDefinition"]
    name: DnsLabel
    scope: Scope
    inputs: dict[Word, Input] = Field(default_factory=dict)
    parameters: dict[Word, Parameter] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _consistent(self) -> ServiceDefinition:
        if (self.each is None) is (self.scope == "topic"):
            raise ValueError("scope 'topic' needs 'each', and no other scope may have it")
        if self.each and self.each not in self.inputs:
            known = suggestion(self.each, self.inputs)
            raise ValueError(f"each: '{self.each}' is not an input{known}")
        if self.placement == "source" and self.scope == "application":
            raise ValueError("placement 'source' needs the scope 'topic' or 'node'")
        if problems := [*_size_problems(self.scaling, self.parameters)]:
            raise ValueError("; ".join(problems))
        return self


class Service(Deployed):
    """A service as the applications of one appdef have it.

    ``folder`` is that of its definition in ``appdefs/``. ``inputs`` maps all its inputs to roles of
    the appdef or ``<service>.<output>``. ``root`` is the role whose topics a service with ``each``
    runs for; ``roots`` are the roles of which it reads the topics of one source only.
    """

    name: str
    folder: str
    shared: bool
    scope: Scope
    inputs: dict[str, str]
    parameters: dict[str, Parameter]
    root: str | None = None
    roots: tuple[str, ...] = ()

    @property
    def at_source(self) -> bool:
        """Whether it runs at the sources of its inputs."""
        return self.placement == "source"

    @property
    def file(self) -> str:
        """The file that defines it."""
        return f"appdefs/{self.folder}/{'service' if self.shared else 'appdef'}.yaml"


Services: TypeAlias = "Mapping[str, Service]"
"""The services of an appdef, its own and those that it uses, by name."""


class WireNames(CamelModel):
    """The names of this application in the reference's ``DeploymentRequest``.

    ``type`` is the number in ``Application.type``. ``inputs`` maps the topic lists of the
    message's body to roles.
    """

    type: Annotated[int, Field(ge=1, le=255)]
    inputs: dict[Literal["ego_data_topics", "pointcloud_topics"], Word]


class ApplicationDefinition(FileModel):
    """One type of application: ``appdefs/<name>/appdef.yaml``.

    ``uses`` maps each shared service to where its inputs come from.
    """

    kind: Literal["ApplicationDefinition"]
    name: DnsLabel
    description: Text = ""
    inputs: dict[Word, Input]
    parameters: dict[Word, Parameter] = Field(default_factory=dict)
    deployment_request: WireNames | None = None
    uses: dict[DnsLabel, dict[Word, str]] = Field(default_factory=dict)
    services: dict[DnsLabel, OwnService] = Field(default_factory=dict)
    approval: Approval = "none"
    versions: VersionPolicy = "refuse"

    @model_validator(mode="after")
    def _consistent(self) -> ApplicationDefinition:
        problems = [
            f"deploymentRequest.inputs: '{role}' is not an input{suggestion(role, self.inputs)}"
            for role in (self.deployment_request.inputs if self.deployment_request else {}).values()
            if role not in self.inputs
        ]
        problems += [
            f"uses.{name}: 'services' has a service of this name; rename that one"
            for name in self.uses
            if name in self.services
        ]
        problems += [
            f"services.{name}.{problem}"
            for name, service in self.services.items()
            for problem in _size_problems(service.scaling, self.parameters)
        ]
        if not self.services and not self.uses:
            problems.append("services: is empty; list at least one, or use one")
        if problems:
            raise ValueError("; ".join(problems))
        return self


def _size_problems(scaling: Scaling, parameters: Mapping[str, Parameter]) -> Iterator[str]:
    """Yield what is wrong with the parameter that names a service's size."""
    sizes = scaling.sizes
    if sizes is None:
        return
    place, name = "scaling.sizes.parameter", sizes.parameter
    parameter = parameters.get(name)
    if parameter is None:
        yield f"{place}: '{name}' is not a parameter{suggestion(name, parameters)}"
        return
    if parameter.merge in ("max", "min"):
        yield (
            f"{place}: '{name}' has merge: {parameter.merge}, which is for numbers; with union, "
            "the largest size counts"
        )
    if sizes.replicas_for(parameter.default) is None:
        default = strict_yaml.short_repr(parameter.default)
        known = suggestion(str(parameter.default), sizes.replicas)
        yield f"{place}: '{name}' has the default {default}, which is not a size{known}"


Problem: TypeAlias = "tuple[str, str]"
"""A field of an appdef and what is wrong there."""


def resolved_services(
    appdef: ApplicationDefinition, definitions: Mapping[str, ServiceDefinition]
) -> tuple[Services, list[Problem]]:
    """Return the services of an appdef, its own and those that it uses, or what is wrong."""
    services = {
        name: Service.model_construct(
            **{**dict(own), "inputs": _with_each(own)},
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
    problems = [*_unbound(appdef, definitions), *_unknown(appdef, services)]
    if problems:
        return {}, problems
    graph = {
        name: [origin.partition(".")[0] for origin in one.inputs.values() if "." in origin]
        for name, one in services.items()
    }
    try:
        order = list(TopologicalSorter(graph).static_order())
    except CycleError as error:
        circle = " reads ".join(f"'{name}'" for name in reversed(error.args[1]))
        return {}, [("services", f"are in a circle: {circle}; take one of these inputs away")]
    for name in order:
        problems += _set_roots(name, services)
    return ({}, problems) if problems else (services, [])


def _with_each(service: OwnService) -> dict[str, str]:
    return ({service.each: service.each} if service.each else {}) | service.inputs


def _unbound(
    appdef: ApplicationDefinition, definitions: Mapping[str, ServiceDefinition]
) -> Iterator[Problem]:
    for name, bound in appdef.uses.items():
        if name not in definitions:
            known = suggestion(name, definitions)
            yield f"uses.{name}", f"appdefs/{name}/service.yaml does not exist; add it{known}"
            continue
        inputs = definitions[name].inputs
        for role in inputs.keys() - bound.keys():
            yield f"uses.{name}.{role}", "is missing; name an input, or an output of a service"
        for role in bound.keys() - inputs.keys():
            known = suggestion(role, inputs)
            yield f"uses.{name}.{role}", f"'{name}' has no such input; leave it out{known}"


def _unknown(appdef: ApplicationDefinition, services: Services) -> Iterator[Problem]:
    for service in services.values():
        for role, origin in service.inputs.items():
            name, _, output = origin.partition(".")
            known = services[name].outputs if name in services else services
            if not output and origin not in appdef.inputs:
                problem = f"'{origin}' is not an input{suggestion(origin, appdef.inputs)}"
            elif output and name not in services:
                problem = f"'{name}' is not a service{suggestion(name, services)}"
            elif output and output not in known:
                problem = f"'{name}' has no output '{output}'{suggestion(output, known)}"
            else:
                continue
            yield _place(service, role), problem


def _place(service: Service, role: str) -> str:
    if service.shared:
        return f"uses.{service.name}.{role}"
    of_each = role == service.each == service.inputs[role]
    return f"services.{service.name}.{'each' if of_each else f'inputs.{role}'}"


def _set_roots(name: str, services: dict[str, Service]) -> Iterator[Problem]:
    """Set the roots of a service from those of the services that it reads."""
    service, root = services[name], None
    made_from: dict[str, tuple[str, ...]] = {}
    for role, origin in service.inputs.items():
        producer = services.get(origin.partition(".")[0]) if "." in origin else None
        made_from[role] = producer.roots if producer else (origin,)
        if service.at_source and producer and producer.root and not producer.at_source:
            yield (
                _place(service, role),
                f"'{origin}' is made at the node of each application, so several nodes may make it "
                f"under one name; run '{producer.name}' at the source, or this one at the "
                "application's node",
            )
        if role == service.each:
            root = producer.root if producer else origin
            if root is None:
                yield (
                    _place(service, role),
                    f"'{origin}' is not made for each topic of an input; 'each' needs an input "
                    "that is",
                )
                return
    roots: tuple[str, ...] = ()
    if service.scope == "topic":
        roots = (str(root),)
        for role, others in made_from.items():
            if others and root not in others:
                yield (
                    _place(service, role),
                    f"'{service.inputs[role]}' is of other topics than '{root}', which the service "
                    "runs for; read it in a service that runs for the application or the node",
                )
    elif service.at_source:
        roots = tuple(sorted({one for of in made_from.values() for one in of}))
        if not roots:
            yield (
                f"uses.{name}",
                "runs at the sources of its inputs, but none of them has a source; bind one to an "
                "input of the application",
            )
    services[name] = service.model_copy(update={"root": root, "roots": roots})
