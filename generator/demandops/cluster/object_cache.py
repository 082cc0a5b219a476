"""A cluster's objects, kept current by watches: nothing is polled, and nobody waits for it."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable
from typing import Any

from demandops.cluster.access import ClusterAccess
from demandops.cluster.health import Key, ObjectSelector

log = logging.getLogger("demandops")

_KINDS = {
    "Kustomization": ("kustomize.toolkit.fluxcd.io", "v1", "kustomizations"),
    "GitRepository": ("source.toolkit.fluxcd.io", "v1", "gitrepositories"),
    "HelmRelease": ("helm.toolkit.fluxcd.io", "v2", "helmreleases"),
    "Application": ("argoproj.io", "v1alpha1", "applications"),
    "Deployment": ("apps", "v1", "deployments"),
}
_WATCH_S = 240
_CONNECT_S = 5
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 15.0


class ObjectCache:
    """Objects of one cluster: those that somebody asked to know.

    ``trouble`` says why some of them cannot be read at present; empty where all can.
    """

    def __init__(self, name: str, reached: ClusterAccess, on_change: Callable[[], None]) -> None:
        self.name = name
        self._reached = reached
        self._on_change = on_change
        self._lock = threading.Lock()
        self._objects: dict[Key, dict[str, Any]] = {}
        self._watched: set[ObjectSelector] = set()
        self._read: set[ObjectSelector] = set()
        self._troubles: dict[ObjectSelector, str] = {}
        self._closed = threading.Event()
        self._client: Any = None

    @property
    def read_error(self) -> str:
        """Why something that is watched cannot be read; empty where all can."""
        with self._lock:
            return next((self._troubles[one] for one in sorted(self._troubles)), "")

    def watch(self, wanted: Iterable[ObjectSelector]) -> None:
        """Watch further objects; those watched already stay so."""
        for one in wanted:
            with self._lock:
                if one in self._watched or self._closed.is_set():
                    continue
                self._watched.add(one)
            threading.Thread(
                target=self._follow,
                args=(one,),
                name=f"demandops-watch-{self.name}-{one.kind}",
                daemon=True,
            ).start()

    def objects(self) -> dict[Key, dict[str, Any]]:
        """Return what is there now."""
        with self._lock:
            return dict(self._objects)

    def why_unknown(self, wanted: Iterable[ObjectSelector]) -> str:
        """Return why what is wanted is not known at present; empty where it is."""
        with self._lock:
            for one in wanted:
                if one in self._troubles:
                    return self._troubles[one]
                if one not in self._read:
                    return "it was not read yet"
        return ""

    def read_once(self, wanted: Iterable[ObjectSelector]) -> None:
        """Read some objects once, without a watch; ``trouble`` says what went wrong."""
        everything = list(wanted)
        for one in everything:
            try:
                self._put(one, self._list(one)["items"])
            except Exception as error:
                if not _answered(error):  # the others would be waited for in vain
                    self._troubles |= dict.fromkeys(everything, _told(one, error))
                    return
                self._troubles[one] = _told(one, error)

    def refresh(self, wanted: Iterable[ObjectSelector]) -> None:
        """Read some objects anew, in this order: watches may lag behind each other.

        Raises:
            Exception: of the library, where the cluster does not answer.
        """
        for one in wanted:
            self._put(one, self._list(one)["items"])

    def why_unavailable(self, namespace: str, deployment: str) -> str:
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

    def _follow(self, watched: ObjectSelector) -> None:
        pause = _FIRST_PAUSE_S
        while not self._closed.is_set():
            try:
                self._list_and_watch(watched)
                pause = _FIRST_PAUSE_S
            except Exception as error:  # whatever the library meets on its way to the server
                self._say(watched, _told(watched, error))
                self._closed.wait(pause)
                pause = min(pause * 2, _LONGEST_PAUSE_S)

    def _list_and_watch(self, watched: ObjectSelector) -> None:
        from kubernetes import watch  # noqa: PLC0415 - half a second; only when used

        listed = self._list(watched)
        self._put(watched, listed["items"])
        self._say(watched, "")
        group, version, plural = _KINDS[watched.kind]
        watcher = watch.Watch()
        for event in watcher.stream(
            self._api().list_namespaced_custom_object,
            group,
            version,
            watched.namespace,
            plural,
            resource_version=listed["metadata"]["resourceVersion"],
            timeout_seconds=_WATCH_S,
            _request_timeout=(_CONNECT_S, _WATCH_S + 30),
            **_selected(watched),
        ):
            if self._closed.is_set():
                return
            self._take(watched, event)

    def _api(self) -> Any:  # noqa: ANN401 - the library has no types
        from kubernetes import client  # noqa: PLC0415 - half a second; only when used

        with self._lock:
            if self._client is None:
                self._client = client.CustomObjectsApi(self._reached.client())
            return self._client

    def _list(self, watched: ObjectSelector) -> Any:  # noqa: ANN401
        group, version, plural = _KINDS[watched.kind]
        return self._api().list_namespaced_custom_object(
            group,
            version,
            watched.namespace,
            plural,
            _request_timeout=(_CONNECT_S, _WATCH_S),
            **_selected(watched),
        )

    def _put(self, watched: ObjectSelector, items: Iterable[dict[str, Any]]) -> None:
        """Make what is watched what was listed."""
        kind, namespace, name = watched
        with self._lock:
            for key in list(self._objects):
                if key[:2] == (kind, namespace) and name in ("", key[2]):
                    del self._objects[key]
            for item in items:
                self._objects[kind, namespace, item["metadata"]["name"]] = item
            self._read.add(watched)

    def _take(self, watched: ObjectSelector, event: dict[str, Any]) -> None:
        item = event["object"]
        if event["type"] not in ("ADDED", "MODIFIED", "DELETED"):
            return
        key = (watched.kind, watched.namespace, item["metadata"]["name"])
        with self._lock:
            known = self._objects.get(key)
            if known is not None and _version(item) < _version(known):
                return  # what a refresh read is newer
            if event["type"] == "DELETED":
                self._objects.pop(key, None)
            else:
                self._objects[key] = item
        self._on_change()

    def _say(self, watched: ObjectSelector, trouble: str) -> None:
        with self._lock:
            told = trouble and trouble not in self._troubles.values()
            if trouble:
                self._troubles[watched] = trouble
            else:
                self._troubles.pop(watched, None)
        if told:
            log.warning("cluster '%s' cannot be read (%s); trying on", self.name, trouble)
        self._on_change()


def _selected(watched: ObjectSelector) -> dict[str, str]:
    """Return what narrows a request to one object, which a right to that one alone permits."""
    return {"field_selector": f"metadata.name={watched.name}"} if watched.name else {}


def _answered(error: Exception) -> bool:
    """Tell whether the cluster answered, if only to refuse."""
    return bool(getattr(error, "status", None))


def _told(watched: ObjectSelector, error: Exception) -> str:
    if _answered(error):  # it speaks of these objects; else it is the whole cluster that is away
        plural = _KINDS[watched.kind][2]
        reason = getattr(error, "reason", None) or type(error).__name__
        return f"{plural} in {watched.namespace}: {reason}"
    reason = f"{type(error).__name__}: {getattr(error, 'reason', None) or error}"
    return reason.splitlines()[0][:300]


def _version(item: dict[str, Any]) -> int:
    """Return an object's resource version; those of one kind can be compared."""
    return int(item["metadata"]["resourceVersion"])
