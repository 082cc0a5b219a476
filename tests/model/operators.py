"""A model of the bookkeeping of the reference's operators; it takes goals as YAML gives them.

It is written from `tests/fixtures/reference-run.yaml`, which records what the operators do, and
imports nothing of the program. The operators count the requesters of each topic of a fusion. They
count the requesters of a detection or a connection only as a whole.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

Goal = dict[str, Any]
_BODY = "object_detection_fusion_app"
_WHOLE = [""]


@dataclass
class Resource:
    """A custom resource with the requesters that its operator counts.

    The operator ``is_stuck`` while it fails on the resource, and afterwards counts nothing for
    a fusion.
    """

    spec: object
    is_stuck: bool
    is_uncounted: bool = False
    books: dict[str, list[str]] = field(default_factory=dict)


class Operators:
    def __init__(self) -> None:
        self._resources: dict[str, Resource] = {}

    def books(self) -> dict[str, list[str]]:
        """Return the sorted requesters by resource; for a fusion, by resource and topic."""
        return {
            f"{name} {topic}".strip(): sorted(who)
            for name, resource in self._resources.items()
            for topic, who in resource.books.items()
            if who
        }

    def take(self, goal: Goal) -> set[str]:
        """Count a goal; return the rows of docs/reference.md that explain differences."""
        leaves = goal.get("shutdown", False)
        found = set[str]()
        for app in goal.get("apps", []):
            found.update(self._application(app, leaves) if app["type"] == 1 else ())
        for one in goal.get("connections", []):
            ends = one["source_node_id"], one["target_node_id"]
            spec = ends, one["source_topics"], one["target_topics"]
            id, who = f"mqtt-connection-{one['id']}", one["requester_ids"]
            found.update(self._write(id, _WHOLE, who, leaves, spec) if one["type"] == 1 else ())
        return found

    def _application(self, app: Goal, leaves: bool) -> Iterator[str]:
        node, who = app["header"]["node_id"], app[_BODY]["requester_ids"]
        clouds = app[_BODY].get("pointcloud_topics", [])
        topics = [topic["topic_name"] for topic in app[_BODY].get("ego_data_topics", [])]
        topics += [f"/{cloud['source_node_id']}_local_objectlist" for cloud in clouds]
        last_of = {cloud["source_node_id"]: cloud["topic_name"] for cloud in clouds}
        for source, cloud in last_of.items():
            yield from self._write(f"od-{node}-{source}", _WHOLE, who, leaves, cloud)
        yield from self._write(f"of-{app['header']['id']}", topics, who, leaves, node)

    def _write(
        self, id: str, topics: list[str], who: list[str], leaves: bool, more: object
    ) -> Iterator[str]:
        name, spec = id.replace("_", "-").replace("/", "-"), (topics, who, leaves, more)
        resource = self._resources.get(name)
        if resource is None:
            resource = self._resources[name] = Resource(spec, is_stuck=leaves)
        elif resource.spec == spec:
            yield "same-as-last"
            return
        resource.spec = spec
        if resource.is_stuck:
            resource.is_stuck, resource.is_uncounted = leaves, topics is not _WHOLE
            yield "never-ran"
        if leaves and not resource.is_stuck and not resource.is_uncounted:
            yield from self._remove(resource, topics, who)
            if not any(resource.books.values()):
                del self._resources[name]
        elif not leaves and not resource.is_uncounted:
            for topic in topics:
                resource.books.setdefault(topic, []).extend(who)

    def _remove(self, resource: Resource, topics: list[str], who: list[str]) -> Iterator[str]:
        for one, topic in ((one, topic) for one in who for topic in topics):
            if one not in resource.books.get(topic, ()):
                yield "not-held"
                return
            resource.books[topic].remove(one)
            if not resource.books[topic]:
                del resource.books[topic]
