"""Application definitions (appdefs): a YAML file and a folder define a type of application.

An appdef lists inputs, parameters and services. A service runs once for each application, or once
for each topic of an input. In the second case, all applications that demand the same topic on the
same node share it (paper, section on object detection).
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, StringConstraints, model_validator

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


class Input(CamelModel):
    """A role of demanded topics, for example ``point_cloud``."""

    description: Text = ""
    type: Text = ""


class Parameter(CamelModel):
    """A value that demands may set, and how the values of several demands are merged."""

    description: Text = ""
    default: Any = None
    merge: Literal["union", "max", "min", "latest"] | None = None


class Scaling(CamelModel):
    """The number of replicas: one for every ``topics_per_replica`` inputs, ``min`` to ``max``."""

    min: Annotated[int, Field(ge=0, le=1000)] = 1
    max: Annotated[int, Field(ge=1, le=1000)] = 1
    topics_per_replica: Positive | None = None

    @model_validator(mode="after")
    def _ordered(self) -> Scaling:
        if self.min > self.max:
            raise ValueError(f"min {self.min} is above max {self.max}; lower min or raise max")
        return self


class Service(CamelModel):
    """One deployable part of an application, with one Helm release for each instance.

    ``each`` names an input; every topic of it gets its own instance, which applications share.
    Without ``each``, every application gets one instance. Its ``inputs`` name roles of the appdef
    or ``<service>.<output>``.
    """

    prefix: Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9]{0,9}$")]
    description: Text = ""
    each: Word | None = None
    inputs: dict[Word, str] = Field(default_factory=dict)
    outputs: dict[Word, TopicPattern] = Field(default_factory=dict)
    placement: Literal["application", "source"] = "application"
    scaling: Scaling = Scaling()
    chart: DnsLabel
    images: Items[DnsLabel] = ()
    values: Annotated[str, StringConstraints(pattern=r"^values/[A-Za-z0-9_.-]+$")]

    @model_validator(mode="after")
    def _consistent(self) -> Service:
        if self.each and self.inputs:
            raise ValueError("'each' already names the service's input; remove 'inputs'")
        if self.placement == "source" and not self.each:
            raise ValueError("placement 'source' needs 'each': an application has no single source")
        return self


class WireNames(CamelModel):
    """The names of this application in the reference's ``DeploymentRequest``.

    ``type`` is the number in ``Application.type``. ``inputs`` maps the topic lists of the
    message's body to roles.
    """

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
    services: dict[DnsLabel, Service] = Field(min_length=1)
    approval: Approval = "none"

    @model_validator(mode="after")
    def _references(self) -> ApplicationDefinition:
        problems = []
        for name, service in self.services.items():
            if service.each and service.each not in self.inputs:
                problems.append(
                    f"services.{name}.each: '{service.each}' is not an input"
                    + suggestion(service.each, self.inputs)
                )
            sources = self.sources()
            problems += [
                f"services.{name}.inputs.{role}: '{source}' is neither an input nor an output of "
                "a service that runs for each topic" + suggestion(source, sources)
                for role, source in service.inputs.items()
                if source not in sources
            ]
        for role in (self.deployment_request.inputs if self.deployment_request else {}).values():
            if role not in self.inputs:
                problems.append(
                    f"deploymentRequest.inputs: '{role}' is not an input"
                    + suggestion(role, self.inputs)
                )
        if problems:
            raise ValueError("; ".join(problems))
        return self

    def sources(self) -> list[str]:
        """Return the sources that a service may name: roles, and outputs of per-topic services."""
        outputs = [
            f"{name}.{output}"
            for name, service in self.services.items()
            if service.each
            for output in service.outputs
        ]
        return [*self.inputs, *outputs]
