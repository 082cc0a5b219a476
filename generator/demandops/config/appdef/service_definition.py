"""Services as people define them: services of one appdef, and services that several appdefs use."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, StringConstraints, model_validator

from demandops import strict_yaml
from demandops.config.appdef.scaling import Scaling
from demandops.config.base_model import CamelModel, DnsLabel, FileModel, Items, Text, Word
from demandops.config.inventory import LabelKey, LabelValue, NodeId, Resources
from demandops.config.node_property import PropertyName, RequiredValue
from demandops.errors import sentences, suggestion

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
    """Requirements on a service's node: its type, selector labels, capabilities and properties.

    ``properties`` maps the name of a property to the value that the property must have. For a
    number, there may be bounds instead of a value: ``{min: 8}``.
    """

    role: Word | Literal[""] = ""
    labels: dict[LabelKey, LabelValue] = Field(default_factory=dict)
    capabilities: Items[Word] = ()
    properties: dict[PropertyName, RequiredValue] = Field(default_factory=dict)


class Input(CamelModel):
    """An input, for example ``point_cloud``.

    A demand gives topics to an input of an appdef. An appdef says where an input of a shared
    service comes from.
    """

    description: Text = ""
    type: Text = ""


class Parameter(CamelModel):
    """A value that demands may set, and how the values of several demands are merged."""

    description: Text = ""
    default: Any = None
    merge: Literal["union", "max", "min", "latest"] | None = None


class Deployed(CamelModel):
    """How a service runs (the names, chart and values of its releases), and what it publishes.

    If ``each`` names an input, the service runs once for every topic of this input. ``place`` has
    the requirements on the node, if the generator chooses a node for the service
    (:mod:`demandops.plan.nodes.placement`). ``requests`` is how much of each resource a replica
    requests of its node (:mod:`demandops.plan.nodes.capacity`).
    """

    prefix: Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9]{0,9}$")]
    description: Text = ""
    each: Word | None = None
    outputs: dict[Word, TopicPattern] = Field(default_factory=dict)
    placement: Literal["application", "source"] = "application"
    place: Place | None = None
    scaling: Scaling = Scaling()
    requests: Resources = Field(default_factory=dict)
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

    ``inputs`` maps each input to its origin: a role of the appdef, or ``<service>.<output>``.
    ``each`` names one of these inputs, or a role of the appdef. Such a role becomes an input of the
    service.
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
    """A service that several appdefs may use: ``appdefs/<name>/service.yaml``.

    For the scope ``cluster``, ``nodes`` maps each cluster to the node where the service runs.
    """

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
    """Yield a message for each fault of the parameter that ``scaling.sizes`` names."""
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
