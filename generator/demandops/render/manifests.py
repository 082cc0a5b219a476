"""The text of a release: the values of its chart, or the Deployment of a communication client."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from typing import Any

from demandops.base.errors import InvalidInput, Refused
from demandops.connections.connection import UNSUPPORTED, Client
from demandops.model.config.config import IMAGES_FILE, Config
from demandops.model.release import Release, ServiceRelease
from demandops.render import gitops
from demandops.templating import engine
from demandops.templating.values import Evaluate, ValuesTask

# ---- the Helm values of a service: what its template renders to, checked against the chart ----
#
# The variables that the template gets are the interface of application definitions
# (docs/appdef.md). Requesters are not among these variables.


def values_of(release: ServiceRelease, config: Config, evaluate: Evaluate) -> dict[str, Any]:
    """Return the Helm values of a service, with the patches of overrides merged in.

    InvalidInput names the template, the schema or the override at fault.
    """
    template = config.values_template(release.service)
    if release.autoscaler and release.autoscaler.max == 0:
        by = [each.path for each, effects in release.shaping.by if "replicas" in effects]
        # seen on a cluster: the 0 stayed when the override ended, as no autoscaler starts from 0
        message = (
            "is 0, but an autoscaler keeps at least one replica; to run none, use 'deny' instead"
        )
        raise InvalidInput.at("replicas", message, file=by[-1])
    task = ValuesTask(
        template, _variables(release, config), release.chart.folder, tuple(release.shaping.patches)
    )
    try:
        return evaluate(config.files, task)
    except InvalidInput as error:
        changing = {"version", "images", "replicas", "node"}
        files = [override.path for override, effects in release.shaping.by if changing & {*effects}]
        if not files:
            raise
        note = f" (overrides change what the template gets, so check {' and '.join(files)} too)"
        faults = (
            replace(fault, message=fault.message + note) if fault.file == template else fault
            for fault in error.faults
        )
        raise type(error)(faults) from None


def _variables(release: ServiceRelease, config: Config) -> dict[str, object]:
    node = release.node
    variables: dict[str, object] = {
        "release": release.name,
        "service": release.key.service,
        "node": {
            "id": node.id,
            "selector": node.labels(),
            "tolerations": [item.model_dump(exclude_defaults=True) for item in node.tolerations],
            "image_pull_secrets": list(node.image_pull_secrets),
            "host_network": node.host_network,
            "ros": {
                "domain_id": node.ros.domain_id,
                "rmw": "" if node.ros.rmw == "image" else node.ros.rmw,
            },
        },
        "inputs": {
            role: [
                {"topic": topic.topic, "source": topic.source, "type": topic.type}
                for topic in topics
            ]
            for role, topics in release.inputs.items()
        },
        "topics": {
            role: list(dict.fromkeys(topic.topic for topic in topics))
            for role, topics in release.inputs.items()
        },
        "outputs": dict(release.outputs),
        "parameters": dict(release.parameters),
        "requests": dict(release.service.requests),
        "images": {name: release.image(name, config).parts() for name in release.service.images},
    }
    # Never both. A template that knows only ``replicas`` must fail, because the GitOps controller
    # would set back what the autoscaler writes.
    if release.autoscaler:
        variables["autoscaler"] = release.autoscaler.values()
    else:
        variables["replicas"] = release.replicas
    if release.key.application is not None:
        variables["application"] = release.key.application
    elif release.key.source is not None:
        variables |= {"source": release.key.source, "source_topic": release.key.topic}
    return variables


# ---- the file of a communication client: a Deployment, and a ConfigMap with its configuration ----
#
# Each connection type has a template and a schema in ``templates/connections/<type>/``. The schema
# lists the fields that the client program reads; tests compare configurations with it.


def render_connection(client: Client, config: Config) -> str:
    """Return the manifests of a client as one YAML text.

    Raises:
        InvalidInput: if an override's patch gives no valid settings.
        Refused: if the registry has no image for the client.
    """
    kind, node = client.type, client.node
    if kind.image not in config.images:
        message = (
            f"'{kind.image}' is in use, but not in {config.place_of(IMAGES_FILE)}; add it there"
        )
        raise Refused.at("images", message, code=UNSUPPORTED)
    configuration, settings = client.configuration(), client.settings(config)
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


# ---- the manifests of the state repo, for the controller that ``demandops.yaml`` names ----
#
# A service's Helm values and the plain manifests of connections are the same for Flux and Argo CD.


def render(release: Release, config: Config, evaluate: Evaluate) -> str:
    """Return the manifests of a release as text; raise Refused or InvalidInput if not possible."""
    if not isinstance(release, ServiceRelease):
        return render_connection(release, config)
    values = values_of(release, config, evaluate)
    if config.repo_settings.gitops == "argocd":
        return gitops.argocd_manifests(release, values, config.repo_settings)
    return gitops.flux_manifests(release, values)


def base_files(config: Config) -> dict[str, str]:
    # Each access domain of a cluster has a placeholder file, because Git keeps no empty folder.
    # Without the folder, Flux and Argo CD would fail instead of removing what is not demanded.
    if config.repo_settings.gitops == "argocd":
        return gitops.argocd_base_files(config)
    return gitops.flux_base_files(config)
