"""``demandops.yaml``: which GitOps controller reads the state repo, and how it reaches it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from generator.catalog.model import DnsLabel, FileModel, Frozen

ROOT_FILE = "demandops.yaml"

GitUrl = Annotated[
    str, StringConstraints(pattern=r"^(https?|ssh)://[^\s:@]+(@[^\s:@]+)?(:\d+)?/\S+$")
]


class Flux(Frozen):
    """How the clusters' Flux reaches this repo: the GitRepository of each access domain."""

    url: GitUrl
    interval: Annotated[
        str, StringConstraints(pattern=r"^(\d+h)?(\d+m)?(\d+s)?$", min_length=2)
    ] = "1m"
    secret: DnsLabel | None = None


class ArgoCd(Frozen):
    """How the clusters' Argo CD reaches this repo, and the namespace it runs in.

    Credentials are Argo CD's own: a Secret of that namespace that names the URL.
    """

    url: GitUrl
    namespace: DnsLabel = "argocd"


class Repository(FileModel):
    """``demandops.yaml``: what the whole state repo has in common.

    The section of the controller that is not chosen may stand there too, and waits.
    """

    kind: Literal["StateRepository"]
    gitops: Literal["flux", "argocd"]
    render_version: int = Field(alias="renderVersion", ge=1)
    source: DnsLabel = "demandops"
    flux: Flux | None = None
    argocd: ArgoCd | None = None
