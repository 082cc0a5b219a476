"""A cluster's objects, kept current by watches: nothing is polled, and nobody waits for it."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable
from typing import Any

from generator.cluster.access import Reached
from generator.cluster.health import Key

log = logging.getLogger("demandops")

_KINDS = {
    "Kustomization": ("kustomize.toolkit.fluxcd.io", "v1", "kustomizations"),
    "GitRepository": ("source.toolkit.fluxcd.io", "v1", "gitrepositories"),
    "HelmRelease": ("helm.toolkit.fluxcd.io", "v2", "helmreleases"),
    "Deployment": ("apps", "v1", "deployments"),
}
_WATCH_S = 240
_CONNECT_S = 5
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 15.0


class ClusterStore:
    """The objects of some namespaces of one cluster.

    ``trouble`` says why the cluster cannot be read at present; empty where it can.
    """

    def __init__(self, name: str, reached: Reached, on_change: Callable[[], None]) -> None:
        self.name = name
        self.trouble = "it was not read yet"
        self._reached = reached
        self._on_change = on_change
        self._lock = threading.Lock()
        self._objects: dict[Key, dict[str, Any]] = {}
        self._watched: set[str] = set()
        self._read: set[tuple[str, str]] = set()
        self._closed = threading.Event()
        self._client: Any = None

    def watch(self, namespaces: Iterable[str]) -> None:
        """Watch further namespaces; those watched already stay so."""
        for namespace in namespaces:
            with self._lock:
                if namespace in self._watched or self._closed.is_set():
                    continue
                self._watched.add(namespace)
            for kind in _KINDS:
                threading.Thread(
                    target=self._follow,
                    args=(kind, namespace),
                    name=f"demandops-watch-{self.name}-{kind}",
                    daemon=True,
                ).start()

    def objects(self) -> dict[Key, dict[str, Any]]:
        """Return what is there now."""
        with self._lock:
            return dict(self._objects)

    def knows(self, namespace: str) -> bool:
        """Tell whether a namespace has been read whole at least once."""
        with self._lock:
            return all((kind, namespace) in self._read for kind in _KINDS)

    def read(self, namespaces: Iterable[str]) -> None:
        """Read some namespaces once, without a watch; ``trouble`` says what went wrong."""
        try:
            for namespace in namespaces:
                for kind in _KINDS:
                    self._put(kind, namespace, self._list(kind, namespace)["items"])
            self.trouble = ""
        except Exception as error:
            self.trouble = _told(error)

    def refresh(self, namespace: str) -> None:
        """Read releases and then their Deployments anew: watches may lag behind each other.

        Raises:
            Exception: of the library, where the cluster does not answer.
        """
        for kind in ("HelmRelease", "Deployment"):
            self._put(kind, namespace, self._list(kind, namespace)["items"])

    def why_not_available(self, namespace: str, deployment: str) -> str:
        """Return what keeps a Deployment's pods from running, or nothing that is known.

        Raises:
            Exception: of the library, where the cluster does not answer.
        """
        from kubernetes import client  # noqa: PLC0415 - half a second; only when used

        found = self.objects().get(("Deployment", namespace, deployment)) or {}
        labels = ((found.get("spec") or {}).get("selector") or {}).get("matchLabels") or {}
        pods = client.CoreV1Api(self._api().api_client).list_namespaced_pod(
            namespace,
            label_selector=",".join(f"{key}={value}" for key, value in labels.items()),
            _request_timeout=(_CONNECT_S, _CONNECT_S),
        )
        for pod in pods.items:
            for container in pod.status.container_statuses or ():
                waiting = container.state.waiting if container.state else None
                if waiting and waiting.reason not in (None, "ContainerCreating"):
                    told = f": {waiting.message}" if waiting.message else ""
                    return f"container {container.name}: {waiting.reason}{told}"
            for condition in pod.status.conditions or ():
                if condition.type == "PodScheduled" and condition.status == "False":
                    return f"not scheduled: {condition.message}"
        return ""

    def close(self) -> None:
        """Watch no more."""
        self._closed.set()

    def _follow(self, kind: str, namespace: str) -> None:
        pause = _FIRST_PAUSE_S
        while not self._closed.is_set():
            try:
                self._list_and_watch(kind, namespace)
                pause = _FIRST_PAUSE_S
            except Exception as error:  # whatever the library meets on its way to the server
                self._say(_told(error))
                self._closed.wait(pause)
                pause = min(pause * 2, _LONGEST_PAUSE_S)

    def _list_and_watch(self, kind: str, namespace: str) -> None:
        from kubernetes import watch  # noqa: PLC0415 - half a second; only when used

        listed = self._list(kind, namespace)
        self._put(kind, namespace, listed["items"])
        self._say("")
        group, version, plural = _KINDS[kind]
        revision = listed["metadata"]["resourceVersion"]
        watcher = watch.Watch()
        for event in watcher.stream(
            self._api().list_namespaced_custom_object,
            group,
            version,
            namespace,
            plural,
            resource_version=revision,
            timeout_seconds=_WATCH_S,
            _request_timeout=(_CONNECT_S, _WATCH_S + 30),
        ):
            if self._closed.is_set():
                return
            self._take(kind, namespace, event)

    def _api(self) -> Any:  # noqa: ANN401 - the library has no types
        from kubernetes import client  # noqa: PLC0415 - half a second; only when used

        with self._lock:
            if self._client is None:
                self._client = client.CustomObjectsApi(self._reached.client())
            return self._client

    def _list(self, kind: str, namespace: str) -> Any:  # noqa: ANN401
        group, version, plural = _KINDS[kind]
        return self._api().list_namespaced_custom_object(
            group, version, namespace, plural, _request_timeout=(_CONNECT_S, _WATCH_S)
        )

    def _put(self, kind: str, namespace: str, items: Iterable[dict[str, Any]]) -> None:
        """Make the objects of a kind what was listed."""
        with self._lock:
            for key in [known for known in self._objects if known[:2] == (kind, namespace)]:
                del self._objects[key]
            for item in items:
                self._objects[kind, namespace, item["metadata"]["name"]] = item
            self._read.add((kind, namespace))

    def _take(self, kind: str, namespace: str, event: dict[str, Any]) -> None:
        item = event["object"]
        if event["type"] not in ("ADDED", "MODIFIED", "DELETED"):
            return
        key = (kind, namespace, item["metadata"]["name"])
        with self._lock:
            known = self._objects.get(key)
            if known is not None and _version(item) < _version(known):
                return  # what a refresh read is newer
            if event["type"] == "DELETED":
                self._objects.pop(key, None)
            else:
                self._objects[key] = item
        self._on_change()

    def _say(self, trouble: str) -> None:
        if trouble and trouble != self.trouble:
            log.warning("cluster '%s' cannot be read (%s); trying on", self.name, trouble)
        self.trouble = trouble
        self._on_change()


def _told(error: Exception) -> str:
    reason = f"{type(error).__name__}: {getattr(error, 'reason', None) or error}"
    return reason.splitlines()[0][:300]


def _version(item: dict[str, Any]) -> int:
    """Return an object's resource version; those of one kind can be compared."""
    return int(item["metadata"]["resourceVersion"])
