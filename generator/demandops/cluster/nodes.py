"""Watches of the nodes of clusters, of which the generator takes over what a decision can see."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

from demandops.base.quoting import one_line
from demandops.base.runtime import REAL, Runtime, log
from demandops.cluster.clusters_file import ClusterAccess, reason_of
from demandops.cluster.watches import CONNECT_S, WATCH_S, keep_watching
from demandops.decide.discovery import ClusterNode
from demandops.model.config.config import Config
from demandops.model.config.inventory import NODE_LABEL, Cluster, Discovery

# How many nodes one answer has; each lists its images, so that all together may be large
_PAGE = 500
# The status of a watch from a version that the API server no longer has
_GONE = 410


class ClusterNodes:
    """The nodes of all clusters; ``on_change`` is called from the threads of the watches."""

    def __init__(
        self,
        clusters: Mapping[str, ClusterAccess],
        on_change: Callable[[], object],
        runtime: Runtime = REAL,
    ) -> None:
        self._clusters = {name: each for name, each in clusters.items() if each.kubeconfig}
        self._on_change, self._runtime = on_change, runtime
        self._watches: dict[str, _NodeWatch] = {}
        self._unreachable: set[str] = set()

    def of(self, config: Config) -> dict[str, list[ClusterNode]]:
        """Return the nodes of each cluster that was read, and watch those that are asked for."""
        wanted = {name: _selector(c) for name, c in config.clusters.items() if c.nodes != "listed"}
        for name, watch in [*self._watches.items()]:
            if wanted.get(name) != watch.selector:
                self._watches.pop(name).close()
        for name in sorted(wanted.keys() - self._watches.keys()):
            if name in self._clusters:
                self._watches[name] = _NodeWatch(
                    name, wanted[name], self._clusters[name], self._on_change, self._runtime
                )
            elif name not in self._unreachable:
                self._unreachable.add(name)
                why = "but --clusters has no kubeconfig for it, so its nodes stay as they are"
                log.warning("cluster '%s' has 'nodes: from-cluster', %s", name, why)
        nodes = ((name, watch.nodes()) for name, watch in self._watches.items())
        return {name: known for name, known in nodes if known is not None}

    def close(self) -> None:
        for watch in self._watches.values():
            watch.close()


def _selector(cluster: Cluster) -> str:
    labels = (cluster.discovery or Discovery()).selector.items()
    return ",".join([NODE_LABEL, *(f"{key}={value}" for key, value in sorted(labels))])


class _NodeWatch:
    # Nodes report each few minutes that they live, and when they are ready. None of that is kept.
    def __init__(
        self,
        cluster: str,
        selector: str,
        access: ClusterAccess,
        on_change: Callable[[], object],
        runtime: Runtime,
    ) -> None:
        self.selector, self._cluster = selector, cluster
        self._access, self._on_change = access, on_change
        self._lock, self._closed = runtime.lock(), runtime.event()
        # as long as a list was never read to its end, no node is known, and none is missing
        self._nodes: dict[str, ClusterNode] | None = None
        # where the next watch goes on; without it, all nodes are listed again
        self._version = self._told = ""
        self._api: Callable[..., Any] | None = None
        runtime.keep_running(f"watch-{cluster}-nodes", self._run)

    def nodes(self) -> list[ClusterNode] | None:
        with self._lock:
            return None if self._nodes is None else list(self._nodes.values())

    def close(self) -> None:
        self._closed.set()

    def _run(self) -> None:
        request = {"label_selector": self.selector}
        keep_watching(self._lister, request, self._read, self._take, self._tell, self._closed)

    def _lister(self) -> Callable[..., Any]:
        if self._api is None:
            from kubernetes import client  # noqa: PLC0415 - slow (half a second), so only on use

            api = client.CoreV1Api(self._access.api().api_client)

            def list_node(**query: Any) -> Any:  # noqa: ANN401 - the library has no types
                # it has no type, so the library's watch makes no models of it, which takes long
                return api.list_node(**{**query, "_preload_content": False})

            self._api = list_node
        return self._api

    def _read(self) -> str:
        if self._version:
            return self._version
        nodes = dict[str, ClusterNode]()
        query = {"label_selector": self.selector, "limit": _PAGE}
        while True:
            answer = self._lister()(**query, _request_timeout=(CONNECT_S, WATCH_S))
            page = json.loads(answer.data)
            nodes |= {item["metadata"]["name"]: _node(item) for item in page["items"]}
            if not (following := page["metadata"].get("continue", "")):
                break
            query["_continue"] = following
        with self._lock:
            is_new, self._nodes = nodes != self._nodes, nodes
        self._version, self._told = str(page["metadata"]["resourceVersion"]), ""
        if is_new:
            self._on_change()
        return self._version

    def _take(self, change: str, item: dict[str, Any]) -> None:
        node = None if change == "DELETED" else _node(item)
        self._version = str(item["metadata"]["resourceVersion"])
        name = item["metadata"]["name"]
        with self._lock:
            assert self._nodes is not None  # noqa: S101 - a watch follows a list
            if self._nodes.get(name) == node:
                return
            if node is None:
                del self._nodes[name]
            else:
                self._nodes[name] = node
        self._on_change()

    def _tell(self, error: Exception) -> None:
        self._version, self._api = "", None  # the kubeconfig may have a new token
        if getattr(error, "status", None) == _GONE:  # nothing changed for long: list anew
            return
        if (reason := one_line(reason_of(error))) != self._told:
            self._told = reason
            message = "the nodes of cluster '%s' cannot be read (%s) and stay as they are; retrying"
            log.warning(message, self._cluster, reason)


def _node(item: Mapping[str, Any]) -> ClusterNode:
    metadata, writers = item["metadata"], dict[str, str]()
    for field in metadata.get("managedFields") or ():
        owned, writer = field.get("fieldsV1") or {}, str(field.get("manager", ""))
        labels = (owned.get("f:metadata") or {}).get("f:labels") or {}
        writers |= {key.removeprefix("f:"): writer for key in labels if writer}
        if "f:unschedulable" in (owned.get("f:spec") or {}) and writer:
            writers[""] = writer
    return ClusterNode(
        metadata["name"],
        metadata.get("labels") or {},
        (item.get("status") or {}).get("allocatable") or {},
        bool((item.get("spec") or {}).get("unschedulable")),
        writers,
    )
