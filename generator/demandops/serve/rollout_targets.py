"""The releases that a demand needs or removes, as targets whose rollout can be followed."""

from __future__ import annotations

from demandops.base.errors import Refused
from demandops.cluster.health.release_health import ClusterDomain, ObjectName, Target
from demandops.decide.decision import Decision
from demandops.decide.planning.overrides import without_suspended
from demandops.decide.planning.planner import plan
from demandops.decide.planning.release_keys import affected_keys, all_keys, keys_of_claims
from demandops.decide.state import State
from demandops.model.config.policy import AccessDomain
from demandops.model.config.repo_settings import RepoSettings
from demandops.model.ledger.ledger import World
from demandops.model.release import Release, ServiceRelease
from demandops.render.argocd import project_of
from demandops.render.paths import domains_in_use


def targets_of_decision(before: World, decision: Decision) -> tuple[Target, ...]:
    """Return the targets of the releases that a demand needs, changes or removes.

    A release that only other demands need is left out, even if they share a subject with this one.
    """
    after, request = decision.state, decision.request
    active = without_suspended(after)
    claims = [*active.ledger.claims_of_demand(request.demand)]

    for demanded in request.demanded if request.adds_claims else ():
        for requester in demanded.requesters:
            claims += active.ledger.claims_held_by(requester, demanded.held.subject)
    changed = affected_keys(before, after, decision.changes.claims)
    targets = []
    for key in dict.fromkeys((*keys_of_claims(active, claims), *changed)):
        new = after.plans.get(key) or plan(after, key)
        try:
            release = new or plan(before, key)
        except Refused:
            continue
        if release is not None:
            targets.append(target_of(release, after.config.repo_settings, wanted=new is not None))
    return tuple(dict.fromkeys(targets))


def targets_of_state(state: State) -> list[tuple[Release, Target]]:
    """Return every release of a state with its target, sorted by cluster and name."""
    releases = []
    for key in all_keys(state):
        release = plan(state, key)
        if release is not None:
            target = target_of(release, state.config.repo_settings)
            releases.append((release, target))
    return sorted(releases, key=lambda pair: (pair[1].domain.cluster, pair[1].name))


def domains_of_state(state: State) -> list[ClusterDomain]:
    """Return every access domain of each cluster, including domains without releases."""
    settings = state.config.repo_settings
    return [
        cluster_domain(cluster, domain, settings)
        for cluster, domain in domains_in_use(state.config)
    ]


def cluster_domain(cluster: str, domain: AccessDomain, repository: RepoSettings) -> ClusterDomain:
    application = None  # with Argo CD, the Application that applies the folder of the domain
    if repository.gitops == "argocd" and repository.argocd:
        application = ObjectName(repository.argocd.namespace, project_of(domain, repository))
    return ClusterDomain(cluster, domain.name, domain.namespace, application)


def target_of(release: Release, repository: RepoSettings, *, wanted: bool = True) -> Target:
    domain = cluster_domain(release.node.cluster, release.domain, repository)
    return Target(domain, release.name, isinstance(release, ServiceRelease), wanted)
