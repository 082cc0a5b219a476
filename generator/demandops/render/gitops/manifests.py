"""The manifests of the state repo, for the controller that ``demandops.yaml`` names.

A service's Helm values and the plain manifests of connections are the same for Flux and Argo CD.
"""

from __future__ import annotations

from demandops.config.config import Config
from demandops.plan.release import Release, ServiceRelease
from demandops.render import connection_client
from demandops.render.gitops import argocd, flux
from demandops.render.helm_values import values_of
from demandops.templating.values import Evaluate


def render(release: Release, config: Config, evaluate: Evaluate) -> str:
    """Return the manifests of a release as the text of one file.

    Raises:
        Refused: if the registry has no image for a communication client.
        InvalidInput: if the values of a service or the configuration of a client are not valid.
    """
    if not isinstance(release, ServiceRelease):
        return connection_client.render(release, config)
    values = values_of(release, config, evaluate)
    if config.repo_settings.gitops == "argocd":
        return argocd.render(release, values, config.repo_settings)
    return flux.render(release, values)


def base_files(config: Config) -> dict[str, str]:
    """Return the files that exist even without demands, by path."""
    # Each access domain of a cluster has a placeholder file, because Git keeps no empty folder.
    # Without the folder, Flux and Argo CD would fail instead of removing what is not demanded.
    if config.repo_settings.gitops == "argocd":
        return argocd.base_files(config)
    return flux.base_files(config)
