"""The settings of a state repo in ``demandops.yaml``: its GitOps controller, source and forge."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import StringConstraints, model_validator

from demandops.base.quoting import quoted
from demandops.model.config import base_model
from demandops.model.config.base_model import CamelModel, DnsLabel, FileModel, FrozenModel, Positive

ROOT_FILE = "demandops.yaml"

_GIT_URL = re.compile(r"(https?|ssh)://[^\s:@]+(@[^\s:@]+)?(:\d+)?/\S+")
_SCP = re.compile(r"(?P<user>[^\s:@/]+)@(?P<host>[^\s:@/]+):(?!\d+/)(?P<path>[^\s/]\S*)")


def as_git_url(text: str) -> str:
    # `git@host:path` is Git's short form of a URL
    scp = _SCP.fullmatch(text)
    return f"ssh://{scp['user']}@{scp['host']}/{scp['path']}" if scp else text


# The address is in files of the repo and in the clusters, so it must not hold a password. Git's
# short form `user@host:path` is refused, because the controllers read only URLs.
def _git_url_problem(text: str) -> str:
    if _GIT_URL.fullmatch(text):
        return ""
    url = as_git_url(text)
    if url != text:
        return f"{quoted(text)} is not a URL, but the GitOps controllers need one; write {url}"
    return (
        f"{quoted(text)} is not a URL that clusters can fetch; write https://HOST/PATH or "
        "ssh://USER@HOST/PATH, without a password or token"
    )


GitUrl = Annotated[str, base_model.without(_git_url_problem), base_model.Visible]


class Flux(FrozenModel):
    """How Flux fetches this repo. Each access domain has a GitRepository with these settings.

    Without ``url`` there are no bootstrap files, so no cluster can follow the repo.
    """

    url: GitUrl | None = None
    interval: Annotated[
        str, StringConstraints(pattern=r"^(\d+h)?(\d+m)?(\d+s)?$", min_length=2)
    ] = "1m"
    secret: DnsLabel | None = None


class ArgoCd(FrozenModel):
    """How Argo CD fetches this repo, and the namespace that Argo CD runs in.

    Argo CD finds the credentials in a Secret of this namespace. The Secret names the URL.
    """

    url: GitUrl
    namespace: DnsLabel = "argocd"


# A token is sent there, so plain HTTP is only for this machine
_WEB_URL = re.compile(
    r"(https://[^\s:@/?#]+|http://(127\.0\.0\.1|localhost|\[::1\]))(:\d+)?(/[^\s?#]*)?"
)


def _web_url_problem(text: str) -> str:
    if _WEB_URL.fullmatch(text):
        return ""
    return (
        f"{quoted(text)} is not an address that a token may be sent to; write "
        "https://HOST/PATH, without a user (plain http only for this machine)"
    )


WebUrl = Annotated[str, base_model.without(_web_url_problem), base_model.Visible]


class Proposals(FrozenModel):
    """The forge where the generator proposes demands that need approval.

    With ``none``, the generator pushes the proposal's branch, but opens no pull request. With
    GitLab, the push options of the branch open a merge request. With GitHub and Gitea (Forgejo),
    the generator opens a pull request through the API, whose address follows from ``url`` unless
    ``api`` gives it.
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
        path = (self.url or "").partition("://")[2].partition("/")[2]
        return tuple(path.strip("/").removesuffix(".git").split("/")[-2:]) if path else ()


class Limits(CamelModel):
    """The sizes above which a demand is refused.

    ``demand_characters`` limits the length of the whole demand. ``demand_items`` limits how many
    things (applications, connections, topics, requesters and so on) the demand lists in total,
    together with the connections that it needs. ``parameter_bytes`` limits the parameters of an
    application, written as JSON. ``file_bytes`` limits each file that the generator writes for the
    demand, because Kubernetes stores no object above 1.5 MB. ``decision_milliseconds`` limits the
    processor time in which a generator decides the demand, because other demands wait meanwhile.
    """

    demand_characters: Positive = 1_000_000
    demand_items: Positive = 10_000
    parameter_bytes: Positive = 100_000
    file_bytes: Positive = 1_000_000
    decision_milliseconds: Positive = 500


class RepoSettings(FileModel):
    """``demandops.yaml``: the settings of the whole state repo.

    The file may contain both ``flux`` and ``argocd``. Only the section that ``gitops`` names is
    used. ``placement`` is the rule by which the generator chooses among the nodes that fit an
    application (:mod:`.placement`).
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
    signed_off_by: (
        Annotated[str, StringConstraints(pattern=r"^[^<>\s][^<>\n]* <[^<>\s]+@[^<>\s]+>$")] | None
    ) = None
