"""Changes that a test makes to a cluster by hand, and a goal with chosen requesters."""

from __future__ import annotations

from typing import Any

from .namespace import Namespace


def requested_by(vehicle: str, goal: dict[str, Any]) -> dict[str, Any]:
    """Return a copy of the goal whose requesters are ``vehicle`` and station00."""
    requesters = {"requester_ids": [vehicle, "station00"]}
    apps = [
        app | {"object_detection_fusion_app": app["object_detection_fusion_app"] | requesters}
        for app in goal["apps"]
    ]
    connections = [connection | requesters for connection in goal["connections"]]
    return goal | {"apps": apps, "connections": connections}


def pod_template(namespace: Namespace, deployment: str) -> dict[str, Any]:
    template: dict[str, Any] = namespace.get("Deployment", deployment)["spec"]["template"]
    return template


def change_image(namespace: Namespace, deployment: str) -> None:
    containers = pod_template(namespace, deployment)["spec"]["containers"]
    containers[0]["image"] = "example.invalid/other:1"
    body = {"spec": {"template": {"spec": {"containers": containers}}}}
    namespace.kube.patch("Deployment", deployment, body, namespace.namespace)
    changed = pod_template(namespace, deployment)["spec"]["containers"][0]["image"]
    assert changed == "example.invalid/other:1"


def overwrite(namespace: Namespace, config: str, key: str) -> None:
    """Overwrite the only entry of a ConfigMap."""
    namespace.kube.patch("ConfigMap", config, {"data": {key: "by hand"}}, namespace.namespace)
    assert namespace.get("ConfigMap", config)["data"] == {key: "by hand"}


def wait_restored(
    namespace: Namespace, template: dict[str, Any], data: dict[str, str], *names: str
) -> None:
    """Wait until a Deployment has `template` again and a ConfigMap has `data` again.

    `names` are the names of the Deployment and the ConfigMap.
    """
    deployment, config = names
    namespace.kube.wait("the image", lambda: pod_template(namespace, deployment) == template)
    namespace.kube.wait("the content", lambda: namespace.get("ConfigMap", config)["data"] == data)
