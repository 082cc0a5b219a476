"""Settings of communication clients: ``registry/clients.yaml``, which a state repo may leave out.

Overrides that select connections patch these settings, as others patch a service's Helm values.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, Field, StringConstraints, ValidationError

from demandops.config.base_model import (
    CamelModel,
    FileModel,
    FrozenModel,
    Items,
    Text,
    faults_of,
)
from demandops.config.inventory import Rmw
from demandops.config.override import merge_patch
from demandops.errors import InvalidInput

_EnvName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
_Quantity = Annotated[str, StringConstraints(pattern=r"^\d+(\.\d+)?(m|k|Ki|M|Mi|G|Gi)?$")]
_Resource = Annotated[str, StringConstraints(pattern=r"^[a-z0-9./-]+$")]
_LaunchFile = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_.-]+$")]
_Package = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]*$")]

_OF_NODES = ("ROS_DOMAIN_ID", "RMW_IMPLEMENTATION")


def _free(env: dict[str, str]) -> dict[str, str]:
    for name in _OF_NODES:
        if name in env:
            raise ValueError(f"{name} follows from ros of the node; set it in inventory/nodes.yaml")
    return env


class Resources(FrozenModel):
    """What a container requests, and its limits (Kubernetes core/v1 ResourceRequirements)."""

    requests: dict[_Resource, _Quantity] = Field(
        default_factory=lambda: {"cpu": "50m", "memory": "64Mi"}
    )
    limits: dict[_Resource, _Quantity] = Field(default_factory=lambda: {"memory": "256Mi"})


class ClientSettings(CamelModel):
    """How the containers of one connection type's clients run.

    ``host_network`` is that of the node if not given. A probe is a Kubernetes core/v1 Probe.
    """

    env: Annotated[dict[_EnvName, Text], AfterValidator(_free)] = Field(default_factory=dict)
    resources: Resources = Resources()
    host_network: bool | None = None
    startup_probe: dict[str, Any] = Field(default_factory=dict)
    readiness_probe: dict[str, Any] = Field(default_factory=dict)
    liveness_probe: dict[str, Any] = Field(default_factory=dict)


class MqttClientSettings(ClientSettings):
    """The settings of MQTT clients, which are ROS nodes.

    ``rmw`` is that of the node if not given; ``image`` leaves it to the image. ``messages`` are the
    packages whose messages the image can carry; if empty, that is not known.
    """

    launch_file: _LaunchFile = "standalone.launch.xml"
    rmw: Rmw | Literal["image"] | None = None
    messages: Items[_Package] = ()


class ClientsFile(FileModel):
    """``registry/clients.yaml``."""

    kind: Literal["Clients"] = "Clients"
    mqtt: MqttClientSettings = MqttClientSettings()
    zenoh: ClientSettings = ClientSettings()
    ros: ClientSettings = ClientSettings()

    def of(self, connection_type: str) -> ClientSettings:
        """Return the settings of a connection type, by its word in files."""
        known: ClientSettings = getattr(self, connection_type, ClientSettings())
        return known


DEFAULT_SETTINGS = ClientsFile(apiVersion="demandops/v1")

Settings = TypeVar("Settings", bound=ClientSettings)


def patched(settings: Settings, patch: Mapping[str, Any], file: str) -> Settings:
    """Return settings with the ``values`` of an override; fields of other types do not count.

    Raises:
        InvalidInput: if the result is not valid, naming the override's ``file``.
    """
    data = merge_patch(settings.model_dump(by_alias=True), patch)
    of_others = {*_fields(MqttClientSettings)} - {*_fields(type(settings))}
    try:
        return settings.model_validate({k: v for k, v in data.items() if k not in of_others})
    except ValidationError as error:
        raise InvalidInput(faults_of(error, type(settings), file, ("values",))) from None


def _fields(model: type[ClientSettings]) -> list[str]:
    return [str(field.alias) for field in model.model_fields.values()]
