"""What a person does on the clusters when a state repo goes over to the other GitOps controller.

Pure: words and commands, made from the names that rendering gives. The order matters. A controller
that is still at work when its releases leave the repo would remove what runs, so it is stopped
before; it is taken off only when the other one has taken over.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from demandops.config.config import Config
from demandops.config.policy import AccessDomain
from demandops.render.gitops.argocd import project_of
from demandops.render.gitops.paths import bootstrap_path, domains_by_cluster

_SUSPEND = """'{"spec":{"suspend":true}}'"""
_LET_GO = """'{"metadata":{"finalizers":null}}'"""
_OURS = "app.kubernetes.io/managed-by=demandops"
_FLUXS = "helmrelease,helmchart,helmrepository,ocirepository"


@dataclass(frozen=True, slots=True)
class Step:
    """One thing to do, and the commands that do it on one cluster."""

    cluster: str
    what: str
    commands: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Handover:
    """What to do on the clusters before the state repo changes, and after."""

    before: tuple[Step, ...] = ()
    after: tuple[Step, ...] = ()


def handover(old: Config, new: Config) -> Handover:
    """Return what is to be done for a state repo to go from one controller to the other.

    Nothing is deleted on the way: docs/argocd.md has the reasons, and the end-to-end tests do it.
    """
    if old.repo_settings.gitops == new.repo_settings.gitops:
        return Handover()
    if new.repo_settings.gitops == "argocd":
        return Handover(tuple(_suspend_flux(new)), tuple(_from_flux(new)))
    return Handover(tuple(_let_argocd_go(old)), tuple(_from_argocd(new)))


def _suspend_flux(config: Config) -> Iterator[Step]:
    for cluster, domains in domains_by_cluster(config).items():
        commands = []
        for domain in domains:
            kubectl = f"kubectl -n {domain.namespace}"
            suspend = f"--type merge -p {_SUSPEND}"
            commands.append(f"{kubectl} patch kustomization {domain.name} {suspend}")
            commands.append(
                f"{kubectl} get helmrelease -l {_of(domain)} -o name | "
                f"xargs -r {kubectl} patch {suspend}"
            )
        yield Step(
            cluster, "suspend Flux, which would remove what it no longer finds", (*commands,)
        )


def _from_flux(config: Config) -> Iterator[Step]:
    for cluster, domains in domains_by_cluster(config).items():
        yield _follow(cluster, "wait until all Applications are Synced")
        commands = []
        for domain in domains:
            kubectl = f"kubectl -n {domain.namespace}"
            commands.append(  # Helm's notes, which would have Flux go on from them one day
                f"{kubectl} get helmrelease -l {_of(domain)} -o name | sed s,.*/,, | "
                f"xargs -r -I NAME {kubectl} delete secret -l owner=helm,name=NAME"
            )
            commands.append(f"{kubectl} delete {_FLUXS} -l {_of(domain)}")
            commands.append(f"{kubectl} delete kustomization {domain.name}")
        commands += [
            f"kubectl -n {namespace} delete gitrepository {config.repo_settings.source}"
            for namespace in _namespaces(domains)
        ]
        yield Step(cluster, "delete what Flux had; suspended, it removes nothing", (*commands,))


def _of(domain: AccessDomain) -> str:
    """Return the label that Flux puts on all that a domain's Kustomization applies."""
    return f"kustomize.toolkit.fluxcd.io/name={domain.name}"


def _let_argocd_go(config: Config) -> Iterator[Step]:
    section = config.repo_settings.argocd
    assert section is not None  # noqa: S101 - the configuration holds what gitops names
    for cluster, domains in domains_by_cluster(config).items():
        commands = []
        for domain in domains:
            name, kubectl = (
                project_of(domain, config.repo_settings),
                f"kubectl -n {section.namespace}",
            )
            commands.append(f"{kubectl} patch application {name} --type merge -p {_LET_GO}")
            commands.append(f"{kubectl} delete application {name}")
        for namespace in _namespaces(domains):
            kubectl = f"kubectl -n {namespace}"
            commands.append(
                f"{kubectl} get application -l {_OURS} -o name | "
                f"xargs -r {kubectl} patch --type merge -p {_LET_GO}"
            )
            commands.append(f"{kubectl} delete application -l {_OURS}")
        commands += [
            f"kubectl -n {section.namespace} delete appproject "
            f"{project_of(domain, config.repo_settings)}"
            for domain in domains
        ]
        what = "delete Argo CD's Applications without what they hold: finalizers first"
        yield Step(cluster, what, (*commands,))


def _from_argocd(config: Config) -> Iterator[Step]:
    for cluster in domains_by_cluster(config):
        yield _follow(cluster, "Flux adopts what is there")


def _follow(cluster: str, then: str) -> Step:
    show = f"git show main:{bootstrap_path(cluster)} | kubectl apply -f -"
    return Step(cluster, f"have the cluster follow the repo again; {then}", (show,))


def _namespaces(domains: list[AccessDomain]) -> list[str]:
    return sorted({domain.namespace for domain in domains})
