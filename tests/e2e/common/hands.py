"""What a person may change in a cluster by hand, and how a test sees that it is restored."""

from __future__ import annotations

from typing import Any

from .domain import Domain

_IMAGE = "example.invalid/other:1"


def pod_template(domain: Domain, deployment: str) -> dict[str, Any]:
    template: dict[str, Any] = domain.get("Deployment", deployment)["spec"]["template"]
    return template


def change_image(domain: Domain, deployment: str) -> None:
    containers = pod_template(domain, deployment)["spec"]["containers"]
    containers[0]["image"] = _IMAGE
    body = {"spec": {"template": {"spec": {"containers": containers}}}}
    domain.kube.patch("Deployment", deployment, body, domain.namespace)


def overwrite(domain: Domain, config: str, key: str) -> None:
    domain.kube.patch("ConfigMap", config, {"data": {key: "by hand"}}, domain.namespace)


def wait_restored(
    domain: Domain, template: dict[str, Any], data: dict[str, str], *names: str
) -> None:
    """Wait until a Deployment and a ConfigMap, of these names, are as they were."""
    deployment, config = names
    domain.kube.wait("the image", lambda: pod_template(domain, deployment) == template)
    domain.kube.wait("the content", lambda: domain.get("ConfigMap", config)["data"] == data)
