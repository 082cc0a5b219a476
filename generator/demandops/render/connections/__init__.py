"""Communication clients: each a Deployment and a ConfigMap with the client's own configuration.

One module for each type of connection makes the configuration; :mod:`.schema` holds it against
what the client reads before anything is written.
"""

from __future__ import annotations

from demandops.config.config import Config
from demandops.plan.release import Bridge, MqttEnd, RosEnd
from demandops.render.connections import mqtt, ros, zenoh
from demandops.render.engine import Engine


def render(release: MqttEnd | RosEnd | Bridge, config: Config, engine: Engine) -> str:
    """Return the manifests of one client as one YAML text.

    Raises:
        InvalidInput: where its configuration has what the client does not read.
        Refused: where the registry has no image of the client.
    """
    if isinstance(release, MqttEnd):
        return mqtt.render(release, config, engine)
    if isinstance(release, RosEnd):
        return ros.render(release, config, engine)
    return zenoh.render(release, config, engine)
