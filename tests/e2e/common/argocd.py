"""An access domain that Argo CD reconciles: its folder's Application and those of its releases."""

from __future__ import annotations

from typing import Any

from tests.e2e.rig.components import ARGOCD as CONTROL
from tests.e2e.rig.kube import Kube, Manifest

from .domain import Domain

_REFRESH = "argocd.argoproj.io/refresh"


class ArgoDomain(Domain):
    RELEASE = FOLDER = "Application"
    FETCHER = "argocd-repo-server"
    APPLIER = INSTALLER = "argocd-application-controller"

    @classmethod
    def all_in(cls, kube: Kube, bootstrap: list[Manifest]) -> list[Domain]:
        folders = [item for item in bootstrap if item["kind"] == cls.FOLDER]
        return [
            cls(kube, item["spec"]["destination"]["namespace"], item["metadata"]["name"])
            for item in folders
        ]

    def settle(self, commit: str) -> None:
        def is_permitted() -> bool:
            """Return whether the project permits the folder and Argo CD has read the folder.

            For minutes, Argo CD may still use a former project of the same name. If that project
            forbids the folder, make Argo CD look at the folder again.
            """
            if "is not permitted in project" in self.trouble(self.FOLDER, self.name):
                self.wake()
                return False
            return bool(self.fetched())

        self.kube.wait("Argo CD to see the project", is_permitted)
        self.wait_applied(commit)

    def remove(self) -> None:
        self.kube.delete(self.FOLDER, self.name, CONTROL)
        # if a test killed the API server, Argo CD sees this only when it watches again
        self.kube.wait_gone(self.FOLDER, self.name, CONTROL)
        self.kube.delete("AppProject", self.name, CONTROL)

    def wake(self) -> None:
        self._refresh(self.name)

    def fetched(self) -> str:
        return str(self._sync(self._folder()).get("revision", ""))

    def applied(self) -> str:
        folder = self._folder()
        sync, under_way = self._sync(folder), bool(folder.get("operation"))
        return str(sync["revision"]) if sync.get("status") == "Synced" and not under_way else ""

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

    def wait_attempted(self, commit: str) -> None:
        self.wait_fetched(commit)

    def wait_checked(self, commit: str) -> None:
        for release in self.releases():
            self._refresh(release)

    def wait_releases(self) -> None:
        def synced() -> bool:
            states = [self._sync(item).get("status") for item in self.find(self.RELEASE)]
            return all(state == "Synced" for state in states)

        self.wait("all releases to be Synced", synced)

    def read_chart(self, release: str) -> None:
        self._refresh(release)  # by itself, Argo CD reads a chart only every few minutes

    def _refresh(self, name: str) -> None:
        home = self._home(name)
        body = {"metadata": {"annotations": {_REFRESH: "normal"}}}
        self.kube.patch(self.FOLDER, name, body, home)

        def refreshed() -> bool:
            found = self.kube.get(self.FOLDER, name, home) or {"metadata": {}}
            return _REFRESH not in (found["metadata"].get("annotations") or {})

        self.kube.wait(f"Application {home}/{name} to be refreshed", refreshed)

    def _folder(self) -> Manifest:
        return self.kube.get(self.FOLDER, self.name, CONTROL) or {}

    def _sync(self, application: Manifest) -> dict[str, Any]:
        return dict((application.get("status") or {}).get("sync") or {})

    def _home(self, name: str) -> str:
        """Return the namespace of an Application: the folder's is Argo CD's own."""
        return CONTROL if name == self.name else self.namespace
