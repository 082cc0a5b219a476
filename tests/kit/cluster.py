"""An API server with objects from a test; clients list, watch and annotate the objects."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import parse_qs, urlsplit

from tests.kit.http import Answer, Call, serving

Item = dict[str, Any]

_BEAT_S = 0.5


class KubeApi:
    """The objects of one cluster; a kind's plural name, a namespace and a name identify each."""

    def __init__(self) -> None:
        self.url = ""
        self.closed = False
        self.patches: list[tuple[str, Item]] = []
        """The path and the body of each patch."""
        self.reads = 0
        """How often objects were listed; what changes later is watched."""
        self._changed = threading.Condition()
        self._items: dict[tuple[str, str, str], Item] = {}
        self._log: list[tuple[str, str, Item, str]] = []

    def put(self, plural: str, namespace: str, name: str, status: Item, **more: Any) -> None:
        with self._changed:
            metadata = {"name": name, "namespace": namespace, "generation": 1}
            metadata |= more.pop("metadata", {})
            metadata["resourceVersion"] = str(len(self._log) + 1)
            item = {"metadata": metadata, "status": status, **more}
            self._items[plural, namespace, name] = item
            self._log.append((plural, namespace, item, "MODIFIED"))
            self._changed.notify_all()

    def delete(self, plural: str, namespace: str, name: str) -> None:
        with self._changed:
            item = self._items.pop((plural, namespace, name))
            metadata = item["metadata"] | {"resourceVersion": str(len(self._log) + 1)}
            self._log.append((plural, namespace, item | {"metadata": metadata}, "DELETED"))
            self._changed.notify_all()

    def patch(self, path: str, body: Item) -> None:
        *_, namespace, plural, name = path.split("/")
        with self._changed:
            item = self._items.get((plural, namespace, name))
            if item is not None:
                more = {key: item[key] for key in item.keys() - {"metadata", "status"}}
                annotations = item["metadata"].get("annotations", {})
                annotations = annotations | body["metadata"]["annotations"]
                metadata = item["metadata"] | {"annotations": annotations}
                self.put(plural, namespace, name, item["status"], metadata=metadata, **more)
            self.patches.append((path, body))

    def listed(self, plural: str, namespace: str) -> Item:
        with self._changed:
            self.reads += 1
            found = [item for key, item in self._items.items() if key[:2] == (plural, namespace)]
            return {"metadata": {"resourceVersion": str(len(self._log))}, "items": found}

    def answer(self, call: Call) -> Answer:
        if call.method == "PATCH":
            self.patch(call.path, call.json())
            return Answer.json({})
        address = urlsplit(call.path)
        *_, namespace, plural = address.path.split("/")
        query = parse_qs(address.query)
        if "watch" not in query:
            return Answer.json(self.listed(plural, namespace))
        seconds = float(query.get("timeoutSeconds", ["inf"])[0])
        events = self.events(plural, namespace, int(query["resourceVersion"][0]), seconds)
        headers = {"Content-Type": "application/json"}
        return Answer(headers=headers, body=(json.dumps(one).encode() + b"\n" for one in events))

    def events(self, plural: str, namespace: str, since: int, seconds: float) -> Iterator[Item]:
        """Yield the changes after a version, for some seconds or until the server is closed."""
        end = time.monotonic() + seconds
        while not self.closed and time.monotonic() < end:
            with self._changed:
                if len(self._log) == since:
                    self._changed.wait(_BEAT_S)
                new, since = self._log[since:], len(self._log)
            for where, there, item, change in new:
                if (where, there) == (plural, namespace):
                    yield {"type": change, "object": item}

    def flux(self, namespace: str, domain: str, commit: str) -> None:
        revision = f"main@sha1:{commit}"
        ready = {"type": "Ready", "status": "True"}
        status = {"lastAppliedRevision": revision, "conditions": [ready]}
        self.put("kustomizations", namespace, domain, status)

    def helm_release(self, namespace: str, name: str, fault: str = "", since: str = "") -> None:
        ready = {"type": "Ready", "status": "False" if fault else "True", "message": fault}
        ready["lastTransitionTime"] = since or "2026-05-04T12:00:00Z"
        status = {"observedGeneration": 1, "conditions": [ready]}
        self.put("helmreleases", namespace, name, status)

    def deployment(self, namespace: str, name: str, available: int = 1) -> None:
        status = {"observedGeneration": 1, "updatedReplicas": 1, "availableReplicas": available}
        self.put("deployments", namespace, name, status, spec={"replicas": 1})


@contextmanager
def kube_api() -> Iterator[KubeApi]:
    api = KubeApi()
    with serving(api.answer) as server:
        api.url = server.url
        try:
            yield api
        finally:
            api.closed = True
