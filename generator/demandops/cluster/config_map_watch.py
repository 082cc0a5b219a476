"""Watches one ConfigMap, and passes on its data: as soon as it exists, and when the data change."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from demandops.base.errors import InvalidInput
from demandops.base.quoting import one_line
from demandops.base.runtime import REAL
from demandops.cluster.clusters_file import ClusterAccess, own_cluster_api
from demandops.cluster.object_cache import CONNECT_S, WATCH_S, keep_watching

log = logging.getLogger("demandops")

_GONE = "is gone; its last data stay valid"


class ConfigMapWatch:
    """Reads and watches a ConfigMap. It needs only the right to list and watch this object."""

    def __init__(
        self,
        namespace: str,
        name: str,
        on_data: Callable[[Mapping[str, str]], object],
        kubeconfig: Path | None,
    ) -> None:
        # ``on_data`` is called from the thread of the watch. The ConfigMap need not exist yet.
        # Without a kubeconfig, this process must be a pod in the cluster.
        self._name, self._on_data = f"ConfigMap {namespace}/{name}", on_data
        self._request = {"namespace": namespace, "field_selector": f"metadata.name={name}"}
        if kubeconfig is None:
            self._client = own_cluster_api("without --kubeconfig").api_client
        else:
            try:
                self._client = ClusterAccess(kubeconfig=kubeconfig).api().api_client
            except Exception as error:  # the library raises errors of many kinds
                reason = f"cannot be used: {one_line(str(error))}"
                raise InvalidInput.at("--kubeconfig", reason, file=str(kubeconfig)) from None
        self._data: dict[str, str] | None = None
        self._told = ""
        self._closed = REAL.event()
        # Held while this calls on_data or the log, which both may call ROS. After `close` ROS ends,
        # and a call of it from this thread would abort the process
        self._calling = REAL.lock()
        REAL.keep_running("config-map", self._run)

    def close(self) -> None:
        """Stop the watch; a call of ``on_data`` is waited for, and no other one follows."""
        with self._calling:
            self._closed.set()

    def _run(self) -> None:
        from kubernetes import client  # noqa: PLC0415 - slow (half a second), so only on use

        api = client.CoreV1Api(self._client).list_namespaced_config_map

        def read() -> str:
            listed = api(**self._request, _request_timeout=(CONNECT_S, WATCH_S))
            for item in listed.items:
                take("ADDED", item)
            if not listed.items:
                self._tell("does not exist yet" if self._data is None else _GONE)
            return str(listed.metadata.resource_version)

        def take(change: str, item: Any) -> None:  # noqa: ANN401 - the library has no types
            if change == "DELETED":
                self._tell(_GONE)
                return
            self._told = ""  # so that the next failure is logged again
            data = dict(item.data or {})
            with self._calling:
                if data != self._data and not self._closed.is_set():
                    self._data = data
                    self._on_data(data)

        def tell(error: Exception) -> None:
            reason = getattr(error, "reason", None) or error or type(error).__name__
            self._tell(f"cannot be read: {one_line(str(reason))[:300]}; retrying")

        keep_watching(lambda: api, self._request, read, take, tell, self._closed)

    def _tell(self, text: str) -> None:
        with self._calling:
            if text != self._told and not self._closed.is_set():
                self._told = text
                log.warning("%s %s", self._name, text)
