"""Wakes Flux or Argo CD after a push, so that it fetches at once and not at its next interval.

Waking is optional and blocks nothing. If a cluster does not answer, the trigger logs the failure,
and the controller fetches at its next interval.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from demandops.cluster import controller_webhook
from demandops.cluster.clusters_file import ClusterAccess, NoAccess
from demandops.config.config import Config
from demandops.config.policy import AccessDomain
from demandops.config.repo_settings import RepoSettings
from demandops.errors import InvalidInput
from demandops.http_call import NoAnswer
from demandops.render.gitops.argocd import project_of
from demandops.render.gitops.paths import domain_folder, domains_in_use
from demandops.runtime import REAL, Runtime

log = logging.getLogger("demandops")

_TIMEOUT_S = 5.0
_FIRST_RETRY_S, _LONGEST_RETRY_S = 1.0, 32.0
_SPACING_S = 1.0
"""The least number of seconds between two fetches. Two fetches within a second can make Flux's
source-controller corrupt an artifact."""
_REQUESTED_AT = "reconcile.fluxcd.io/requestedAt"
_REFRESH = "argocd.argoproj.io/refresh"


ChangesSince = Callable[[str], tuple[str, list[str] | None]]
"""Returns the newest published commit and, if known, the paths changed since the given commit."""


class ReconcileTrigger:
    """Wakes clusters from its own thread.

    If several pushes follow each other within a short time, it wakes the clusters once for all.
    """

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
        self._stop = runtime.event()
        self._thread = runtime.keep_running("wake", self._run)

    def __call__(self, config: Config) -> None:
        """Request a wake after a push; return at once."""
        self._config = config
        self._due.set()

    def close(self) -> None:
        """Wake the clusters for the last push, if that is still due, and stop."""
        self._stop.set()
        self._due.set()  # makes the thread run once more
        self._thread.join(2 * _TIMEOUT_S)

    def _run(self) -> None:
        missed: set[str] = set()
        pause: float | None = None
        woken_at = -_SPACING_S
        while True:
            fresh = self._due.wait(pause)
            self._due.clear()
            # wait, because pushes come in bursts
            self._stop.wait(max(0.0, woken_at + _SPACING_S - self._runtime.monotonic()))
            woken_at, stopping = self._runtime.monotonic(), self._stop.is_set()
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
        """Wake clusters; return the names of those that could not be woken.

        Failures are logged unless ``logged`` is true, which means that they are in the log already.
        """
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

    def _wake(self, name: str, access: ClusterAccess, config: Config) -> None:
        argocd = config.repo_settings.argocd if config.repo_settings.gitops == "argocd" else None
        if argocd and access.webhook:
            before = self._reported.get(name, "")
            commit, paths = self._changes_since(before)
            if paths is not None:
                # Name a file in each domain's folder too: Argo CD refreshes only Applications
                # with changed files, and only a refreshed one reports the new commit.
                paths = [path for path in paths if _concerns(path, name)]
                folders = [domain_folder(name, domain) for domain in _domains(name, config)]
                paths += [f"{folder}/_domain.yaml" for folder in folders]
            controller_webhook.call_argocd(
                access.webhook, access.secret(), argocd.url, before, commit, paths
            )
            self._reported[name] = commit
        elif access.receiver and not argocd:
            controller_webhook.call_flux(access.receiver, access.secret())
        elif access.kubeconfig:
            if name not in self._apis:
                self._apis[name] = access.api()
            now = self._runtime.now().isoformat()
            for domain in _domains(name, config):
                self._apis[name].patch_namespaced_custom_object(
                    **_refresh_patch(domain, config.repo_settings, now), _request_timeout=_TIMEOUT_S
                )
        else:
            missing = "webhook" if argocd else "receiver"
            raise NoAccess(f"it has neither a kubeconfig nor a {missing}")


def _reason(error: Exception) -> str:
    """Return why a cluster was not woken; the text has no URLs or secrets."""
    told = isinstance(error, NoAccess | NoAnswer | InvalidInput)
    return str(error) if told else type(error).__name__


def _domains(cluster: str, config: Config) -> list[AccessDomain]:
    return [domain for name, domain in domains_in_use(config) if name == cluster]


def _concerns(path: str, cluster: str) -> bool:
    """Return whether a changed file may affect a cluster.

    Files of the ledger and of other clusters do not.
    """
    first, _, rest = path.partition("/")
    return rest.startswith(f"{cluster}/") if first == "clusters" else first != "ledger"


def _refresh_patch(domain: AccessDomain, repository: RepoSettings, now: str) -> dict[str, Any]:
    """Return the arguments of an API call that makes the controller fetch a domain's folder now."""
    if repository.gitops == "argocd" and repository.argocd:
        group, version, plural = "argoproj.io", "v1alpha1", "applications"
        namespace, name = repository.argocd.namespace, project_of(domain, repository)
        annotation = {_REFRESH: "normal"}
    else:
        group, version, plural = "source.toolkit.fluxcd.io", "v1", "gitrepositories"
        namespace, name = domain.namespace, repository.source
        annotation = {_REQUESTED_AT: now}
    return {
        "group": group,
        "version": version,
        "namespace": namespace,
        "plural": plural,
        "name": name,
        "body": {"metadata": {"annotations": annotation}},
    }
