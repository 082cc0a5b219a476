"""The Helm values of a service, from its appdef's template, held against the chart's schema.

What the template is given is the interface of application definitions (docs/applications.md).
Requesters are no part of it.
"""

from __future__ import annotations

from typing import Any

from generator.catalog.catalog import Catalog
from generator.catalog.inventory import Node
from generator.plan.release import ServiceRelease
from generator.render.check import check_values
from generator.render.engine import Engine


def values_of(release: ServiceRelease, catalog: Catalog, engine: Engine) -> dict[str, Any]:
    """Return what the chart of a service is installed with.

    Raises:
        InvalidInput: where the template fails or the values break the chart's schema.
    """
    template = catalog.values_template(release.appdef, release.service)
    values = engine.data(template, **_context(release, catalog))
    check_values(values, release.chart, catalog, template)
    return values


def _context(release: ServiceRelease, catalog: Catalog) -> dict[str, object]:
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
        "images": {name: catalog.images[name].parts() for name in release.service.images},
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
