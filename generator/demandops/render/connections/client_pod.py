"""What the pods of all communication clients share: image, placement, checksum."""

from __future__ import annotations

import hashlib

from demandops.config.config import IMAGES_FILE, Config
from demandops.errors import Refused, fault
from demandops.plan.release import Bridge, MqttEnd, RosEnd


def context(release: MqttEnd | RosEnd | Bridge, image: str, config: Config) -> dict[str, object]:
    """Return the variables that every client's template needs.

    Raises:
        Refused: if the registry has no such image.
    """
    if image not in config.images:
        message = f"'{image}' is in use, but not in {IMAGES_FILE}; add it there"
        raise Refused([fault("images", message, code="unsupported-connection-type")])
    node = release.node
    return {
        "node": node,
        "selector": node.labels(),
        "tolerations": [item.model_dump(exclude_defaults=True) for item in node.tolerations],
        "image": release.shaping.image(image, config).reference(),
    }


def checksum(text: str) -> str:
    """Return a checksum for the pod template, so that a change of ``text`` restarts the pod."""
    return hashlib.sha256(text.encode()).hexdigest()
