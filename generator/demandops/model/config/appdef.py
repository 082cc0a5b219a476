"""Application definitions (appdefs): a YAML file and a folder define a type of application.

An appdef lists inputs, parameters and services. The services read topics of the demand and outputs
of other services. A service that an appdef defines itself runs only for applications of this
appdef. A service that several appdefs share has a file of its own (paper, section on object
detection), and each of these appdefs lists the service's name under ``uses``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from graphlib import CycleError, TopologicalSorter
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import Field, StringConstraints, model_validator

from demandops.base import strict_yaml
from demandops.base.errors import InvalidInput, sentences, suggestion
from demandops.model.config import base_model, inventory
from demandops.model.config.base_model import CamelModel, DnsLabel, FileModel, Items, Text, Word
from demandops.model.config.inventory import LabelKey, LabelValue, NodeId, PropertyName, Resources

# ---- the number of replicas of a service ----

Count = Annotated[int, Field(ge=0, le=1000)]

# A percentage of what a pod requests of a resource. It may be above 100, because a pod may use more
# than it requests.
Percent = Annotated[int, Field(ge=1, le=1000)]

# What the generator counts to get the number of replicas. Each replica serves up to a fixed number
# of the counted things.
Measure = Literal["topics", "sources", "claims", "requesters"]

Resource = Literal["cpu", "memory"]


class Sizes(CamelModel):
    """The number of replicas for each size. A parameter of the demands names the size."""

    parameter: Word
    replicas: Annotated[dict[Word, Count], Field(min_length=1)]

    def replicas_for(self, value: object) -> int | None:
        """Return the number for a size, or for the largest of a list; ``None`` for all else."""
        names = value if isinstance(value, list) else [value]
        # compared with a list, because a value may have no hash, such as a mapping
        counts = [self.replicas[name] for name in names if name in [*self.replicas]]
        return max(counts) if counts and len(counts) == len(names) else None


class Scaling(CamelModel):
    """How many replicas a service has: ``min``, unless another field decides."""

    min: Count = 1
    max: Annotated[Count, Field(ge=1)] = 1
    per: Annotated[dict[Measure, base_model.Positive], Field(min_length=1)] | None = None
    sizes: Sizes | None = None
    autoscaler: Annotated[dict[Resource, Percent], Field(min_length=1)] | None = None
    may_depend_on_requesters: bool = False
    divides_work: bool = False

    @model_validator(mode="before")
    @classmethod
    def _renamed(cls, data: object) -> object:
        if not isinstance(data, dict):
            return data
        if "topicsPerReplica" in data:
            per = strict_yaml.short_repr(data["topicsPerReplica"])
            raise ValueError(f"'topicsPerReplica' has a new name; write 'per: {{topics: {per}}}'")
        return {name: value for name, value in data.items() if name != "downAfter"}  # ignored

    @property
    def least(self) -> int:
        """The replicas that request resources at least, whatever is demanded."""
        if self.autoscaler:
            return self.max
        return min(self.sizes.replicas.values()) if self.sizes else self.min

    @model_validator(mode="after")
    def _consistent(self) -> Scaling:
        if problems := [*self._problems()]:
            raise ValueError(sentences(problems))
        return self

    def _problems(self) -> Iterator[str]:
        if self.min > self.max:
            yield f"min {self.min} is above max {self.max}; lower min or raise max"
        deciding = [f"'per: {measure}'" for measure in self.per or ()]
        deciding += [f"'{name}'" for name in ("sizes", "autoscaler") if getattr(self, name)]
        if len(deciding) > 1:
            yield f"{' and '.join(deciding)} each decide the number of replicas; keep one"
        for name in sorted({"min", "max"} & self.model_fields_set) if self.sizes else ():
            yield (
                f"'sizes' alone decides the number of replicas, so {name} does nothing; "
                f"remove {name}"
            )
        for name in ("per", "autoscaler"):
            if getattr(self, name) and self.min == self.max:
                yield f"'{name}' does nothing, because min and max are both {self.max}; raise max"
        if self.autoscaler and self.min == 0:
            yield "an autoscaler keeps at least one replica; raise min to 1"
        by_requesters = "requesters" in (self.per or {})
        if by_requesters and not self.may_depend_on_requesters:
            yield (
                "'per' counts requesters, so the rendered files show how many requesters there "
                "are; allow this with 'mayDependOnRequesters: true'"
            )
        if self.may_depend_on_requesters and not by_requesters:
            yield "'mayDependOnRequesters' does nothing unless 'per' counts requesters; remove it"

    @property
    def most(self) -> int:
        if self.sizes:
            return max(self.sizes.replicas.values())
        return self.max if self.per or self.autoscaler else self.min


# A definition's fields that earlier versions read. They have no effect, whatever their value.
_IGNORED = re.compile(r"(services\.[^.]+\.)?scaling\.downAfter")


def ignored_fields(path: str, text: str) -> list[str]:
    if not re.fullmatch(r"appdefs/[^/]+/(appdef|service)\.yaml", path) or "downAfter" not in text:
        return []
    return [field for field in strict_yaml.lines(text) if _IGNORED.fullmatch(field)]


# The forms in which such a field may stand, and what stays in its place
_FORMS = (
    (re.compile(r",\s*downAfter:[^,}#\n]+"), ""),
    (re.compile(r"downAfter:[^,}#\n]+,\s*"), ""),
    (re.compile(r"^ *downAfter:.*\n?", re.MULTILINE), ""),
    (re.compile(r"downAfter:[^,}#\n]+(?=})"), ""),
    (re.compile(r"downAfter:[^#\n]*?(?= *(?:#|$))", re.MULTILINE), "{}"),
)


def without_ignored_fields(path: str, text: str) -> str:
    """Return a definition's text without these fields; one in an odd form stays."""
    for field in ignored_fields(path, text):
        with suppress(InvalidInput):  # it has several documents
            wanted = scaling = strict_yaml.load(text)
            for key in field.split(".")[:-1]:
                scaling = scaling[key]
            del scaling["downAfter"]
            for form, left in _FORMS:
                for match in form.finditer(text):
                    shorter = text[: match.start()] + left + text[match.end() :]
                    with suppress(InvalidInput):
                        if strict_yaml.load(shorter) == wanted:
                            return without_ignored_fields(path, shorter)
    return text


# ---- services as people define them ----

# The name of an output's topic. `{instance}` stands for the source, the application or the node
# that the service runs for.
TopicPattern = Annotated[
    str,
    StringConstraints(
        pattern=r"^(/([A-Za-z_][A-Za-z0-9_]*|([A-Za-z_][A-Za-z0-9_]*)?\{instance\}[A-Za-z0-9_]*))+$"
    ),
]

# The scope of a service: what each of its instances is for
Scope = Literal["application", "topic", "node", "cluster"]


class Place(CamelModel):
    """Requirements on a service's node."""

    role: Word | Literal[""] = ""
    labels: dict[LabelKey, LabelValue] = Field(default_factory=dict)
    capabilities: Items[Word] = ()
    properties: dict[PropertyName, inventory.RequiredValue] = Field(default_factory=dict)


class Input(CamelModel):
    """An input: topics of a demand, or of a shared service, whose origin an appdef gives."""

    description: Text = ""
    type: Text = ""


class Parameter(CamelModel):
    """A value that demands may set, and how the values of several demands are merged."""

    description: Text = ""
    default: Any = None
    merge: Literal["union", "max", "min", "latest"] | None = None
    minimum: int | float | None = None
    maximum: int | float | None = None
    one_of: Annotated[Items[Any], Field(min_length=1)] | None = None

    def problem(self, value: object) -> str:
        """Return why demands may not give this value, or one of its items; else nothing."""
        if isinstance(value, list) and self.merge == "union":
            return next(filter(None, map(self.problem, value)), "")
        shown, is_bool = strict_yaml.short_repr(value), isinstance(value, bool)
        if self.one_of and (is_bool, value) not in [(type(v) is bool, v) for v in self.one_of]:
            return f"{shown} is not one of {', '.join(map(strict_yaml.short_repr, self.one_of))}"
        for word, limit in (("minimum", self.minimum), ("maximum", self.maximum)):
            if limit is None:
                continue
            if is_bool or not isinstance(value, int | float):
                return f"{shown} is not a number, which the {word} {limit} needs"
            if value != limit and (value < limit) is (word == "minimum"):
                return f"{shown} is {'less' if value < limit else 'more'} than the {word} {limit}"
        return ""

    @model_validator(mode="after")
    def _default_within(self) -> Parameter:
        limits = [limit for limit in (self.minimum, self.maximum) if limit is not None]
        if limits != sorted(limits):
            raise ValueError(f"minimum {limits[0]} is above maximum {limits[1]}; swap them")
        if self.default is not None and (problem := self.problem(self.default)):
            raise ValueError(f"the default {problem}; change one of them")
        return self


class Deployed(CamelModel):
    """How a service runs (the names, chart and values of its releases), and what it publishes."""

    prefix: Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9]{0,9}$")]
    description: Text = ""
    each: Word | None = None
    outputs: dict[Word, TopicPattern] = Field(default_factory=dict)
    placement: Literal["application", "source"] = "application"
    place: Place | None = None
    scaling: Scaling = Scaling()
    requests: Resources = Field(default_factory=dict)
    # The values at the top level that the running service takes over, so that its pods stay
    live: Items[Text] = ()
    chart: DnsLabel
    images: Items[DnsLabel] = ()
    values: Annotated[str, StringConstraints(pattern=r"^values/[A-Za-z0-9_.-]+$")]

    @model_validator(mode="after")
    def _published_once(self) -> Deployed:
        if self.outputs and self.scaling.most > 1 and not self.scaling.divides_work:
            raise ValueError(
                f"scaling: allows up to {self.scaling.most} replicas, each of which would publish "
                "every output; allow only one replica, or set 'dividesWork: true' if the program "
                "divides its work"
            )
        return self


class OwnService(Deployed):
    """A service of one appdef.

    ``inputs`` maps each input to its origin: a role of the appdef, or ``<service>.<output>``. A
    role that only ``each`` names becomes an input, too.
    """

    inputs: dict[Word, str] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _consistent(self) -> OwnService:
        if self.placement == "source" and not self.each:
            raise ValueError(
                "'placement: source' needs 'each: <input>', because a service without 'each' runs "
                "once for the application, which has no single source"
            )
        if self.placement == "source" and self.place:
            raise ValueError("'place' and 'placement: source' both choose the node; keep one")
        return self


class ServiceDefinition(Deployed, FileModel):
    """A service that several appdefs may use: ``appdefs/<name>/service.yaml``."""

    kind: Literal["ServiceDefinition"]
    name: DnsLabel
    scope: Scope
    inputs: dict[Word, Input] = Field(default_factory=dict)
    parameters: dict[Word, Parameter] = Field(default_factory=dict)
    nodes: dict[DnsLabel, NodeId] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _consistent(self) -> ServiceDefinition:
        if bool(self.nodes) is not (self.scope == "cluster"):
            raise ValueError(
                "scope 'cluster' needs 'nodes' (the service's node in each cluster), and no other "
                "scope may have 'nodes'"
            )
        if self.placement == "source" and self.scope == "cluster":
            raise ValueError(
                "with scope 'cluster' the service runs on the nodes in 'nodes'; leave out "
                "'placement'"
            )
        if (self.each is None) is (self.scope == "topic"):
            raise ValueError("scope 'topic' needs 'each', and no other scope may have 'each'")
        if self.each and self.each not in self.inputs:
            hint = suggestion(self.each, self.inputs)
            raise ValueError(f"each: '{self.each}' is not an input{hint}")
        if self.placement == "source" and self.scope == "application":
            raise ValueError("placement 'source' needs the scope 'topic' or 'node'")
        if self.place and self.scope != "application":
            raise ValueError(
                "'place' needs the scope 'application', because with any other scope one "
                "instance serves several applications, which could need different nodes"
            )
        if problems := [*size_problems(self.scaling, self.parameters)]:
            raise ValueError(sentences(problems))
        return self


def size_problems(scaling: Scaling, parameters: Mapping[str, Parameter]) -> Iterator[str]:
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
            f"{place}: '{name}' has 'merge: {parameter.merge}' and so compares numbers, but sizes "
            "are words; use 'merge: union', with which the largest demanded size counts"
        )
    if sizes.replicas_for(parameter.default) is None:
        default = strict_yaml.short_repr(parameter.default)
        hint = suggestion(str(parameter.default), sizes.replicas)
        yield f"{place}: '{name}' has the default {default}, which is not a size{hint}"


# ---- applications as people define them: ``appdefs/<name>/appdef.yaml`` ----

# What happens if demands that share an application or a service ask for different versions.
# `refuse`: the later demand is refused. `separate`: a version other than the default runs in an
# instance of its own (`decide.admission.completing`). `update`: the newest version runs,
# but a person must approve a change of the major version. `upgrade`: the newest version runs, even
# if the major version changes.
VersionPolicy = Literal["refuse", "separate", "update", "upgrade"]


class WireNames(CamelModel):
    """How the reference's ``DeploymentRequest`` names applications of this appdef."""

    type: Annotated[int, Field(ge=1, le=255)]
    inputs: dict[Literal["ego_data_topics", "pointcloud_topics"], Word]


class ApplicationDefinition(FileModel):
    """One type of application: ``appdefs/<name>/appdef.yaml``."""

    kind: Literal["ApplicationDefinition"]
    name: DnsLabel
    description: Text = ""
    inputs: dict[Word, Input]
    parameters: dict[Word, Parameter] = Field(default_factory=dict)
    deployment_request: WireNames | None = None
    uses: dict[DnsLabel, dict[Word, str]] = Field(default_factory=dict)
    services: dict[DnsLabel, OwnService] = Field(default_factory=dict)
    approval: base_model.Approval = "none"
    versions: VersionPolicy = "refuse"

    @model_validator(mode="after")
    def _consistent(self) -> ApplicationDefinition:
        problems = [
            f"deploymentRequest.inputs: '{role}' is not an input{suggestion(role, self.inputs)}"
            for role in (self.deployment_request.inputs if self.deployment_request else {}).values()
            if role not in self.inputs
        ]
        problems += [
            f"uses.{name}: 'services' defines a service of this name too; rename that service"
            for name in self.uses
            if name in self.services
        ]
        problems += [
            f"services.{name}.{problem}"
            for name, service in self.services.items()
            for problem in size_problems(service.scaling, self.parameters)
        ]
        if not self.services and not self.uses:
            problems.append(
                "services: is empty; define a service, or name a shared one under 'uses'"
            )
        if problems:
            raise ValueError(sentences(problems))
        return self


# ---- the services of an appdef, with the origins of their inputs ----


class Service(Deployed):
    """A service of one appdef, with the origins of its inputs."""

    name: str
    # The folder in `appdefs/` that has the service's definition
    folder: str
    shared: bool
    scope: Scope
    at_source: bool
    values: str  # the path of its template
    # The origin of each input: a role of the appdef, or `<service>.<output>`
    inputs: dict[str, str]
    parameters: dict[str, Parameter]
    # What Kubernetes' scheduler can count of `requests`, by its own names
    pod_requests: dict[str, str] = Field(default_factory=dict)
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
    def is_movable(self) -> bool:
        return not self.at_source and not self.nodes

    @property
    def is_placeable(self) -> bool:
        # What several appdefs share is not placed: a demand could be refused because of a node that
        # somebody else's demand had chosen.
        return self.scope == "application" or not (self.shared or self.at_source)

    @property
    def file(self) -> str:
        return f"appdefs/{self.folder}/{'service' if self.shared else 'appdef'}.yaml"


# All services of an appdef, by name: those that it defines, and the shared ones that it uses
Services: TypeAlias = "Mapping[str, Service]"


def named_outputs(services: Services) -> list[str]:  # as `<service>.<output>`
    return [f"{each.name}.{output}" for each in services.values() for output in each.outputs]


# The path of a field of an appdef, and a message about the field
Problem: TypeAlias = "tuple[str, str]"


def resolved_services(  # noqa: PLR0912 - a branch for each fault
    appdef: ApplicationDefinition, definitions: Mapping[str, ServiceDefinition]
) -> tuple[Services, list[Problem]]:
    """Return all services of an appdef and no problem, or no service and the problems."""
    services = {
        name: Service.model_construct(
            # a role in `each` is an input, even if `inputs` lacks it
            **{
                **dict(own),
                "inputs": ({own.each: own.each} if own.each else {}) | own.inputs,
                "values": f"appdefs/{appdef.name}/{own.values}",
            },
            name=name,
            folder=appdef.name,
            shared=False,
            scope="topic" if own.each else "application",
            at_source=own.placement == "source",
            parameters=appdef.parameters,
        )
        for name, own in appdef.services.items()
    }
    for name, bound in appdef.uses.items():
        if name in definitions:
            used = definitions[name]
            services[name] = Service.model_construct(
                **{**dict(used), "inputs": bound, "values": f"appdefs/{name}/{used.values}"},
                folder=name,
                shared=True,
                at_source=used.placement == "source",
            )
    problems: list[Problem] = []
    for name, bound in appdef.uses.items():
        if name not in definitions:
            problem = f"appdefs/{name}/service.yaml does not exist; add it"
            problems.append((f"uses.{name}", problem + suggestion(name, definitions)))
            continue
        inputs = definitions[name].inputs
        for role in sorted(inputs.keys() - bound.keys()):
            problem = (
                "is missing; say where the input comes from: an input of this definition, or "
                "<service>.<output>"
            )
            problems.append((f"uses.{name}.{role}", problem))
        for role in sorted(bound.keys() - inputs.keys()):
            problem = f"'{name}' has no input '{role}'; leave it out{suggestion(role, inputs)}"
            problems.append((f"uses.{name}.{role}", problem))
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
            problems.append((_place(service, role), problem))
    if problems:  # the others are found only after a person has mended these
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


def _place(service: Service, role: str) -> str:
    if service.shared:
        return f"uses.{service.name}.{role}"
    of_each = role == service.each == service.inputs[role]
    return f"services.{service.name}.{'each' if of_each else f'inputs.{role}'}"


def _set_roots(name: str, services: dict[str, Service]) -> Iterator[Problem]:
    # after those of the services that it reads
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
