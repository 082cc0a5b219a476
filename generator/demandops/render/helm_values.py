"""The Helm values of a service: what its template renders to, checked against the chart.

The variables that the template gets are the interface of application definitions
(docs/appdef.md). Requesters are not among these variables.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from demandops.config.config import Config
from demandops.errors import InvalidInput
from demandops.plan.release import ServiceRelease
from demandops.templating.values import Evaluate, ValuesTask


def values_of(release: ServiceRelease, config: Config, evaluate: Evaluate) -> dict[str, Any]:
    """Return the Helm values of a service, with the patches of overrides merged in.

    Raises:
        InvalidInput: if the template fails, the values do not match the chart's schema, the schema
            is not valid, or an override sets the replicas of an autoscaled service to 0. The error
            names the template, the schema or the override.
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
