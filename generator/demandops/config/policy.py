"""Access domains: who may demand what, where, how much of it and for how long.

A domain is a set of nodes with one namespace and one service account. What a demand asks of a node
is held to the rules, quotas and leases of the node's domain.
"""

from __future__ import annotations

import re
from fnmatch import fnmatchcase
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from demandops.config.base_model import Approval, DnsLabel, FileModel, FrozenModel
from demandops.errors import quoted

_DURATION = re.compile(r"(?:([0-9]{1,9})d)?(?:([0-9]{1,9})h)?(?:([0-9]{1,9})m)?(?:([0-9]{1,9})s)?")
_UNITS_S = (86_400, 3_600, 60, 1)
_YEAR_S = 366 * 86_400


def seconds_of(text: str) -> int:
    """Return the seconds of a duration like ``1h30m``.

    Raises:
        ValueError: where it is none.
    """
    match = _DURATION.fullmatch(text)
    if not text or match is None:
        raise ValueError(f"{quoted(text)} is no duration; write one like 90s, 10m, 1h30m or 2d")
    seconds = sum(int(part) * unit for part, unit in zip(match.groups("0"), _UNITS_S, strict=True))
    if seconds > _YEAR_S:
        raise ValueError(f"'{text}' is longer than a year; choose a shorter duration")
    return seconds


def _duration(text: str) -> str:
    seconds_of(text)
    return text


Duration = Annotated[str, AfterValidator(_duration)]
Patterns = Annotated[tuple[str, ...], Field(strict=False, min_length=1)]


def matches(name: str, patterns: tuple[str, ...]) -> bool:
    """Tell whether a name is one of ``patterns`` (``*`` and ``?``; a bracket is a bracket)."""
    return any(fnmatchcase(name, pattern.replace("[", "[[]")) for pattern in patterns)


class Rule(FrozenModel):
    """What some requesters may demand; a demand needs one rule for each of its requesters.

    ``nodes`` are those where it runs or where a connection ends, ``brokers`` the nodes of brokers.
    ``approval`` is the access domain's where it is left out.
    """

    name: DnsLabel
    requesters: Patterns = ("*",)
    applications: Patterns = ("*",)
    nodes: Patterns = ("*",)
    brokers: Patterns = ("*",)
    approval: Approval | None = None


class Quotas(FrozenModel):
    """How much at most; no limit where one is left out.

    ``demands_per_minute`` counts what one generator receives from a requester.
    """

    claims_per_requester: Annotated[int, Field(ge=1)] | None = Field(
        default=None, alias="claimsPerRequester"
    )
    services_per_node: Annotated[int, Field(ge=1)] | None = Field(
        default=None, alias="servicesPerNode"
    )
    demands_per_minute: Annotated[int, Field(ge=1)] | None = Field(
        default=None, alias="demandsPerMinute"
    )


class LeasePolicy(FrozenModel):
    """How long a demand holds without being renewed.

    ``default`` is for demands that ask for no lease, for ever where it is left out. It covers the
    reference's ``DeploymentRequest`` only where ``deployment_requests`` says so: its clients must
    then send their demands again in time. ``slack`` is how far the recorded end may lag behind the
    last renewal, and so how late a claim may go.
    """

    default: Duration | None = None
    longest: Duration | None = None
    slack: Duration = "30s"
    deployment_requests: bool = Field(default=False, alias="deploymentRequests")

    @model_validator(mode="after")
    def _consistent(self) -> LeasePolicy:
        for name in ("default", "longest"):
            value = getattr(self, name)
            if value is not None and seconds_of(value) < 1:
                raise ValueError(f"{name} is no time at all; leave it out for no limit")
        if self.deployment_requests and self.default is None:
            raise ValueError("deploymentRequests needs a default: such a demand names no lease")
        if self.default and self.longest and seconds_of(self.default) > seconds_of(self.longest):
            raise ValueError(f"default {self.default} is above longest {self.longest}")
        return self


class AccessDomain(FrozenModel):
    """A namespace and service account, the nodes whose releases live in it, and who may use them.

    Without ``rules`` everybody may demand everything on its nodes.
    """

    name: DnsLabel
    namespace: DnsLabel
    service_account: DnsLabel = Field(default="demandops", alias="serviceAccount")
    nodes: tuple[str, ...] = Field(default=("*",), strict=False)
    rules: tuple[Rule, ...] = Field(default=(), strict=False)
    quotas: Quotas = Quotas()
    leases: LeasePolicy = LeasePolicy()
    network: Literal["open", "namespace"] = "open"
    approval: Approval = "none"

    @model_validator(mode="after")
    def _named_once(self) -> AccessDomain:
        names = [rule.name for rule in self.rules]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"rules: two are called '{name}'; refusals name the rule")
        return self


class AccessDomainsFile(FileModel):
    """``policy/access-domains.yaml``."""

    kind: Literal["AccessDomains"]
    domains: tuple[AccessDomain, ...] = Field(strict=False)
