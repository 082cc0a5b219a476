"""The Helm values of a service: what its template renders to, checked against the chart.

The variables that the template gets are the interface of application definitions
(docs/appdef.md). Requesters are not among these variables.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from demandops.config.config import Config
from demandops.config.inventory import Node
from demandops.errors import Fault, InvalidInput
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
        message = (
            "is 0, but an autoscaler keeps at least one replica; to run none, use 'deny' instead"
        )
        raise InvalidInput.at("replicas", message, file=by[-1])
    task = ValuesTask(
        template, _context(release, config), release.chart.folder, tuple(release.shaping.patches)
    )
    try:
        return evaluate(config.files, task)
    except InvalidInput as error:
        raise type(error)(_name_overrides(error, release, template)) from None


def _name_overrides(error: InvalidInput, release: ServiceRelease, template: str) -> Iterable[Fault]:
    """Yield the faults of ``error``; those of the template also name overrides of its variables."""
    changing = {"version", "images", "replicas", "node"}
    files = [override.path for override, effects in release.shaping.by if changing & {*effects}]
    note = f" (overrides change what the template gets, so check {' and '.join(files)} too)"
    for fault in error.faults:
        is_shaped = files and fault.file == template
        yield replace(fault, message=fault.message + note) if is_shaped else fault


def _context(release: ServiceRelease, config: Config) -> dict[str, object]:
    context: dict[str, object] = {
        "release": release.name,
        "service": release.key.service,
        "node": _node(release.node),
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
    if release.autoscaler:
        context["autoscaler"] = release.autoscaler.values()
    else:
        context["replicas"] = release.replicas
    if release.key.application is not None:
        return context | {"application": release.key.application}
    if release.key.source is not None:
        context |= {"source": release.key.source, "source_topic": release.key.topic}
    return context


def _node(node: Node) -> dict[str, object]:
    rmw = "" if node.ros.rmw == "image" else node.ros.rmw
    return {
        "id": node.id,
        "selector": node.labels(),
        "tolerations": [item.model_dump(exclude_defaults=True) for item in node.tolerations],
        "image_pull_secrets": list(node.image_pull_secrets),
        "host_network": node.host_network,
        "ros": {"domain_id": node.ros.domain_id, "rmw": rmw},
    }
