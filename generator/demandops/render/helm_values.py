"""The Helm values of a service, from its appdef's template, held against the chart's schema.

What the template is given is the interface of application definitions (docs/applications.md).
Requesters are no part of it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from demandops.config.config import Config
from demandops.config.inventory import Node
from demandops.config.override import merge_patch
from demandops.errors import Fault, InvalidInput
from demandops.plan.release import ServiceRelease
from demandops.render.engine import Engine
from demandops.render.output_check import check_values


def values_of(release: ServiceRelease, config: Config, engine: Engine) -> dict[str, Any]:
    """Return what the chart of a service is installed with, overrides' patches laid over.

    Raises:
        InvalidInput: where the template fails, or the values break the chart's schema; it names
            the template or the override.
    """
    template = config.values_template(release.appdef, release.service)
    try:
        values = engine.data(template, **_context(release, config))
        check_values(values, release.chart, config, template)
    except InvalidInput as error:
        raise InvalidInput(_told_of_overrides(error, release)) from None
    for file, patch in release.shaping.patches:
        values = merge_patch(values, patch)
        check_values(values, release.chart, config, file)
    return values


def _told_of_overrides(error: InvalidInput, release: ServiceRelease) -> Iterable[Fault]:
    """Yield faults of a template, which may be an override's that gives it other things."""
    giving = {"version", "images", "replicas", "node"}
    files = [one.path for one, effects in release.shaping.by if giving & {*effects}]
    note = f" (it is given what {' and '.join(files)} say; it may be for those to mend)"
    for found in error.faults:
        yield replace(found, message=found.message + note) if files else found


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
        "outputs": dict(release.outputs),
        "parameters": dict(release.parameters),
        "images": {
            name: release.shaping.image(name, config).parts() for name in release.service.images
        },
        "replicas": release.replicas,
    }
    if release.key.application is not None:
        return context | {"application": release.key.application}
    return context | {"source": release.key.source, "source_topic": release.key.topic}


def _node(node: Node) -> dict[str, object]:
    return {
        "id": node.id,
        "selector": node.labels(),
        "tolerations": [item.model_dump(exclude_defaults=True) for item in node.tolerations],
        "image_pull_secrets": list(node.image_pull_secrets),
        "host_network": node.host_network,
        "ros": {"domain_id": node.ros.domain_id, "rmw": node.ros.rmw},
    }
