"""One access domain on one cluster that Flux keeps: its source, its Kustomization, its releases.

It reads the API and asks Flux to look; it changes nothing that Flux or a release owns.
"""

from __future__ import annotations

import tarfile
import time
import urllib.request
from collections.abc import Callable

from tests.e2e.common.namespace import Namespace, name_of
from tests.e2e.rig.errors import RigError

SOURCE = "demandops"  # the GitRepository's name


class Domain(Namespace):
    """The domain's namespace on one cluster; its Kustomization is called `name`."""

    RELEASE = "HelmRelease"
    STEADY = ("HelmRelease",)
    OWN = ("GitRepository", "HelmChart", "Kustomization")

    # --- looking ----------------------------------------------------------------------------

    def applied(self) -> str:
        """The commit that the Kustomization has applied."""
        return _commit(self._status("Kustomization", self.name).get("lastAppliedRevision"))

    def fetched(self) -> str:
        """The commit that the source has fetched."""
        return _commit(self._status("GitRepository", SOURCE).get("artifact", {}).get("revision"))

    def fetched_files(self) -> list[str]:
        """The paths of what the source has fetched, where its address can be reached from here."""
        url = self._status("GitRepository", SOURCE)["artifact"]["url"]
        with (
            urllib.request.urlopen(url, timeout=60) as answer,  # noqa: S310 - the source's own
            tarfile.open(fileobj=answer, mode="r|gz") as archive,
        ):
            return [member.name for member in archive if member.isfile()]

    def trouble(self, kind: str, name: str) -> str:
        """Why an object is not ready; empty where it is or has not said yet."""
        conditions = self._status(kind, name).get("conditions") or []
        told = [c["message"] for c in conditions if c["type"] == "Ready" and c["status"] == "False"]
        return " ".join(told)

    # --- waiting ----------------------------------------------------------------------------

    def wake(self) -> None:
        """Ask the source to look now; its new artifact wakes the Kustomization."""
        self.kube.reconcile("GitRepository", SOURCE, self.namespace)

    def wait_fetched(self, commit: str, timeout: float = 60.0) -> float:
        """Wait until the source has fetched a commit; returns when it was seen."""
        self._wait_for(f"{commit[:10]} to be fetched", lambda: self.fetched() == commit, timeout)
        return time.monotonic()

    def wait_applied(self, commit: str, timeout: float = 60.0) -> float:
        """Wait until the Kustomization has applied a commit; returns when it was seen."""
        self._wait_for(f"{commit[:10]} to be applied", lambda: self.applied() == commit, timeout)
        return time.monotonic()

    def wait_attempted(self, commit: str, timeout: float = 60.0) -> None:
        """Wait until the Kustomization has tried a commit, whatever came of it."""

        def attempted() -> bool:
            status = self._status("Kustomization", self.name)
            return _commit(status.get("lastAttemptedRevision")) == commit

        self._wait_for(f"{commit[:10]} to be tried", attempted, timeout)

    def wait_releases(self) -> None:
        """Wait until Helm has done all that was asked of it."""
        for release in self.find("HelmRelease"):
            self.kube.wait_ready("HelmRelease", name_of(release), self.namespace)

    def _wait_for(self, what: str, look: Callable[[], bool], timeout: float) -> None:
        try:
            self.kube.wait(what, look, timeout)
        except RigError as error:
            told = [self.trouble("GitRepository", SOURCE), self.trouble("Kustomization", self.name)]
            raise AssertionError(f"{error}; {'; '.join(filter(None, told))}") from error


def _commit(revision: str | None) -> str:
    """The commit in a Flux revision (`main@sha1:…`)."""
    return (revision or "").rpartition(":")[2]
