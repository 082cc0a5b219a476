"""An access domain that Flux reconciles: its GitRepository, its Kustomization, its releases."""

from __future__ import annotations

import tarfile
import urllib.request

from tests.e2e.rig.kube import Kube, Manifest

from .domain import Domain, name_of

SOURCE = "demandops"  # the GitRepository's name


class FluxDomain(Domain):
    RELEASE, FOLDER = "HelmRelease", "Kustomization"
    STEADY = ("HelmRelease",)
    OWN = ("GitRepository", "HelmChart", "Kustomization")
    FETCHER, APPLIER = "source-controller", "kustomize-controller"
    INSTALLER = "helm-controller"

    @classmethod
    def all_in(cls, kube: Kube, bootstrap: list[Manifest]) -> list[Domain]:
        follows = (item["metadata"] for item in bootstrap if item["kind"] == cls.FOLDER)
        return [cls(kube, metadata["namespace"], metadata["name"]) for metadata in follows]

    def settle(self, commit: str) -> None:
        self.wait_applied(commit)
        for chart in self.names("HelmChart"):
            self.kube.wait_ready("HelmChart", chart, self.namespace)

    def remove(self) -> None:
        self.take_away(self.FOLDER, self.name)
        self.take_away("GitRepository", SOURCE)
        for kind in ("HelmRelease", "HelmChart"):  # or the next state repo loses its own
            self.kube.wait(f"each {kind} to go", lambda k=kind: self.find(k) == [])

    def wake(self) -> None:
        # the new artifact of the source triggers the Kustomization
        self.kube.reconcile("GitRepository", SOURCE, self.namespace)

    def fetched(self) -> str:
        return _commit(self._status("GitRepository", SOURCE).get("artifact", {}).get("revision"))

    def fetched_files(self) -> list[str]:
        """Return the paths in the artifact of the GitRepository, which this downloads."""
        url = self._status("GitRepository", SOURCE)["artifact"]["url"]
        with (
            urllib.request.urlopen(url, timeout=60) as answer,  # noqa: S310 - the source's own
            tarfile.open(fileobj=answer, mode="r|gz") as archive,
        ):
            return [member.name for member in archive if member.isfile()]

    def applied(self) -> str:
        return _commit(self._status(self.FOLDER, self.name).get("lastAppliedRevision"))

    def trouble(self, kind: str, name: str) -> str:
        conditions = self._status(kind, name).get("conditions") or []
        failed = [c for c in conditions if c["type"] == "Ready" and c["status"] == "False"]
        return " ".join(condition["message"] for condition in failed)

    def wait_attempted(self, commit: str) -> None:
        def attempted() -> bool:
            status = self._status(self.FOLDER, self.name)
            return _commit(status.get("lastAttemptedRevision")) == commit

        self.wait(f"{commit[:10]} to be tried", attempted)

    def wait_checked(self, commit: str) -> None:
        def checked() -> bool:  # each HelmChart checks every commit
            charts = [chart.get("status", {}) for chart in self.find("HelmChart")]
            return all(commit in one.get("observedSourceArtifactRevision", "") for one in charts)

        self.wait(f"each chart to check {commit[:10]}", checked)

    def wait_releases(self) -> None:
        for release in self.find(self.RELEASE):
            self.kube.wait_ready(self.RELEASE, name_of(release), self.namespace)

    def take_away(self, kind: str, name: str) -> None:
        super().take_away(kind, name)
        self.kube.wait_gone(kind, name, self.namespace)

    def restore(self, *releases: str) -> None:
        for release in releases:
            self.kube.reconcile(self.RELEASE, release, self.namespace)
        if not releases:
            self.kube.reconcile(self.FOLDER, self.name, self.namespace)


def _commit(revision: str | None) -> str:
    """Return the commit in a Flux revision (`main@sha1:…`); empty without a revision."""
    return (revision or "").rpartition(":")[2]
