"""The file of a communication client: a Deployment, and a ConfigMap with its configuration.

Each connection type has a template and a schema in ``templates/connections/<type>/``. The schemas
are part of DemandOps and list the fields that each client program reads. A configuration is checked
against its schema, because an unknown field would otherwise be noticed only on the node, where the
program ignores the field or crashes.
"""

from __future__ import annotations

import hashlib
import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import jsonschema_rs

from demandops.config.config import IMAGES_FILE, Config
from demandops.connections.connection_type import UNSUPPORTED, Client
from demandops.errors import InvalidInput, Refused, fault, field_path
from demandops.settings import data_folder
from demandops.templating import engine


def render(client: Client, config: Config) -> str:
    """Return the manifests of a client as one YAML text.

    Raises:
        InvalidInput: if the configuration does not match the schema of the connection type, or if
            an override's patch gives no valid settings.
        Refused: if the registry has no image for the client.
    """
    kind, node = client.type, client.node
    if kind.image not in config.images:
        message = (
            f"'{kind.image}' is in use, but not in {config.place_of(IMAGES_FILE)}; add it there"
        )
        raise Refused.at("images", message, code=UNSUPPORTED)
    configuration, settings = client.configuration(), client.settings(config)
    check_configuration(kind.word, configuration, client.name)
    # A client reads these fields only at its start. Their checksum is an annotation of the pod, so
    # that a change of them restarts the pod, and a change of other fields does not.
    at_start = client.written(client.read_at_start(configuration))
    return engine.text(
        f"connections/{kind.word}/client.yaml.j2",
        client=client,
        configuration=client.written(configuration),
        checksum=hashlib.sha256(at_start.encode()).hexdigest(),
        node=node,
        selector=node.labels(),
        tolerations=[item.model_dump(exclude_defaults=True) for item in node.tolerations],
        settings=settings,
        env=client.environment(settings) | settings.env,
        probes={
            f"{name}Probe": probe
            for name in ("startup", "readiness", "liveness")
            if (probe := getattr(settings, f"{name}_probe"))
        },
        resources=settings.resources.model_dump(),
        host_network=node.host_network if settings.host_network is None else settings.host_network,
        image=client.shaping.image(kind.image, config.images[kind.image]).reference(),
    )


def check_configuration(kind: str, configuration: dict[str, Any], client: str) -> None:
    """Raise InvalidInput if fields do not match the schema: a mistake in DemandOps itself."""
    schema = data_folder("templates") / "connections" / kind / "schema.json"
    faults = [
        fault(field_path(tuple(error.instance_path)), error.message).within(f"{kind} of {client}")
        for error in _validator(schema).iter_errors(configuration)
    ]
    if faults:
        raise InvalidInput(faults)


@lru_cache(maxsize=8)
def _validator(schema: Path) -> Any:  # noqa: ANN401
    return jsonschema_rs.Draft7Validator(json.loads(schema.read_text()))
