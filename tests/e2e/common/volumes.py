"""The content of a pod's volumes, as a kubelet provides it."""

from __future__ import annotations

import base64
from typing import Any

from tests.e2e.rig.kube import Kube


def files(kube: Kube, namespace: str, account: str, volume: dict[str, Any]) -> dict[str, bytes]:
    """Return the content of a volume's files by name; raise LookupError if it is missing."""
    if secret := volume.get("secret"):
        data = _data(kube, "Secret", namespace, secret["secretName"])
        return {key: base64.b64decode(value) for key, value in data.items()}
    if config := volume.get("configMap"):
        return _texts(_data(kube, "ConfigMap", namespace, config["name"]))
    found: dict[str, bytes] = {}
    for source in volume.get("projected", {}).get("sources", ()):
        if wanted := source.get("serviceAccountToken"):
            found[wanted["path"]] = kube.token(account, namespace).encode()
        elif config := source.get("configMap"):
            data = _data(kube, "ConfigMap", namespace, config["name"])
            found |= _texts({item["path"]: data[item["key"]] for item in config["items"]})
        else:
            (item,) = source["downwardAPI"]["items"]
            assert item["fieldRef"]["fieldPath"] == "metadata.namespace"
            found[item["path"]] = namespace.encode()
    known = {"name", "emptyDir", "persistentVolumeClaim", "projected"}
    assert volume.keys() <= known, volume
    return found


def _texts(data: dict[str, str]) -> dict[str, bytes]:
    return {key: value.encode() for key, value in data.items()}


def _data(kube: Kube, kind: str, namespace: str, name: str) -> dict[str, str]:
    found = kube.get(kind, name, namespace)
    if found is None:
        raise LookupError(f"{kind} {namespace}/{name} does not exist")
    return dict(found.get("data") or {})
