"""Wakes Flux or Argo CD after a push, so that nobody waits for their interval."""

from __future__ import annotations

import hashlib
import hmac
import json
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from math import inf
from urllib.parse import urlsplit

from demandops.base import http_call
from demandops.base.addresses import in_url
from demandops.base.errors import InvalidInput
from demandops.base.http_call import NoAnswer
from demandops.base.runtime import REAL, Runtime, log
from demandops.base.settings import MAIN_BRANCH
from demandops.cluster.clusters_file import ClusterAccess
from demandops.cluster.health import REQUESTED_AT, ClusterDomain, Flux, ObjectSelector
from demandops.cluster.rollouts import cluster_domain
from demandops.cluster.watches import object_caches
from demandops.model.config.config import Config
from demandops.render.gitops import domains_by_cluster

# ---- signed calls to a controller's webhook ----
#
# A call to Flux goes to a Receiver of type ``generic-hmac``, or ``generic`` if there is no secret.
# A call to Argo CD is a push event in GitHub's format. Argo CD compares the repository of the event
# with the source of each Application.

_TIMEOUT_S = 5.0


def call_argocd(
    url: str, secret: bytes | None, repo: str, before: str, after: str, paths: Iterable[str] | None
) -> None:
    # Argo CD fetches the state repo from ``repo``. ``before`` is the commit of the last call, if
    # there was one. With None as ``paths``, Argo CD refreshes all Applications of the repo.
    event = {
        "ref": f"refs/heads/{MAIN_BRANCH}",
        "before": before or "0" * 40,
        "after": after,
        "repository": {"html_url": web_address(repo), "default_branch": MAIN_BRANCH},
        "commits": [] if paths is None else [{"id": after, "modified": sorted(paths)}],
    }
    body = json.dumps(event).encode()
    _send(url, body, secret, "X-Hub-Signature-256", {"X-GitHub-Event": "push"})


def web_address(repo: str) -> str:
    """Return the address of a repository's web page; NoAnswer is raised if it names no host."""
    # Without user and password. Argo CD compares this address with each source's URL by host and
    # path, not by scheme and port.
    parts = urlsplit(repo)
    host, path = in_url(parts.hostname or ""), parts.path.removeprefix("/")
    if not host:
        raise NoAnswer(
            "the state repo's URL names no host, but Argo CD needs a host to recognize the repo; "
            "write https://HOST/PATH or ssh://USER@HOST/PATH in demandops.yaml: argocd.url"
        )
    return f"https://{host}/{path.removesuffix('.git')}"


def signature(secret: bytes, body: bytes) -> str:
    # in the format that Flux and Argo CD expect
    return f"sha256={hmac.new(secret, body, hashlib.sha256).hexdigest()}"


def _send(
    url: str, body: bytes, secret: bytes | None, signature_header: str, headers: dict[str, str]
) -> None:
    headers["Content-Type"] = "application/json"
    if secret is not None:
        headers[signature_header] = signature(secret, body)
    answer = http_call.call("POST", url, headers, body, _TIMEOUT_S)
    if not answer.is_success:
        raise NoAnswer(f"it answered {answer.status}")


# ---- the calls after a push ----
#
# Waking is optional and blocks nothing. If a cluster does not answer, the trigger logs the failure
# and tries again for a minute. After that, the controller fetches at its next interval.
#
# While Flux is known to be busy, it is not woken, but for a minute at most. If kustomize-controller
# 1.9 begins a second reconciliation right after the first, the second may read the status from
# before the first. Kustomize-controller then forgets which objects the first reconciliation
# created, and never removes them.

_FIRST_RETRY_S, _LONGEST_RETRY_S = 1.0, 32.0
# The next fetch begins at least so long after Flux has applied what the last fetch brought. Two
# fetches within a second can make source-controller corrupt an artifact.
_SPACING_S = 1.0
# So long after a push, Flux is woken even if it is not idle.
_LONGEST_WAIT_S = 60.0


# Returns the newest published commit, and the paths that changed since a commit, if that is known.
ChangesSince = Callable[[str], tuple[str, list[str] | None]]


@dataclass(eq=False)
class _Wake:
    # a planned call that makes the controller of access domains fetch; in monotonic seconds
    cluster: str
    domains: tuple[ClusterDomain, ...]
    pushed: float | None = None  # the oldest push that still needs a call
    next_try: float = -inf
    pause: float = _FIRST_RETRY_S
    idle_from: float = -inf  # since when the controller is known to be idle; inf while it is busy
    # For each domain, what `Flux.handled_request` returned just before the last call.
    handled: dict[ClusterDomain, str] = field(default_factory=dict)

    @property
    def due(self) -> float:
        if self.pushed is None:
            return inf
        free = min(self.idle_from + _SPACING_S, self.pushed + _LONGEST_WAIT_S)
        return max(self.next_try, free)


def _warn(cluster: str, why: str) -> None:
    log.warning(
        "cluster '%s' was not woken (%s); retrying for a minute; if no retry succeeds, "
        "the cluster's controller fetches at its next interval",
        cluster,
        why,
    )


class ReconcileTrigger:
    # in a thread of its own; pushes that come before a call is due share it
    def __init__(
        self,
        clusters: Mapping[str, ClusterAccess],
        changes_since: ChangesSince,
        runtime: Runtime = REAL,
        tell: Callable[[str, str], None] = _warn,  # of a cluster, and why it was not woken
    ) -> None:
        self._runtime = runtime
        self._tell = tell
        self._changes_since = changes_since
        self._reported: dict[str, str] = {}
        self._clusters = {name: access for name, access in clusters.items() if access.wake}
        self._config: Config | None = None
        self._wakes: dict[tuple[str, ...], _Wake] = {}
        self._pushed = False
        self._changed = runtime.event()
        self._ends = inf
        self._caches = object_caches(self._clusters, self._changed.set, runtime)
        self._thread = runtime.keep_running("wake", self._run)

    def __call__(self, config: Config) -> None:
        self._config = config
        self._pushed = True
        self._changed.set()

    def close(self) -> None:
        """Make the calls for the last push that have not been tried yet, and stop."""
        # if Flux is busy for longer, it is not woken, and fetches at its next interval
        self._ends = self._runtime.monotonic() + _TIMEOUT_S
        self._changed.set()
        self._thread.join(2 * _TIMEOUT_S)
        for cache in self._caches.values():
            cache.close()

    def not_woken(self) -> set[str]:
        return {wake.cluster for wake in self._wakes.values() if wake.pushed is not None}

    def _run(self) -> None:
        while True:
            due = min([self._ends, *(wake.due for wake in self._wakes.values())])
            self._changed.wait(None if due == inf else max(0.0, due - self._runtime.monotonic()))
            self._changed.clear()
            if self._pushed and self._config is not None:
                self._pushed = False
                self._note_push(self._config)
            for wake in self._wakes.values():
                self._note_idle(wake)
                if wake.due <= self._runtime.monotonic():
                    self._try(wake)
            # a push that came during the last call is not noted yet
            is_call_left = self._pushed or any(
                wake.pushed is not None and wake.pause == _FIRST_RETRY_S
                for wake in self._wakes.values()
            )
            is_over = self._ends <= self._runtime.monotonic()
            if is_over or (self._ends < inf and not is_call_left):
                return

    def _note_push(self, config: Config) -> None:
        now, before = self._runtime.monotonic(), self._wakes
        self._wakes = {}
        for cluster in sorted(self._clusters):
            access = self._clusters[cluster]
            domains = tuple(
                cluster_domain(cluster, domain, config.repo_settings)
                for domain in domains_by_cluster(config).get(cluster, ())
            )
            argocd = config.repo_settings.gitops == "argocd"
            # one call of a webhook wakes all domains, but the API needs a call for each
            together = bool(access.webhook if argocd else access.receiver) or not access.kubeconfig
            for woken in [domains] if together else [(domain,) for domain in domains]:
                key = (cluster, *(domain.name for domain in woken))
                wake = self._wakes[key] = before.get(key) or _Wake(cluster, woken)
                wake.domains = woken
                wake.pushed = now if wake.pushed is None else wake.pushed
                wake.next_try, wake.pause = now, _FIRST_RETRY_S
            if cluster in self._caches and not argocd:
                self._caches[cluster].watch(_followed(domains))

    def _note_idle(self, wake: _Wake) -> None:
        cache, is_idle = self._caches.get(wake.cluster), True  # also if its state is not known
        if cache is not None and not cache.why_unknown(_followed(wake.domains)):
            objects, flux = cache.objects(), Flux()
            try:
                is_idle = all(
                    flux.is_idle(domain, objects, wake.handled.get(domain))
                    for domain in wake.domains
                )
            # an odd object must not keep other clusters from being woken
            except Exception as error:
                log.debug("the objects of cluster '%s' cannot be read: %r", wake.cluster, error)
        if not is_idle:
            wake.idle_from = inf
        elif wake.idle_from == inf:
            wake.idle_from = self._runtime.monotonic()

    def _try(self, wake: _Wake) -> None:
        objects = self._caches[wake.cluster].objects() if wake.cluster in self._caches else {}
        wake.idle_from, wake.handled = inf, {}
        with suppress(Exception):  # an odd object must not keep its cluster from being woken
            wake.handled = {
                domain: Flux().handled_request(domain, objects) for domain in wake.domains
            }
        try:
            self._call(wake)
            wake.pushed = None
        except Exception as error:
            wake.handled = {}
            if wake.pause == _FIRST_RETRY_S:
                # the texts of other errors may have URLs and secrets
                is_ours = isinstance(error, NoAnswer | InvalidInput)
                self._tell(wake.cluster, str(error) if is_ours else type(error).__name__)
            if wake.pause > _LONGEST_RETRY_S:
                wake.pushed = None  # give up
            wake.next_try = self._runtime.monotonic() + wake.pause
            wake.pause *= 2
        self._note_idle(wake)

    def _call(self, wake: _Wake) -> None:
        assert self._config is not None  # noqa: S101 - without a push there is no wake
        name, settings = wake.cluster, self._config.repo_settings
        access = self._clusters[name]
        argocd = settings.argocd if settings.gitops == "argocd" else None
        if argocd and access.webhook:
            before = self._reported.get(name, "")
            commit, paths = self._changes_since(before)
            if paths is not None:
                # Name a file in each domain's folder too: Argo CD refreshes only Applications
                # with changed files, and only a refreshed Application reports the new commit.
                # Files of the ledger and of other clusters concern no Application of this cluster.
                own, others = f"clusters/{name}/", ("clusters/", "ledger/")
                paths = [p for p in paths if p.startswith(own) or not f"{p}/".startswith(others)]
                paths += [f"{own}{domain.name}/_domain.yaml" for domain in wake.domains]
            call_argocd(access.webhook, access.secret(), argocd.url, before, commit, paths)
            self._reported[name] = commit
        elif access.receiver and not argocd:
            # a Receiver ignores the body
            _send(access.receiver, b"{}", access.secret(), "X-Signature", {})
        elif access.kubeconfig:
            cache, asked_at = self._caches[name], {REQUESTED_AT: self._runtime.now().isoformat()}
            for domain in wake.domains:
                if domain.application is not None:
                    cache.annotate(domain.application, {"argocd.argoproj.io/refresh": "normal"})
                else:
                    source = ObjectSelector("GitRepository", domain.namespace, settings.source)
                    cache.annotate(source, asked_at)
        else:
            missing = "webhook" if argocd else "receiver"
            raise NoAnswer(f"it has neither a kubeconfig nor a {missing}")


def _followed(domains: tuple[ClusterDomain, ...]) -> list[ObjectSelector]:
    kinds = ("GitRepository", "Kustomization")
    return [ObjectSelector(kind, domain.namespace) for domain in domains for kind in kinds]
