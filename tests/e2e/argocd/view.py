"""An access domain on a cluster that Argo CD reconciles: its folder's Application and its releases.

This module reads the API and triggers Argo CD; it changes no object that Argo CD or a release owns.
"""

from __future__ import annotations

import time
from typing import Any

from tests.e2e.common.namespace import Namespace
from tests.e2e.rig.argocd import NAMESPACE
from tests.e2e.rig.errors import RigError
from tests.e2e.rig.kube import Manifest

_REFRESH = "argocd.argoproj.io/refresh"


class Domain(Namespace):
    """The domain's namespace on one cluster; the Application `name` applies the domain's folder."""

    GITOPS = "argocd"
    RELEASE = "Application"

    # --- reading ----------------------------------------------------------------------------

    def fetched(self) -> str:
        """Return the commit with which Argo CD last compared the folder; empty if none."""
        return str(self._sync().get("revision", ""))

    def applied(self) -> str:
        """Return the commit that the folder is in sync with; empty while it is not."""
        found = self._folder()
        under_way = bool(found.get("operation"))
        return self.fetched() if self._sync().get("status") == "Synced" and not under_way else ""

    def trouble(self, name: str, namespace: str) -> str:
        """Return the errors that Argo CD reports for an Application; empty if it reports none."""
        status = (self.kube.get("Application", name, namespace) or {}).get("status") or {}
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
        return self.trouble(self.name, NAMESPACE)

    # --- waiting ----------------------------------------------------------------------------

    def wake(self) -> None:
        """Refresh the folder's Application now, so that Argo CD applies what has changed in it."""
        self.refresh(self.name, NAMESPACE)

    def refresh(self, name: str, namespace: str = "") -> None:
        """Refresh one Application now, and wait until Argo CD has done so."""
        namespace = namespace or self.namespace
        body = {"metadata": {"annotations": {_REFRESH: "normal"}}}
        self.kube.patch("Application", name, body, namespace)

        def refreshed() -> bool:
            found = self.kube.get("Application", name, namespace) or {"metadata": {}}
            return _REFRESH not in (found["metadata"].get("annotations") or {})

        self.kube.wait(f"Application {namespace}/{name} to be refreshed", refreshed)

    def wait_fetched(self, commit: str) -> float:
        self._wait_for(f"{commit[:10]} to be fetched", commit, fetched=True)
        return time.monotonic()

    def wait_applied(self, commit: str) -> float:
        self._wait_for(f"{commit[:10]} to be applied", commit, fetched=False)
        return time.monotonic()

    def wait_attempted(self, commit: str) -> None:
        self.wait_fetched(commit)

    def wait_checked(self, commit: str) -> None:
        for release in self.releases():
            self.refresh(release)

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

    def _wait_for(self, what: str, commit: str, *, fetched: bool) -> None:
        look = self.fetched if fetched else self.applied
        try:
            self.kube.wait(what, lambda: look() == commit)
        except RigError as error:
            messages = [self.trouble(self.name, NAMESPACE)]
            messages += [self.trouble(name, self.namespace) for name in self.releases()]
            raise AssertionError(f"{error}; {'; '.join(filter(None, messages))}") from error
