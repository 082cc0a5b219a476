"""The steps on the clusters when a state repo is upgraded, or switches to Flux or Argo CD.

This module runs nothing. It returns instructions and commands for a person, and their order
matters. First the person stops the old controller, because it would remove the workloads when its
releases leave the state repo.

To stop Flux, the person suspends Flux, and deletes Flux's objects only after Argo CD has taken
over. To stop Argo CD, the person removes the finalizers of its Applications, and then deletes the
Applications.
"""

from __future__ import annotations

from collections.abc import Container, Iterator
from dataclasses import dataclass

from demandops.config.config import Config
from demandops.config.policy import AccessDomain
from demandops.render.gitops.argocd import project_of
from demandops.render.gitops.paths import bootstrap_path, domains_by_cluster

_SUSPEND = """'{"spec":{"suspend":true}}'"""
_DROP_FINALIZERS = """'{"metadata":{"finalizers":null}}'"""
_OURS = "app.kubernetes.io/managed-by=demandops"
_FLUX_KINDS = "helmrelease,helmchart,helmrepository,ocirepository"


@dataclass(frozen=True, slots=True)
class Step:
    """An instruction for one cluster, and the commands that carry it out."""

    cluster: str
    description: str
    commands: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class SwitchSteps:
    """The steps that a person takes on the clusters before and after the state repo changes."""

    before: tuple[Step, ...] = ()
    after: tuple[Step, ...] = ()


def switch_steps(old: Config, new: Config, changed: Container[str]) -> SwitchSteps:
    """Return the steps to switch the GitOps controller, or to apply changed bootstrap files again.

    The steps delete no workload (docs/argocd.md has the reasons).

    Args:
        old, new: the configuration before and after.
        changed: the paths of the generated files that change.
    """
    if old.repo_settings.gitops == new.repo_settings.gitops:
        clusters = [one for one in domains_by_cluster(new) if bootstrap_path(one) in changed]
        return SwitchSteps(after=tuple(map(_bootstrap_again, clusters)))
    if new.repo_settings.gitops == "argocd":
        return SwitchSteps(tuple(_suspend_flux(new)), tuple(_finish_switch_to_argocd(new)))
    return SwitchSteps(tuple(_delete_applications(old)), tuple(_finish_switch_to_flux(new)))


def _suspend_flux(config: Config) -> Iterator[Step]:
    for cluster, domains in domains_by_cluster(config).items():
        commands = []
        for domain in domains:
            kubectl = f"kubectl -n {domain.namespace}"
            suspend = f"--type merge -p {_SUSPEND}"
            commands.append(f"{kubectl} patch kustomization {domain.name} {suspend}")
            commands.append(
                f"{kubectl} get helmrelease -l {_label(domain)} -o name | "
                f"xargs -r {kubectl} patch {suspend}"
            )
        yield Step(cluster, "suspend Flux, so that it does not prune the workloads", (*commands,))


def _finish_switch_to_argocd(config: Config) -> Iterator[Step]:
    for cluster, domains in domains_by_cluster(config).items():
        yield _follow(cluster, "wait until all Applications are Synced")
        commands = []
        for domain in domains:
            kubectl = f"kubectl -n {domain.namespace}"
            # delete Helm's records of releases, because a later Flux would continue from them
            commands.append(
                f"{kubectl} get helmrelease -l {_label(domain)} -o name | sed s,.*/,, | "
                f"xargs -r -I NAME {kubectl} delete secret -l owner=helm,name=NAME"
            )
            commands.append(f"{kubectl} delete {_FLUX_KINDS} -l {_label(domain)}")
            commands.append(f"{kubectl} delete kustomization {domain.name}")
        commands += [
            f"kubectl -n {namespace} delete gitrepository {config.repo_settings.source}"
            for namespace in _namespaces(domains)
        ]
        description = "delete Flux's objects; because Flux is suspended, no workload is removed"
        yield Step(cluster, description, (*commands,))


def _label(domain: AccessDomain) -> str:
    """Return the label that Flux puts on everything that a domain's Kustomization applies."""
    return f"kustomize.toolkit.fluxcd.io/name={domain.name}"


def _delete_applications(config: Config) -> Iterator[Step]:
    section = config.repo_settings.argocd
    assert section is not None  # noqa: S101 - required when gitops is "argocd"
    for cluster, domains in domains_by_cluster(config).items():
        commands = []
        for domain in domains:
            name, kubectl = (
                project_of(domain, config.repo_settings),
                f"kubectl -n {section.namespace}",
            )
            commands.append(
                f"{kubectl} patch application {name} --type merge -p {_DROP_FINALIZERS}"
            )
            commands.append(f"{kubectl} delete application {name}")
        for namespace in _namespaces(domains):
            kubectl = f"kubectl -n {namespace}"
            commands.append(
                f"{kubectl} get application -l {_OURS} -o name | "
                f"xargs -r {kubectl} patch --type merge -p {_DROP_FINALIZERS}"
            )
            commands.append(f"{kubectl} delete application -l {_OURS}")
        commands += [
            f"kubectl -n {section.namespace} delete appproject "
            f"{project_of(domain, config.repo_settings)}"
            for domain in domains
        ]
        description = (
            "remove the finalizers of Argo CD's Applications, so that their workloads stay; then "
            "delete the Applications and AppProjects"
        )
        yield Step(cluster, description, (*commands,))


def _finish_switch_to_flux(config: Config) -> Iterator[Step]:
    for cluster in domains_by_cluster(config):
        yield _follow(cluster, "Flux adopts the running workloads by itself")


def _follow(cluster: str, then: str) -> Step:
    return Step(cluster, f"make the cluster follow the repo again; then {then}", (_apply(cluster),))


def _bootstrap_again(cluster: str) -> Step:
    description = "apply the cluster's bootstrap file again, because the file changed"
    return Step(cluster, description, (_apply(cluster),))


def _apply(cluster: str) -> str:
    return f"git show main:{bootstrap_path(cluster)} | kubectl apply -f -"


def _namespaces(domains: list[AccessDomain]) -> list[str]:
    return sorted({domain.namespace for domain in domains})
