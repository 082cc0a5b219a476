"""Watches of clusters: a cache of their objects, which never waits, and the data of a ConfigMap."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from demandops.base.errors import InvalidInput
from demandops.base.quoting import one_line
from demandops.base.runtime import REAL, Runtime, log
from demandops.cluster.clusters_file import ClusterAccess, own_cluster_api, reason_of
from demandops.cluster.health import ClusterDomain, Health, Key, ObjectSelector, health_reader

_APIS = {
    "Kustomization": ("kustomize.toolkit.fluxcd.io", "v1", "kustomizations"),
    "GitRepository": ("source.toolkit.fluxcd.io", "v1", "gitrepositories"),
    "HelmRelease": ("helm.toolkit.fluxcd.io", "v2", "helmreleases"),
    "Application": ("argoproj.io", "v1alpha1", "applications"),
    "Deployment": ("apps", "v1", "deployments"),
}
_KINDS = {
    kind: dict(zip(("group", "version", "plural"), api, strict=True)) for kind, api in _APIS.items()
}
# A watch ends by itself and begins again: one whose connection died without a sign would never end.
WATCH_S = 240
CONNECT_S = 5
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 15.0


def keep_watching(
    api: Callable[[], Callable[..., Any]],
    request: Mapping[str, str],
    read: Callable[[], str],
    take: Callable[[str, Any], None],
    tell: Callable[[Exception], None],
    closed: Any,  # noqa: ANN401 - an event of a runtime
) -> None:
    """Watch objects until ``closed``; if that fails, tell why and begin again.

    ``api`` gives the library's function that lists them by ``request``. ``read`` lists them and
    returns the version of the list, and ``take`` gets each change after it, with the object.
    """
    pause = _FIRST_PAUSE_S
    while not closed.is_set():
        try:
            from kubernetes import watch  # noqa: PLC0415 - slow (half a second), so only on use

            for event in watch.Watch().stream(
                api(),
                **request,
                resource_version=read(),
                timeout_seconds=WATCH_S,
                _request_timeout=(CONNECT_S, WATCH_S + 30),
            ):
                if closed.is_set():
                    return
                if event["type"] in ("ADDED", "MODIFIED", "DELETED"):
                    take(event["type"], event["object"])
            pause = _FIRST_PAUSE_S
        except Exception as error:  # the library raises errors of many kinds
            tell(error)
            closed.wait(pause)
            pause = min(pause * 2, _LONGEST_PAUSE_S)


# ---- the cache of what Flux or Argo CD and their releases are doing ----


class ObjectCache:
    def __init__(
        self,
        name: str,
        access: ClusterAccess,
        on_change: Callable[[], None],
        runtime: Runtime = REAL,
    ) -> None:
        self._name, self._runtime = name, runtime
        self._access = access
        self._on_change = on_change
        self._lock = runtime.lock()
        self._objects: dict[Key, dict[str, Any]] = {}
        self._watched: set[ObjectSelector] = set()
        self._known: set[ObjectSelector] = set()
        self._errors: dict[ObjectSelector, str] = {}
        self._unread = "some objects have not been read yet"
        self.unread_since = ""  # when reading began to fail, while it fails
        self._closed = runtime.event()
        self._client: Any = None

    def watch(self, wanted: Iterable[ObjectSelector]) -> None:
        for selector in wanted:
            with self._lock:
                if selector in self._watched or self._closed.is_set():
                    continue
                self._watched.add(selector)
            name = f"watch-{self._name}-{selector.kind}"
            self._runtime.keep_running(name, partial(self._keep_watching, selector))

    def objects(self) -> dict[Key, dict[str, Any]]:
        with self._lock:
            return dict(self._objects)

    def why_unknown(self, wanted: Iterable[ObjectSelector]) -> str:
        with self._lock:
            for selector in wanted:
                if selector in self._errors:
                    return self._errors[selector]
                if selector not in self._known:
                    return self._unread
        return ""

    def unknown_health(self, domain: ClusterDomain) -> Health | None:
        reason = self.why_unknown(health_reader(domain).objects_to_watch(domain))
        if not reason:
            return None
        return Health("waiting", f"cannot be read: {reason}", f"cluster {self._name}")

    def read_once(self, wanted: Iterable[ObjectSelector]) -> None:
        """Read objects once, without a watch. If that fails, :meth:`why_unknown` says why."""
        selectors = list(wanted)
        for selector in selectors:
            try:
                self.refresh([selector])
            except Exception as error:
                if not _is_answer(error):  # the cluster does not answer, so do not ask again
                    self._errors |= dict.fromkeys(selectors, _reason(selector, error))
                    return
                self._errors[selector] = _reason(selector, error)

    def give_up(self, reason: str) -> None:
        """Have :meth:`why_unknown` return ``reason`` for objects that have not been read yet."""
        with self._lock:
            self._unread = reason

    def refresh(self, wanted: Iterable[ObjectSelector]) -> None:
        # one after the other, because watches lag behind each other: the objects that the caller
        # names last are then the newest
        for selector in wanted:
            self._read(selector)

    def why_unavailable(self, namespace: str, deployment: str) -> str:
        # by its pods, which no watch follows
        from kubernetes import client  # noqa: PLC0415 - slow (half a second), so only on use

        item = self.objects().get(("Deployment", namespace, deployment)) or {}
        labels = ((item.get("spec") or {}).get("selector") or {}).get("matchLabels") or {}
        if not labels:  # an empty selector would select all pods of the namespace
            return ""
        listed = client.CoreV1Api(self._api().api_client).list_namespaced_pod(
            namespace,
            label_selector=",".join(f"{key}={value}" for key, value in labels.items()),
            _request_timeout=(CONNECT_S, CONNECT_S),
        )
        for pod in listed.items:
            for container in pod.status.container_statuses or ():
                waiting = container.state.waiting if container.state else None
                if waiting and waiting.reason not in (None, "ContainerCreating"):
                    message = f": {waiting.message}" if waiting.message else ""
                    return f"container {container.name}: {waiting.reason}{message}"
            for reported in pod.status.conditions or ():
                if reported.type == "PodScheduled" and reported.status == "False":
                    return f"not scheduled: {reported.message}"
        return ""

    def close(self) -> None:
        self._closed.set()

    def annotate(self, selector: ObjectSelector, annotations: Mapping[str, str]) -> None:
        try:
            self._api().patch_namespaced_custom_object(
                **_KINDS[selector.kind],
                namespace=selector.namespace,
                name=selector.name,
                body={"metadata": {"annotations": annotations}},
                _request_timeout=CONNECT_S,
            )
        except Exception:
            with self._lock:
                self._client = None  # the kubeconfig may have a new token
            raise

    def _keep_watching(self, selector: ObjectSelector) -> None:
        def read() -> str:
            version = self._read(selector)
            self._set_error(selector, "")
            return version

        def take(change: str, item: dict[str, Any]) -> None:
            key = (selector.kind, selector.namespace, item["metadata"]["name"])
            with self._lock:
                cached = self._objects.get(key)
                if cached is not None and _version(item) < _version(cached):
                    return  # `refresh` has read a newer version
                if change == "DELETED":
                    self._objects.pop(key, None)
                else:
                    self._objects[key] = item
            self._on_change()

        keep_watching(
            lambda: self._api().list_namespaced_custom_object,
            _request(selector),
            read,
            take,
            lambda error: self._set_error(selector, _reason(selector, error)),
            self._closed,
        )

    def _api(self) -> Any:  # noqa: ANN401 - the library has no types
        with self._lock:
            if self._client is None:
                self._client = self._access.api()
            return self._client

    def _read(self, selector: ObjectSelector) -> str:
        # the result is the resource version of the list
        listed = self._api().list_namespaced_custom_object(
            **_request(selector), _request_timeout=(CONNECT_S, WATCH_S)
        )
        kind, namespace, name = selector
        with self._lock:
            # what is gone since the last list, or was deleted between two watches, goes here too
            for key in list(self._objects):
                if key[:2] == (kind, namespace) and name in ("", key[2]):
                    del self._objects[key]
            for item in listed["items"]:
                self._objects[kind, namespace, item["metadata"]["name"]] = item
            self._known.add(selector)
        return str(listed["metadata"]["resourceVersion"])

    def _set_error(self, selector: ObjectSelector, reason: str) -> None:
        with self._lock:
            is_new = reason and reason not in self._errors.values()
            if reason:
                self.unread_since = self.unread_since or self._runtime.now().isoformat()
                self._errors[selector] = reason
            elif self._errors.pop(selector, None) and not self._errors:
                self.unread_since = ""
        if is_new:
            log.warning("cluster '%s' cannot be read (%s); retrying", self._name, reason)
        self._on_change()


def object_caches(
    clusters: Mapping[str, ClusterAccess], on_change: Callable[[], None], runtime: Runtime
) -> dict[str, ObjectCache]:
    readable = {name: access for name, access in clusters.items() if access.kubeconfig}
    return {name: ObjectCache(name, readable[name], on_change, runtime) for name in readable}


def _request(selector: ObjectSelector) -> dict[str, str]:
    request = {**_KINDS[selector.kind], "namespace": selector.namespace}
    if selector.name:  # a call for one object needs fewer rights than for a whole namespace
        request["field_selector"] = f"metadata.name={selector.name}"
    return request


def _is_answer(error: Exception) -> bool:
    # the library gives the HTTP status only of an error with which the cluster answered
    return bool(getattr(error, "status", None))


def _reason(selector: ObjectSelector, error: Exception) -> str:
    if _is_answer(error):  # otherwise the whole cluster is unreachable
        plural = _KINDS[selector.kind]["plural"]
        reason = getattr(error, "reason", None) or type(error).__name__
        return f"{plural} in {selector.namespace}: {reason}"
    return reason_of(error)


def _version(item: dict[str, Any]) -> int:
    # Kubernetes calls it opaque, but all API servers count, within one kind of object at least.
    return int(item["metadata"]["resourceVersion"])


# ---- one ConfigMap: its data as soon as it exists, and when they change ----

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
