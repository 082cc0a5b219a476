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

log = logging.getLogger("demandops")

_WATCH_S = 240
_CONNECT_S = 5
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 15.0

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
        pause = _FIRST_PAUSE_S
        while not self._closed.is_set():
            try:
                from kubernetes import client, watch  # noqa: PLC0415 - slow (half a second)

                read = client.CoreV1Api(self._client).list_namespaced_config_map
                listed = read(**self._request, _request_timeout=(_CONNECT_S, _WATCH_S))
                for item in listed.items:
                    self._take(item)
                if not listed.items:
                    is_new = self._data is None
                    self._tell("does not exist yet" if is_new else _GONE)
                for event in watch.Watch().stream(
                    read,
                    **self._request,
                    resource_version=listed.metadata.resource_version,
                    timeout_seconds=_WATCH_S,
                    _request_timeout=(_CONNECT_S, _WATCH_S + 30),
                ):
                    if self._closed.is_set():
                        return
                    if event["type"] in ("ADDED", "MODIFIED"):
                        self._take(event["object"])
                    elif event["type"] == "DELETED":
                        self._tell(_GONE)
                pause = _FIRST_PAUSE_S
            except Exception as error:  # the library raises errors of many kinds
                reason = getattr(error, "reason", None) or error or type(error).__name__
                self._tell(f"cannot be read: {one_line(str(reason))[:300]}; retrying")
                self._closed.wait(pause)
                pause = min(pause * 2, _LONGEST_PAUSE_S)

    def _take(self, item: Any) -> None:  # noqa: ANN401 - the library has no types
        self._told = ""  # so that the next failure is logged again
        data = dict(item.data or {})
        with self._calling:
            if data != self._data and not self._closed.is_set():
                self._data = data
                self._on_data(data)

    def _tell(self, text: str) -> None:
        with self._calling:
            if text != self._told and not self._closed.is_set():
                self._told = text
                log.warning("%s %s", self._name, text)
