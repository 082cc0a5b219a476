"""One type of application, as people define it: `appdefs/<name>/appdef.yaml`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from demandops.config.appdef.service_definition import Input, OwnService, Parameter, size_problems
from demandops.config.base_model import Approval, CamelModel, DnsLabel, FileModel, Text, Word
from demandops.errors import sentences, suggestion

# What happens if demands that share an application or a service ask for different versions.
# `refuse`: the later demand is refused. `separate`: a version other than the default runs in an
# instance of its own (`demandops.demand.separate_instance`). `update`: the newest version runs, but
# a person must approve a change of the major version. `upgrade`: the newest version runs, even if
# the major version changes.
VersionPolicy = Literal["refuse", "separate", "update", "upgrade"]


class WireNames(CamelModel):
    """How the reference's ``DeploymentRequest`` names applications of this appdef.

    ``type`` is the number that stands for this appdef in the field ``Application.type``. ``inputs``
    maps a topic list in the message to the input of the appdef that gets these topics.
    """

    type: Annotated[int, Field(ge=1, le=255)]
    inputs: dict[Literal["ego_data_topics", "pointcloud_topics"], Word]


class ApplicationDefinition(FileModel):
    """One type of application: ``appdefs/<name>/appdef.yaml``.

    ``uses`` lists the shared services, and where each input of a shared service comes from.
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
