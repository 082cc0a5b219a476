"""Wakes Flux or Argo CD after a push, so that it fetches at once and not at its next interval.

This is optional and blocks nothing: if a cluster does not answer, that is logged, and its
controller fetches at its next interval.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from demandops.cluster import controller_webhook
from demandops.cluster.access import ClusterAccess, NoAccess
from demandops.config.config import Config
from demandops.config.policy import AccessDomain
from demandops.config.repo_settings import RepoSettings
from demandops.http_call import NoAnswer
from demandops.render.gitops.argocd import project_of
from demandops.render.gitops.paths import domain_folder, domains_in_use
from demandops.runtime import REAL, Runtime

log = logging.getLogger("demandops")

_TIMEOUT_S = 5.0
_FIRST_RETRY_S, _LONGEST_RETRY_S = 1.0, 32.0
_SPACING_S = 1.0
"""Seconds between fetches: two within a second can make source-controller break an artifact."""
_REQUESTED_AT = "reconcile.fluxcd.io/requestedAt"
_REFRESH = "argocd.argoproj.io/refresh"


ChangesSince = Callable[[str], tuple[str, list[str] | None]]
"""Returns the newest published commit and, if known, the paths changed since the given commit."""


class ReconcileTrigger:
    """Wakes clusters from its own thread, once for several pushes in a short time."""

    def __init__(
        self,
        clusters: Mapping[str, ClusterAccess],
        changes_since: ChangesSince,
        runtime: Runtime = REAL,
    ) -> None:
        self._runtime = runtime
        self._changes_since = changes_since
        self._reported: dict[str, str] = {}
        self._clusters = {name: access for name, access in clusters.items() if access.wake}
        self._config: Config | None = None
        self._apis: dict[str, Any] = {}
        self._due = runtime.event()
        self._stopping = False
        self._stop = runtime.event()
        self._woken_at = -_SPACING_S
        self._thread = runtime.start_thread("wake", self._run)

    def __call__(self, config: Config) -> None:
        """Request a wake after a push; returns at once."""
        self._config = config
        self._due.set()

    def close(self) -> None:
        """Wake the clusters for the last push, if that is still due, and stop."""
        self._stopping = True
        self._stop.set()
        self._due.set()  # lets the thread run once more
        self._thread.join(2 * _TIMEOUT_S)

    def _run(self) -> None:
        missed: set[str] = set()
        pause: float | None = None
        while True:
            fresh = self._due.wait(pause)
            self._due.clear()
            if not self._stopping:
                self._stop.wait(self._seconds_until_next())
            self._woken_at = self._runtime.monotonic()
            stopping = self._stopping
            if fresh:
                missed, pause = set(self._clusters), _FIRST_RETRY_S
            elif pause is not None:
                pause *= 2
            missed = self._wake_all(missed, logged=not fresh)
            if stopping:
                return
            if not missed or pause is None or pause > _LONGEST_RETRY_S:
                missed, pause = set(), None

    def _wake_all(self, names: Iterable[str], logged: bool) -> set[str]:
        """Wake clusters and return those that failed; logs a failure unless ``logged``."""
        missed = set()
        for name in sorted(names):
            if self._config is None:
                break
            try:
                self._wake(name, self._clusters[name], self._config)
            except Exception as error:
                missed.add(name)
                self._apis.pop(name, None)
                if not logged:
                    log.warning(
                        "cluster '%s' was not woken (%s); retrying for a minute, otherwise it "
                        "fetches at its next interval",
                        name,
                        _reason(error),
                    )
        return missed

    def _seconds_until_next(self) -> float:
        """Return how long to wait before the next wake, because pushes come in bursts."""
        return max(0.0, self._woken_at + _SPACING_S - self._runtime.monotonic())

    def _wake(self, name: str, access: ClusterAccess, config: Config) -> None:
        argocd = config.repo_settings.argocd if config.repo_settings.gitops == "argocd" else None
        if argocd and access.webhook:
            self._call_argocd(name, access.webhook, access, config, argocd.url)
        elif access.receiver and not argocd:
            controller_webhook.send(
                access.receiver, controller_webhook.flux_call(), access.secret(), _TIMEOUT_S
            )
        elif access.kubeconfig:
            self._annotate_sources(name, access, config)
        else:
            missing = "webhook" if argocd else "receiver"
            raise NoAccess(f"it has neither a kubeconfig nor a {missing}")

    def _call_argocd(
        self, name: str, url: str, access: ClusterAccess, config: Config, repo: str
    ) -> None:
        """Call Argo CD's webhook.

        Argo CD refreshes the Applications whose folders changed. The call always lists a file of
        each domain's folder: an Application that is not refreshed never reports the new commit.
        """
        before = self._reported.get(name, "")
        commit, paths = self._changes_since(before)
        if paths is not None:
            paths = [path for path in paths if _concerns(path, name)]
            paths += [
                f"{domain_folder(name, domain)}/_domain.yaml" for domain in _domains(name, config)
            ]
        call = controller_webhook.argocd_call(repo, before, commit, paths)
        controller_webhook.send(url, call, access.secret(), _TIMEOUT_S)
        self._reported[name] = commit

    def _annotate_sources(self, name: str, access: ClusterAccess, config: Config) -> None:
        now = self._runtime.now().isoformat()
        for domain in _domains(name, config):
            self._api(name, access).patch_namespaced_custom_object(
                *_refresh_patch(domain, config.repo_settings, now), _request_timeout=_TIMEOUT_S
            )

    def _api(self, name: str, access: ClusterAccess) -> Any:  # noqa: ANN401
        if name not in self._apis:
            from kubernetes import client  # noqa: PLC0415 - half a second; only when used

            self._apis[name] = client.CustomObjectsApi(access.client())
        return self._apis[name]


def _reason(error: Exception) -> str:
    """Return why a cluster was not woken, without URLs or other secrets."""
    return str(error) if isinstance(error, NoAccess | NoAnswer) else type(error).__name__


def _domains(cluster: str, config: Config) -> list[AccessDomain]:
    return [domain for name, domain in domains_in_use(config) if name == cluster]


def _concerns(path: str, cluster: str) -> bool:
    """Report whether a changed path may affect a cluster.

    The ledger and the files of other clusters do not.
    """
    first, _, rest = path.partition("/")
    return rest.startswith(f"{cluster}/") if first == "clusters" else first != "ledger"


def _refresh_patch(
    domain: AccessDomain, repository: RepoSettings, now: str
) -> tuple[str, str, str, str, str, dict[str, Any]]:
    """Return the object of a domain that fetches from Git, and the patch that makes it fetch."""
    if repository.gitops == "argocd" and repository.argocd:
        kind = ("argoproj.io", "v1alpha1", repository.argocd.namespace, "applications")
        return *kind, project_of(domain, repository), _annotation(_REFRESH, "normal")
    kind = ("source.toolkit.fluxcd.io", "v1", domain.namespace, "gitrepositories")
    return *kind, repository.source, _annotation(_REQUESTED_AT, now)


def _annotation(name: str, value: str) -> dict[str, Any]:
    return {"metadata": {"annotations": {name: value}}}
