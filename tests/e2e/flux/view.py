"""An access domain on a cluster that Flux reconciles: its source, its Kustomization, its releases.

This module reads the API and triggers Flux; it changes no object that Flux or a release owns.
"""

from __future__ import annotations

import tarfile
import time
import urllib.request
from collections.abc import Callable, Iterable

from tests.e2e.common.namespace import Namespace, name_of
from tests.e2e.rig.errors import RigError
from tests.e2e.rig.kube import Kube, Manifest

SOURCE = "demandops"  # the GitRepository's name


class Domain(Namespace):
    """An access domain on one cluster; the Kustomization `name` applies the domain's folder."""

    RELEASE = "HelmRelease"
    STEADY = ("HelmRelease",)
    OWN = ("GitRepository", "HelmChart", "Kustomization")

    @classmethod
    def all_in(cls, kube: Kube, bootstrap: Iterable[Manifest]) -> list[Domain]:
        follows = (item["metadata"] for item in bootstrap if item["kind"] == "Kustomization")
        return [cls(kube, metadata["namespace"], metadata["name"]) for metadata in follows]

    def settle(self, commit: str) -> None:
        self.wait_applied(commit)
        for chart in self.find("HelmChart"):
            self.kube.wait_ready("HelmChart", name_of(chart), self.namespace)

    def remove(self) -> None:
        for kind, name in (("Kustomization", self.name), ("GitRepository", SOURCE)):
            self.take_away(kind, name)
        for kind in ("HelmRelease", "HelmChart"):  # or the next state repo loses its own
            self.kube.wait(f"each {kind} to go", lambda k=kind: self.find(k) == [])

    # --- reading ----------------------------------------------------------------------------

    def applied(self) -> str:
        """Return the commit that the Kustomization applied last; empty if none."""
        return _commit(self._status("Kustomization", self.name).get("lastAppliedRevision"))

    def fetched(self) -> str:
        """Return the commit that the GitRepository fetched last; empty if none."""
        return _commit(self._status("GitRepository", SOURCE).get("artifact", {}).get("revision"))

    def fetched_files(self) -> list[str]:
        """Return the paths in the artifact of the GitRepository, which this downloads."""
        url = self._status("GitRepository", SOURCE)["artifact"]["url"]
        with (
            urllib.request.urlopen(url, timeout=60) as answer,  # noqa: S310 - the source's own
            tarfile.open(fileobj=answer, mode="r|gz") as archive,
        ):
            return [member.name for member in archive if member.isfile()]

    def trouble(self, kind: str, name: str) -> str:
        conditions = self._status(kind, name).get("conditions") or []
        messages = [
            c["message"] for c in conditions if c["type"] == "Ready" and c["status"] == "False"
        ]
        return " ".join(messages)

    def folder_trouble(self) -> str:
        return self.trouble("Kustomization", self.name)

    # --- waiting ----------------------------------------------------------------------------

    def wake(self) -> None:
        # the new artifact of the source triggers the Kustomization
        self.kube.reconcile("GitRepository", SOURCE, self.namespace)

    def wait_fetched(self, commit: str) -> float:
        return self._wait_for(f"{commit[:10]} to be fetched", lambda: self.fetched() == commit)

    def wait_applied(self, commit: str) -> float:
        return self._wait_for(f"{commit[:10]} to be applied", lambda: self.applied() == commit)

    def wait_attempted(self, commit: str) -> None:
        def attempted() -> bool:
            status = self._status("Kustomization", self.name)
            return _commit(status.get("lastAttemptedRevision")) == commit

        self._wait_for(f"{commit[:10]} to be tried", attempted)

    def wait_checked(self, commit: str) -> None:
        for chart in self.find("HelmChart"):  # each HelmChart checks every commit
            name = name_of(chart)
            self.kube.wait(
                f"{name} to check the commit",
                lambda n=name: (
                    commit
                    in self.get("HelmChart", n)["status"].get("observedSourceArtifactRevision", "")
                ),
            )

    def take_away(self, kind: str, name: str) -> None:
        super().take_away(kind, name)
        self.kube.wait_gone(kind, name, self.namespace)

    def restore(self, *releases: str) -> None:
        for release in releases:
            self.kube.reconcile("HelmRelease", release, self.namespace)
        if not releases:
            self.kube.reconcile("Kustomization", self.name, self.namespace)

    def wait_releases(self) -> None:
        for release in self.find("HelmRelease"):
            self.kube.wait_ready("HelmRelease", name_of(release), self.namespace)

    def _wait_for(self, what: str, look: Callable[[], bool]) -> float:
        try:
            self.kube.wait(what, look)
        except RigError as error:
            messages = [self.trouble("GitRepository", SOURCE), self.folder_trouble()]
            raise AssertionError(f"{error}; {'; '.join(filter(None, messages))}") from error
        return time.monotonic()


def _commit(revision: str | None) -> str:
    """Return the commit in a Flux revision (`main@sha1:…`); empty without a revision."""
    return (revision or "").rpartition(":")[2]
