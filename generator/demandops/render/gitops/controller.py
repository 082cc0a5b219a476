"""The controller that the state repo is written for: Flux or Argo CD, as ``demandops.yaml`` says.

What is the same for both is here: a service's Helm values, and connections, which are plain
manifests.
"""

from __future__ import annotations

from demandops.config.config import Config
from demandops.plan.release import Release, ServiceRelease
from demandops.render import connections
from demandops.render.engine import Engine
from demandops.render.gitops import argocd, flux
from demandops.render.helm_values import values_of


def render(release: Release, config: Config, engine: Engine) -> str:
    """Return the one file of a release.

    Raises:
        InvalidInput: where an appdef's values template fails or its values break the chart's
            schema.
    """
    if not isinstance(release, ServiceRelease):
        return connections.render(release, config, engine)
    values = values_of(release, config, engine)
    if config.repo_settings.gitops == "argocd":
        return argocd.render(release, values, config.repo_settings, engine)
    return flux.render(release, values, engine)


def standing_files(config: Config, engine: Engine) -> dict[str, str]:
    """Return the files that stay when nothing is demanded.

    For each cluster what makes its controller follow the repo; for each access domain on it a
    placeholder: Git drops empty folders, and a missing folder makes Flux and Argo CD fail instead
    of pruning.
    """
    if config.repo_settings.gitops == "argocd":
        return argocd.standing_files(config, engine)
    return flux.standing_files(config, engine)
