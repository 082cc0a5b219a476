"""Communication clients: each is a Deployment and a ConfigMap with the client's configuration.

Each type of connection has a module that makes the configuration. :mod:`.client_schema` checks it.
"""

from __future__ import annotations

from demandops.config.config import Config
from demandops.plan.release import Bridge, MqttEnd, RosEnd
from demandops.render.connections import mqtt, ros, zenoh
from demandops.render.engine import Engine


def render(release: MqttEnd | RosEnd | Bridge, config: Config, engine: Engine) -> str:
    """Return the manifests of a client as one YAML text.

    Raises:
        InvalidInput: if its configuration has a field that the client does not read.
        Refused: if the registry has no image for the client.
    """
    if isinstance(release, MqttEnd):
        return mqtt.render(release, config, engine)
    if isinstance(release, RosEnd):
        return ros.render(release, config, engine)
    return zenoh.render(release, config, engine)
