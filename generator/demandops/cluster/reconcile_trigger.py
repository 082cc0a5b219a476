"""Waking Flux or Argo CD after a push, so that it fetches at once, not at its next interval.

Optional, and never in the way: a cluster that does not answer is logged and left to its interval.
"""

from __future__ import annotations

import logging
import threading
import time
import urllib.error
from collections.abc import Callable, Iterable, Mapping
from datetime import datetime, timezone
from typing import Any

from demandops.cluster import controller_webhook
from demandops.cluster.access import ClusterAccess, NoAccess
from demandops.config.config import Config
from demandops.config.policy import AccessDomain
from demandops.config.repo_settings import RepoSettings
from demandops.render.gitops.argocd import project_of
from demandops.render.gitops.paths import domain_folder, domains_in_use

log = logging.getLogger("demandops")

_TIMEOUT_S = 5.0
_FIRST_RETRY_S, _LONGEST_RETRY_S = 1.0, 32.0
_SPACING_S = 1.0
"""Two fetches within a second were seen to leave source-controller with a broken artifact."""
_REQUESTED_AT = "reconcile.fluxcd.io/requestedAt"
_REFRESH = "argocd.argoproj.io/refresh"


Changed = Callable[[str], tuple[str, list[str] | None]]
"""Gives the newest published commit, and the paths changed since another where that is known."""


class ReconcileTrigger:
    """Wakes clusters from a thread of its own; several pushes that come together wake once."""

    def __init__(self, clusters: Mapping[str, ClusterAccess], changed: Changed) -> None:
        self._changed = changed
        self._told: dict[str, str] = {}
        self._clusters = {name: reached for name, reached in clusters.items() if reached.wake}
        self._config: Config | None = None
        self._apis: dict[str, Any] = {}
        self._due = threading.Event()
        self._stopping = False
        self._stop = threading.Event()
        self._woken_at = -_SPACING_S
        self._thread = threading.Thread(target=self._run, name="demandops-wake", daemon=True)
        self._thread.start()

    def __call__(self, config: Config) -> None:
        """Say that something was pushed; returns at once."""
        self._config = config
        self._due.set()

    def close(self) -> None:
        """Wake for the last push, if that is still due, and stop."""
        self._stopping = True
        self._stop.set()
        self._due.set()  # the thread looks once more; with nothing pushed ever it just ends
        self._thread.join(2 * _TIMEOUT_S)

    def _run(self) -> None:
        missed: set[str] = set()
        pause: float | None = None
        while True:
            fresh = self._due.wait(pause)
            self._due.clear()
            if not self._stopping:
                self._stop.wait(self._rest_s())
            self._woken_at = time.monotonic()
            stopping = self._stopping
            if fresh:
                missed, pause = set(self._clusters), _FIRST_RETRY_S
            elif pause is not None:
                pause *= 2
            missed = self._wake_all(missed, told=not fresh)
            if stopping:
                return
            if not missed or pause is None or pause > _LONGEST_RETRY_S:
                missed, pause = set(), None

    def _wake_all(self, names: Iterable[str], told: bool) -> set[str]:
        """Wake clusters; return those that did not answer, and log it the first time."""
        missed = set()
        for name in sorted(names):
            if self._config is None:
                break
            try:
                self._wake(name, self._clusters[name], self._config)
            except Exception as error:
                missed.add(name)
                self._apis.pop(name, None)
                if not told:
                    log.warning(
                        "cluster '%s' was not woken (%s); trying on for a minute, then it fetches "
                        "at its interval",
                        name,
                        _reason(error),
                    )
        return missed

    def _rest_s(self) -> float:
        """Return how long to wait before the next wake: pushes come in swarms."""
        return max(0.0, self._woken_at + _SPACING_S - time.monotonic())

    def _wake(self, name: str, reached: ClusterAccess, config: Config) -> None:
        argocd = config.repo_settings.argocd if config.repo_settings.gitops == "argocd" else None
        if argocd and reached.webhook:
            self._tell(name, reached.webhook, reached, config, argocd.url)
        elif reached.receiver and not argocd:
            controller_webhook.send(
                reached.receiver, controller_webhook.to_flux(), reached.secret(), _TIMEOUT_S
            )
        elif reached.kubeconfig:
            self._ask(name, reached, config)
        else:
            missing = "webhook" if argocd else "receiver"
            raise NoAccess(f"it has neither a kubeconfig nor a {missing}")

    def _tell(self, name: str, url: str, reached: ClusterAccess, config: Config, repo: str) -> None:
        """Call Argo CD's webhook.

        It looks at those Applications whose folders changed. Each domain's is among them every
        time: one that is not looked at never says that it has the commit.
        """
        before = self._told.get(name, "")
        commit, paths = self._changed(before)
        if paths is not None:
            own = (f"{domain_folder(name, domain)}/" for domain in _domains(name, config))
            paths = [path for path in paths if _concerns(path, name)]
            paths += [f"{folder}_domain.yaml" for folder in own]
        call = controller_webhook.to_argocd(repo, before, commit, paths)
        controller_webhook.send(url, call, reached.secret(), _TIMEOUT_S)
        self._told[name] = commit

    def _ask(self, name: str, reached: ClusterAccess, config: Config) -> None:
        now = datetime.now(timezone.utc).isoformat()
        for domain in _domains(name, config):
            self._api(name, reached).patch_namespaced_custom_object(
                *_asked(domain, config.repo_settings, now), _request_timeout=_TIMEOUT_S
            )

    def _api(self, name: str, reached: ClusterAccess) -> Any:  # noqa: ANN401
        if name not in self._apis:
            from kubernetes import client  # noqa: PLC0415 - half a second; only when used

            self._apis[name] = client.CustomObjectsApi(reached.client())
        return self._apis[name]


def _reason(error: Exception) -> str:
    """Return why a cluster was not woken: no URL in it, nor anything else that is secret."""
    if isinstance(error, urllib.error.HTTPError):
        return f"it answered {error.code}"
    return str(error) if isinstance(error, NoAccess) else type(error).__name__


def _domains(cluster: str, config: Config) -> list[AccessDomain]:
    return [domain for name, domain in domains_in_use(config) if name == cluster]


def _concerns(path: str, cluster: str) -> bool:
    """Tell whether a changed path may matter to a cluster: books and other clusters do not."""
    first, _, rest = path.partition("/")
    return rest.startswith(f"{cluster}/") if first == "clusters" else first != "ledger"


def _asked(
    domain: AccessDomain, repository: RepoSettings, now: str
) -> tuple[str, str, str, str, str, dict[str, Any]]:
    """Return which object of a domain is asked to look, and the patch that asks it."""
    if repository.gitops == "argocd" and repository.argocd:
        where = ("argoproj.io", "v1alpha1", repository.argocd.namespace, "applications")
        return *where, project_of(domain, repository), _annotated(_REFRESH, "normal")
    where = ("source.toolkit.fluxcd.io", "v1", domain.namespace, "gitrepositories")
    return *where, repository.source, _annotated(_REQUESTED_AT, now)


def _annotated(name: str, value: str) -> dict[str, Any]:
    return {"metadata": {"annotations": {name: value}}}
