"""The settings of a state repo in ``demandops.yaml``: its GitOps controller, source and forge."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Literal
from urllib.parse import urlsplit

from pydantic import Field, StringConstraints, model_validator

from demandops.base.addresses import as_git_url, holds_secret, url, without_secrets
from demandops.base.quantities import amount_of
from demandops.base.quoting import quoted
from demandops.model.config import base_model
from demandops.model.config.base_model import CamelModel, DnsLabel, FileModel, FrozenModel, Positive
from demandops.model.config.inventory import ResourceName

ROOT_FILE = "demandops.yaml"


# The address is in files of the repo and in the clusters, so it must not hold a password. Git's
# short form `user@host:path` is refused, because the controllers read only URLs.
def _git_url(text: str) -> None:
    if (long := as_git_url(text)) != text:
        raise ValueError(
            f"{quoted(text)} is not a URL, but the GitOps controllers need one; write {long}"
        )
    if holds_secret(text) or len(url(text, "https", "ssh", "http").path) < 2:
        raise ValueError(
            f"{quoted(without_secrets(text))} is not a URL that clusters can fetch; write "
            "https://HOST/PATH or ssh://USER@HOST/PATH, without a password or token"
        )


GitUrl = Annotated[str, base_model.readable_by(_git_url)]


class Flux(FrozenModel):
    """How Flux fetches this repo. Each access domain has a GitRepository with these settings.

    Without ``url`` there are no bootstrap files, so no cluster can follow the repo.
    """

    url: GitUrl | None = None
    interval: Annotated[
        str, StringConstraints(pattern=r"^([0-9]+h)?([0-9]+m)?([0-9]+s)?$", min_length=2)
    ] = "1m"
    secret: DnsLabel | None = None


class ArgoCd(FrozenModel):
    """How Argo CD fetches this repo, and its namespace, in which a Secret has the credentials."""

    url: GitUrl
    namespace: DnsLabel = "argocd"


# A token is sent there, so plain HTTP is only for this machine
def _web_url(text: str) -> None:
    parts = url(text, "https", "http")
    is_safe = parts.scheme == "https" or parts.hostname in ("127.0.0.1", "localhost", "::1")
    if not is_safe or parts.query or parts.fragment or "@" in parts.netloc:
        raise ValueError(
            f"{quoted(without_secrets(text))} is not an address that a token may be sent to; write "
            "https://HOST/PATH, without a user (plain http only for this machine)"
        )


WebUrl = Annotated[str, base_model.readable_by(_web_url)]


class Proposals(FrozenModel):
    """The forge where the generator proposes demands that need approval.

    With ``none``, the generator pushes the proposal's branch, but opens no pull request. With
    GitLab, the push options of the branch open a merge request. With the others, the API does so.
    """

    forge: Literal["none", "gitlab", "github", "gitea"] = "none"
    url: WebUrl | None = None
    api: WebUrl | None = None
    labels: base_model.Items[
        Annotated[str, StringConstraints(pattern=r"^[^\s,][^\n\r,]*$"), base_model.Visible]
    ] = ()

    @model_validator(mode="after")
    def _complete(self) -> Proposals:
        has_api = self.forge in ("github", "gitea")
        if has_api and (self.url is None or len(self.project) != 2):
            raise ValueError(
                f"'forge: {self.forge}' needs 'url', the project's address in a browser, like "
                "https://github.com/OWNER/REPOSITORY"
            )
        if self.api is not None and not has_api:
            raise ValueError(f"api: is not used with 'forge: {self.forge}'; leave it out")
        if self.labels and self.forge != "gitlab":
            raise ValueError("labels: are used only with 'forge: gitlab'; leave them out")
        return self

    @property
    def project(self) -> tuple[str, ...]:
        # owner and name: the last two parts of the path in `url`
        path = urlsplit(self.url or "").path.strip("/")
        return tuple(path.removesuffix(".git").split("/")[-2:]) if path else ()


class Limits(CamelModel):
    """The sizes above which a demand is refused.

    ``demand_items`` counts also the connections that a demand needs. ``file_bytes`` is less than
    the 1.5 MB that Kubernetes stores. Other demands wait for ``decision_milliseconds``.
    """

    demand_characters: Positive = 1_000_000
    demand_items: Positive = 10_000
    parameter_bytes: Positive = 100_000
    file_bytes: Positive = 1_000_000
    decision_milliseconds: Positive = 500


# What every Kubernetes node may have; any other resource has a domain in front: `nvidia.com/gpu`
_OF_KUBERNETES = re.compile("cpu|memory|ephemeral-storage|hugepages-.+")


class RepoSettings(FileModel):
    """``demandops.yaml``: the settings of the whole state repo.

    Only the section that ``gitops`` names is used.
    """

    kind: Literal["StateRepository"]
    gitops: Literal["flux", "argocd"]
    render_version: Positive
    source: DnsLabel = "demandops"
    flux: Flux | None = None
    argocd: ArgoCd | None = None
    proposals: Proposals = Proposals()
    limits: Limits = Limits()
    placement: Literal["nearest", "spread", "pack"] = "nearest"
    # Short names of resources; without a name of Kubernetes, only the generator counts it
    resources: dict[ResourceName, ResourceName | None] = Field(default_factory=dict)
    signed_off_by: (
        Annotated[str, StringConstraints(pattern=r"^[^<>\s][^<>\n]* <[^<>\s]+@[^<>\s]+>$")] | None
    ) = None

    @model_validator(mode="after")
    def _one_name_each(self) -> RepoSettings:
        names = self.kubernetes_names
        for name, resource in names.items():
            if "/" in name or _OF_KUBERNETES.fullmatch(name):
                raise ValueError(f"resources: '{name}' is Kubernetes' own name; leave it out")
            if resource and "/" not in resource:
                raise ValueError(
                    f"resources: '{resource}' has no domain; write one like nvidia.com/gpu"
                )
            if resource and (others := [n for n in names if n != name and names[n] == resource]):
                raise ValueError(
                    f"resources: '{name}' and '{others[0]}' are both {resource}; keep one name, or "
                    "give 'gpu' another resource, or null"
                )
        return self

    @property
    def kubernetes_names(self) -> dict[str, str | None]:
        return {"gpu": "nvidia.com/gpu", **self.resources}

    def with_short_names(self, amounts: Mapping[str, str]) -> dict[str, str]:
        short = {resource: name for name, resource in self.kubernetes_names.items() if resource}
        return {short.get(name, name): amount for name, amount in amounts.items()}

    def requests_of_pods(self, requests: Mapping[str, str]) -> dict[str, str]:
        """Return what Kubernetes' scheduler can count of a service's requests, by its own names."""
        named = ((self.kubernetes_names.get(name, name), of) for name, of in requests.items())
        return {
            name: amount
            for name, amount in sorted(named, key=str)
            # Kubernetes refuses a name of no domain, and a part of a GPU
            if name
            and (_OF_KUBERNETES.fullmatch(name) or ("/" in name and amount_of(amount) % 1000 == 0))
        }
