"""What a person might do to a cluster or demand once more, for tests that nothing comes of it."""

from __future__ import annotations

from typing import Any

from .namespace import Namespace


def asked_by(vehicle: str, goal: dict[str, Any]) -> dict[str, Any]:
    """The same applications and connections, demanded for somebody else."""
    requesters = {"requester_ids": [vehicle, "station00"]}
    apps = [
        app | {"object_detection_fusion_app": app["object_detection_fusion_app"] | requesters}
        for app in goal["apps"]
    ]
    connections = [connection | requesters for connection in goal["connections"]]
    return goal | {"apps": apps, "connections": connections}


def pod_template(namespace: Namespace, deployment: str) -> dict[str, Any]:
    """What a Deployment makes its pods from."""
    template: dict[str, Any] = namespace.get("Deployment", deployment)["spec"]["template"]
    return template


def change_image(namespace: Namespace, deployment: str) -> None:
    """Have a Deployment run something else."""
    containers = pod_template(namespace, deployment)["spec"]["containers"]
    containers[0]["image"] = "example.invalid/other:1"
    body = {"spec": {"template": {"spec": {"containers": containers}}}}
    namespace.kube.patch("Deployment", deployment, body, namespace.namespace)
    changed = pod_template(namespace, deployment)["spec"]["containers"][0]["image"]
    assert changed == "example.invalid/other:1"


def empty(namespace: Namespace, config: str, key: str) -> None:
    """Overwrite the only entry of a ConfigMap."""
    namespace.kube.patch("ConfigMap", config, {"data": {key: "by hand"}}, namespace.namespace)
    assert namespace.get("ConfigMap", config)["data"] == {key: "by hand"}


def wait_for(
    namespace: Namespace, template: dict[str, Any], data: dict[str, str], *names: str
) -> None:
    """Wait until a Deployment's pods and a ConfigMap's content are as they were."""
    deployment, config = names
    namespace.kube.wait("the image", lambda: pod_template(namespace, deployment) == template)
    namespace.kube.wait("the content", lambda: namespace.get("ConfigMap", config)["data"] == data)
