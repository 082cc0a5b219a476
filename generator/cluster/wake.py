"""Waking Flux or Argo CD after a push, so that it fetches at once, not at its next interval.

Optional, and never in the way: a cluster that does not answer is logged and left to its interval.
Which clusters, and how each is reached, stands in a file of the operator's that is not part of
the state repo, for a receiver's URL is a secret.
"""

from __future__ import annotations

import logging
import threading
import urllib.error
import urllib.request
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from generator.catalog.catalog import Catalog, Repository
from generator.catalog.model import DnsLabel, FileModel, Frozen, parse_file
from generator.catalog.policy import AccessDomain
from generator.errors import InvalidInput, fault
from generator.render.argocd import project_of
from generator.render.paths import domains_in_use

log = logging.getLogger("demandops")

_TIMEOUT_S = 5.0
_REQUESTED_AT = "reconcile.fluxcd.io/requestedAt"
_REFRESH = "argocd.argoproj.io/refresh"


class Reached(Frozen):
    """How one cluster is woken: through its API, or by the webhook of a Flux Receiver."""

    kubeconfig: Path | None = Field(default=None, strict=False)
    context: str | None = None
    receiver: str | None = Field(default=None, pattern=r"^https?://\S+$")

    @model_validator(mode="after")
    def _one_way(self) -> Reached:
        if bool(self.kubeconfig) == bool(self.receiver):
            raise ValueError("needs either kubeconfig or receiver")
        return self


class WakeFile(FileModel):
    """The operator's file: cluster name → how it is woken."""

    kind: Literal["Wake"]
    clusters: dict[DnsLabel, Reached]


def read(path: Path) -> WakeFile:
    """Read the operator's file.

    Raises:
        InvalidInput: with every fault.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        reason = error.strerror or str(error)
        raise InvalidInput([fault("", f"cannot be read: {reason}").within(str(path))]) from None
    return parse_file(WakeFile, text, str(path))


class Wake:
    """Wakes clusters from a thread of its own; several pushes that come together wake once."""

    def __init__(self, clusters: Mapping[str, Reached]) -> None:
        self._clusters = dict(clusters)
        self._catalog: Catalog | None = None
        self._apis: dict[str, Any] = {}
        self._due = threading.Event()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="demandops-wake", daemon=True)
        self._thread.start()

    def __call__(self, catalog: Catalog) -> None:
        """Say that something was pushed; returns at once."""
        self._catalog = catalog
        self._due.set()

    def close(self) -> None:
        """Wake for the last push, if that is still due, and stop."""
        self._stopping = True
        self._due.set()  # the thread looks once more; with nothing pushed ever it just ends
        self._thread.join(2 * _TIMEOUT_S)

    def _run(self) -> None:
        stopping = False
        while not stopping:
            self._due.wait()
            self._due.clear()
            stopping = self._stopping
            for name, reached in self._clusters.items():
                if self._catalog is None:
                    break
                try:
                    self._wake(name, reached, self._catalog)
                except Exception as error:
                    log.warning(
                        "cluster '%s' was not woken (%s); it fetches at its interval",
                        name,
                        type(error).__name__,
                    )
                    self._apis.pop(name, None)

    def _wake(self, name: str, reached: Reached, catalog: Catalog) -> None:
        if reached.receiver:
            request = urllib.request.Request(reached.receiver, data=b"{}", method="POST")  # noqa: S310
            urllib.request.urlopen(request, timeout=_TIMEOUT_S).close()  # noqa: S310
            return
        now = datetime.now(timezone.utc).isoformat()
        for cluster, domain in domains_in_use(catalog):
            if cluster != name:
                continue
            self._api(name, reached).patch_namespaced_custom_object(
                *_asked(domain, catalog.repository, now), _request_timeout=_TIMEOUT_S
            )

    def _api(self, name: str, reached: Reached) -> Any:  # noqa: ANN401
        if name not in self._apis:
            from kubernetes import client, config  # noqa: PLC0415 - half a second; only when used

            loaded = config.new_client_from_config(str(reached.kubeconfig), reached.context)
            self._apis[name] = client.CustomObjectsApi(loaded)
        return self._apis[name]


def _asked(
    domain: AccessDomain, repository: Repository, now: str
) -> tuple[str, str, str, str, str, dict[str, Any]]:
    """Return which object of a domain is asked to look, and the patch that asks it."""
    if repository.gitops == "argocd" and repository.argocd:
        where = ("argoproj.io", "v1alpha1", repository.argocd.namespace, "applications")
        return *where, project_of(domain, repository), _annotated(_REFRESH, "normal")
    where = ("source.toolkit.fluxcd.io", "v1", domain.namespace, "gitrepositories")
    return *where, repository.source, _annotated(_REQUESTED_AT, now)


def _annotated(name: str, value: str) -> dict[str, Any]:
    return {"metadata": {"annotations": {name: value}}}
