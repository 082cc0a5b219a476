"""An access domain on a cluster that Argo CD reconciles: its folder's Application and its releases.

This module reads the API and triggers Argo CD; it changes no object that Argo CD or a release owns.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Any

from tests.e2e.common.namespace import Namespace
from tests.e2e.rig.components import ARGOCD as NAMESPACE
from tests.e2e.rig.errors import RigError
from tests.e2e.rig.kube import Kube, Manifest

_REFRESH = "argocd.argoproj.io/refresh"


class Domain(Namespace):
    """The domain's namespace on one cluster; the Application `name` applies the domain's folder."""

    RELEASE = "Application"

    @classmethod
    def all_in(cls, kube: Kube, bootstrap: Iterable[Manifest]) -> list[Domain]:
        folders = (item for item in bootstrap if item["kind"] == "Application")
        return [
            cls(kube, one["spec"]["destination"]["namespace"], one["metadata"]["name"])
            for one in folders
        ]

    def settle(self, commit: str) -> None:
        def is_permitted() -> bool:
            """Return whether the project permits the folder and Argo CD has read the folder.

            For minutes, Argo CD may still use a former project of the same name. If that project
            forbids the folder, make Argo CD look at the folder again.
            """
            if "is not permitted in project" in self.folder_trouble():
                self.wake()
                return False
            return bool(self.fetched())

        self.kube.wait("Argo CD to see the project", is_permitted)
        self.wait_applied(commit)

    def remove(self) -> None:
        self.kube.delete("Application", self.name, NAMESPACE)
        # if a test killed the API server, Argo CD sees this only when it watches again
        self.kube.wait_gone("Application", self.name, NAMESPACE)
        self.kube.delete("AppProject", self.name, NAMESPACE)

    # --- reading ----------------------------------------------------------------------------

    def fetched(self) -> str:
        """Return the commit with which Argo CD last compared the folder; empty if none."""
        return str(self._sync().get("revision", ""))

    def applied(self) -> str:
        """Return the commit that the folder is in sync with; empty while it is not."""
        found = self._folder()
        under_way = bool(found.get("operation"))
        return self.fetched() if self._sync().get("status") == "Synced" and not under_way else ""

    def trouble(self, kind: str, name: str) -> str:
        found = self.kube.get(kind, name, self._home(name)) or {}
        status = found.get("status") or {}
        messages = [condition["message"] for condition in status.get("conditions") or []]
        operation = status.get("operationState") or {}
        if operation.get("phase") not in (None, "Succeeded"):
            messages.append(f"{operation['phase']}: {operation.get('message', '')}")
            results = (operation.get("syncResult") or {}).get("resources") or []
            messages += [
                f"{item['kind']} {item['name']}: {item['message']}"
                for item in results
                if item.get("status") not in ("Synced", "Pruned", None)
            ]
        return "; ".join(messages)

    def folder_trouble(self) -> str:
        return self.trouble("Application", self.name)

    def read_chart(self, release: str) -> None:
        self._refresh(release)  # by itself, Argo CD reads a chart only every few minutes

    # --- waiting ----------------------------------------------------------------------------

    def wake(self) -> None:
        """Refresh the folder's Application now, so that Argo CD applies what has changed in it."""
        self._refresh(self.name)

    def _refresh(self, name: str) -> None:
        home = self._home(name)
        body = {"metadata": {"annotations": {_REFRESH: "normal"}}}
        self.kube.patch("Application", name, body, home)

        def refreshed() -> bool:
            found = self.kube.get("Application", name, home) or {"metadata": {}}
            return _REFRESH not in (found["metadata"].get("annotations") or {})

        self.kube.wait(f"Application {home}/{name} to be refreshed", refreshed)

    def wait_fetched(self, commit: str) -> float:
        return self._wait_for(f"{commit[:10]} to be fetched", lambda: self.fetched() == commit)

    def wait_applied(self, commit: str) -> float:
        return self._wait_for(f"{commit[:10]} to be applied", lambda: self.applied() == commit)

    def wait_attempted(self, commit: str) -> None:
        self.wait_fetched(commit)

    def wait_checked(self, commit: str) -> None:
        for release in self.releases():
            self._refresh(release)

    def wait_releases(self) -> None:
        def synced() -> bool:
            states = [item.get("status", {}).get("sync", {}) for item in self.find("Application")]
            return all(state.get("status") == "Synced" for state in states)

        self.kube.wait("all releases to be Synced", synced)

    # --- inside -----------------------------------------------------------------------------

    def _folder(self) -> Manifest:
        return self.kube.get("Application", self.name, NAMESPACE) or {}

    def _sync(self) -> dict[str, Any]:
        return dict((self._folder().get("status") or {}).get("sync") or {})

    def _home(self, name: str) -> str:
        """Return the namespace of an Application: the folder's is Argo CD's own."""
        return NAMESPACE if name == self.name else self.namespace

    def _wait_for(self, what: str, look: Callable[[], bool]) -> float:
        try:
            self.kube.wait(what, look)
        except RigError as error:
            messages = [self.trouble("Application", one) for one in (self.name, *self.releases())]
            raise AssertionError(f"{error}; {'; '.join(filter(None, messages))}") from error
        return time.monotonic()
