"""An API server with objects from a test; clients list, watch and annotate the objects."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

from tests.kit.http import running

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
        self._log: list[tuple[str, str, Item]] = []

    def put(self, plural: str, namespace: str, name: str, status: Item, **more: Any) -> None:
        with self._changed:
            metadata = {"name": name, "namespace": namespace, "generation": 1}
            metadata |= more.pop("metadata", {})
            metadata["resourceVersion"] = str(len(self._log) + 1)
            item = {"metadata": metadata, "status": status, **more}
            self._items[plural, namespace, name] = item
            self._log.append((plural, namespace, item))
            self._changed.notify_all()

    def patch(self, path: str, body: Item) -> None:
        """Record a patch; if its object exists, give the object the patch's annotations."""
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

    def forget(self, plural: str, namespace: str, name: str) -> None:
        """Delete an object without an event, as if no client watched when it was deleted."""
        with self._changed:
            del self._items[plural, namespace, name]

    def listed(self, plural: str, namespace: str) -> Item:
        with self._changed:
            self.reads += 1
            found = [item for key, item in self._items.items() if key[:2] == (plural, namespace)]
            return {"metadata": {"resourceVersion": str(len(self._log))}, "items": found}

    def events(self, plural: str, namespace: str, since: int, seconds: float) -> Iterator[Item]:
        """Yield the changes of a namespace's objects of one kind after the version ``since``.

        The iterator ends after ``seconds``, or when the server is closed.
        """
        end = time.monotonic() + seconds
        while not self.closed and time.monotonic() < end:
            with self._changed:
                if len(self._log) == since:
                    self._changed.wait(_BEAT_S)
                new, since = self._log[since:], len(self._log)
            for where, there, item in new:
                if (where, there) == (plural, namespace):
                    yield {"type": "MODIFIED", "object": item}

    def flux(self, namespace: str, domain: str, commit: str) -> None:
        """Report that Flux has applied a commit to an access domain."""
        revision = f"main@sha1:{commit}"
        ready = {"type": "Ready", "status": "True"}
        status = {"lastAppliedRevision": revision, "conditions": [ready]}
        self.put("kustomizations", namespace, domain, status)

    def helm_release(self, namespace: str, name: str, fault: str = "", since: str = "") -> None:
        """Report a Helm release as failed with ``fault``, or as ready if ``fault`` is empty."""
        ready = {"type": "Ready", "status": "False" if fault else "True", "message": fault}
        ready["lastTransitionTime"] = since or "2026-05-04T12:00:00Z"
        status = {"observedGeneration": 1, "conditions": [ready]}
        self.put("helmreleases", namespace, name, status)

    def deployment(self, namespace: str, name: str, available: int = 1) -> None:
        """Report a Deployment that wants one replica, with this number of available replicas."""
        status = {"observedGeneration": 1, "updatedReplicas": 1, "availableReplicas": available}
        self.put("deployments", namespace, name, status, spec={"replicas": 1})


@contextmanager
def kube_api() -> Iterator[KubeApi]:
    api = KubeApi()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, format: str, *args: object) -> None:
            """Do not log requests."""

        def do_GET(self) -> None:
            address = urlsplit(self.path)
            *_, namespace, plural = address.path.split("/")
            query = parse_qs(address.query)
            self.send_response(200)
            self.send_header("Content-Type", "application/json")
            if "watch" not in query:
                body = json.dumps(api.listed(plural, namespace)).encode()
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)
                return
            self.send_header("Transfer-Encoding", "chunked")
            self.end_headers()
            try:
                since = int(query["resourceVersion"][0])
                seconds = float(query.get("timeoutSeconds", ["inf"])[0])
                for event in api.events(plural, namespace, since, seconds):
                    line = json.dumps(event).encode() + b"\n"
                    self.wfile.write(b"%x\r\n%s\r\n" % (len(line), line))
                self.wfile.write(b"0\r\n\r\n")
            except OSError:
                self.close_connection = True

        def do_PATCH(self) -> None:
            body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            api.patch(self.path, body)
            self.send_response(200)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", "2")
            self.end_headers()
            self.wfile.write(b"{}")

    try:
        with running(ThreadingHTTPServer(("127.0.0.1", 0), Handler)) as api.url:
            yield api
    finally:
        api.closed = True
