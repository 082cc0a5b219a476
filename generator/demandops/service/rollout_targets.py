"""What a demand is to come to on the clusters: the releases that it needs, or gives up."""

from __future__ import annotations

from demandops.cluster.health import ClusterDomain, ObjectName, Target
from demandops.config.repo_settings import RepoSettings
from demandops.decision import Decision, State
from demandops.demand.claim import Subject, SubjectKind
from demandops.demand.demand_request import DemandRequest
from demandops.errors import Refused
from demandops.ledger.ledger import Ledger
from demandops.plan.planner import plan
from demandops.plan.release import Release, ServiceRelease
from demandops.plan.release_keys import ReleaseKey, affected_keys, all_keys, keys_of
from demandops.render.gitops.argocd import project_of


def of_decision(before: Ledger, decision: Decision) -> tuple[Target, ...]:
    """Return every release that a demand needs, and those that run no more because of it."""
    after, config = decision.state.ledger, decision.state.config
    subjects = [*_asked(decision.request, after), *decision.changes.subjects()]
    keys: dict[ReleaseKey, None] = {}
    for subject in dict.fromkeys(subjects):
        keys |= dict.fromkeys(keys_of(after, config, subject))
    keys |= dict.fromkeys(affected_keys(before, after, config, decision.changes.subjects()))
    found = []
    for key in keys:
        new = plan(after, config, key)
        old = None
        if new is None:
            try:
                old = plan(before, config, key)
            except Refused:
                continue
        release = new or old
        if release is not None:
            found.append(_target(release, config.repo_settings, wanted=new is not None))
    return tuple(dict.fromkeys(found))


def of_state(state: State) -> list[tuple[Release, Target]]:
    """Return every release that the state asks for, by name, and what it is to come to."""
    found = []
    for key in all_keys(state.ledger, state.config):
        release = plan(state.ledger, state.config, key)
        if release is not None:
            target = _target(release, state.config.repo_settings, wanted=True)
            found.append((release, target))
    return sorted(found, key=lambda pair: (pair[1].domain.cluster, pair[1].name))


def _asked(request: DemandRequest, ledger: Ledger) -> list[Subject]:
    subjects = [claim.subject for claim in ledger.claims_of_demand(request.demand)]
    if request.operation.adds_claims:
        subjects += [Subject(SubjectKind.APPLICATION, app.id) for app in request.applications]
        subjects += [Subject(SubjectKind.CONNECTION, one.id) for one in request.connections]
    return subjects


def _target(release: Release, repository: RepoSettings, *, wanted: bool) -> Target:
    domain, over = release.domain, None
    if repository.gitops == "argocd" and repository.argocd:
        over = ObjectName(repository.argocd.namespace, project_of(domain, repository))
    place = ClusterDomain(release.node.cluster, domain.name, domain.namespace, over)
    return Target(place, release.name, isinstance(release, ServiceRelease), wanted)
