"""Access domains: who may demand what, where, how much and for how long.

A domain is a set of nodes with one namespace and one service account. Its rules, quotas and leases
apply to demands for these nodes.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, StringConstraints, model_validator

from demandops.base.errors import suggestion
from demandops.base.quoting import quoted
from demandops.model.config import base_model
from demandops.model.config.base_model import CamelModel, DnsLabel, FileModel, FrozenModel, Items
from demandops.model.config.inventory import Credentials, NodeId, RosDomainId

Duration = Annotated[str, base_model.readable_by(base_model.seconds_of)]
Patterns = Annotated[tuple[base_model.Pattern, ...], Field(strict=False, min_length=1)]


class Rule(CamelModel):
    """Which demands some requesters may make. Each requester of a demand needs a rule that fits.

    ``nodes`` are the nodes of applications and the ends of connections. ``approval`` defaults to
    that of the access domain.
    """

    name: DnsLabel
    requesters: Patterns = ("*",)
    applications: Patterns = ("*",)
    nodes: Patterns = ("*",)
    brokers: Patterns = ("*",)
    peers: Items[base_model.Text] = ()
    manages: Items[base_model.Text] = ()
    approval: base_model.Approval | None = None


class Quotas(CamelModel):
    """The upper limits of an access domain. A field that is not given sets no limit.

    What exceeds a limit already, because the limit was lowered, may stay, but not grow.
    """

    claims_per_requester: base_model.Positive | None = None
    services_per_node: base_model.Positive | None = None
    demands_per_minute: base_model.Positive | None = None


class LeasePolicy(CamelModel):
    """The time that a demand's claims stay booked without a renewal.

    A demand that requests no lease gets ``default``, or ``longest`` if there is no ``default``. If
    neither is set, or the goal is a ``DeploymentRequest`` and ``deployment_requests`` is false, its
    claims last forever. The generator may release a claim late by ``slack``.
    """

    default: Duration | None = None
    longest: Duration | None = None
    slack: Duration = "30s"
    deployment_requests: bool = False

    @model_validator(mode="after")
    def _consistent(self) -> LeasePolicy:
        for name in ("default", "longest"):
            value = getattr(self, name)
            if value is not None and base_model.seconds_of(value) < 1:
                raise ValueError(f"{name} is zero; leave it out, or give a longer duration")
        if self.deployment_requests and self.default is None:
            raise ValueError("'deploymentRequests' needs a default lease; add 'default'")
        if (
            self.default
            and self.longest
            and base_model.seconds_of(self.default) > base_model.seconds_of(self.longest)
        ):
            message = f"'default' ({self.default}) is above 'longest' ({self.longest})"
            raise ValueError(f"{message}; lower 'default' or raise 'longest'")
        return self


class Kind(FrozenModel):
    """A kind of Kubernetes object, with its API group and the resource that a Role names."""

    kind: Annotated[str, StringConstraints(pattern=r"^[A-Z][A-Za-z0-9]*$")]
    group: Annotated[str, StringConstraints(pattern=r"^([a-z0-9]([a-z0-9.-]*[a-z0-9])?)?$")]
    resource: DnsLabel


# The kinds of Kubernetes objects that a policy may name by one word
KINDS = {
    kind: Kind(kind=kind, group=group, resource=resource)
    for group, kinds in {
        "": {
            "ConfigMap": "configmaps",
            "PersistentVolumeClaim": "persistentvolumeclaims",
            "Secret": "secrets",
            "Service": "services",
            "ServiceAccount": "serviceaccounts",
        },
        "apps": {
            "DaemonSet": "daemonsets",
            "Deployment": "deployments",
            "StatefulSet": "statefulsets",
        },
        "autoscaling": {"HorizontalPodAutoscaler": "horizontalpodautoscalers"},
        "batch": {"CronJob": "cronjobs", "Job": "jobs"},
        "networking.k8s.io": {"Ingress": "ingresses", "NetworkPolicy": "networkpolicies"},
        "policy": {"PodDisruptionBudget": "poddisruptionbudgets"},
        "rbac.authorization.k8s.io": {"Role": "roles", "RoleBinding": "rolebindings"},
    }.items()
    for kind, resource in kinds.items()
}

# Kinds that are allowed only if a policy names them. A DaemonSet runs on all nodes of a cluster,
# and not only on the demanded node.
NOT_BY_DEFAULT = ("DaemonSet",)

# The kinds that every domain needs, for the clients of connections and for Helm's releases
NEEDED_KINDS = ("ConfigMap", "Deployment", "Secret")

_NETWORK_POLICY = "NetworkPolicy"


def _by_word(value: object) -> object:
    if not isinstance(value, str):
        return value
    if value not in KINDS:
        raise ValueError(
            f"{quoted(value)} is not a kind that one word can name; give kind, group and "
            f"resource{suggestion(value, KINDS)}"
        )
    return KINDS[value]


_WORDS: Any = Literal.__getitem__(tuple(KINDS))
KindByWord = Annotated[Kind, BeforeValidator(_by_word, json_schema_input_type=_WORDS | Kind)]


class DomainRos(CamelModel):
    """The ROS domain of all nodes of an access domain."""

    domain_id: RosDomainId


class AccessDomain(CamelModel):
    """Nodes, the namespace and service account of their releases, and who may demand what there.

    Without ``rules``, all requesters may demand anything on its nodes, and no connection leaves the
    domain. ``broker`` is that of the target's domain, or else of the source's.
    """

    name: DnsLabel
    namespace: DnsLabel
    service_account: DnsLabel = "demandops"
    nodes: Items[base_model.Pattern] = ("*",)
    rules: Items[Rule] = ()
    quotas: Quotas = Quotas()
    leases: LeasePolicy = LeasePolicy()
    network: Literal["open", "namespace"] = "open"
    approval: base_model.Approval = "none"
    when_full: Literal["refuse", "wait"] = "refuse"
    kinds: Items[KindByWord] | None = None
    pod_security: Literal["baseline", "host-network", "privileged"] = "host-network"
    ros: DomainRos | None = None
    broker: NodeId | None = None
    broker_credentials: dict[NodeId, Credentials] = Field(default_factory=dict)

    @property
    def allowed_kinds(self) -> tuple[Kind, ...]:
        if self.kinds is not None:
            return self.kinds
        # with a NetworkPolicy, a chart could open the closed namespace
        without = {*NOT_BY_DEFAULT, *([_NETWORK_POLICY] if self.network == "namespace" else [])}
        return tuple(kind for name, kind in KINDS.items() if name not in without)

    def asks(self, rule: Rule) -> bool:
        """Return whether a person must approve what the rule grants."""
        return (rule.approval or self.approval) == "required"

    def how_to_allow(self, kind: str, file: str) -> str:
        if kind == _NETWORK_POLICY and self.network == "namespace":
            return f"remove 'network: namespace' of the domain in {file}"
        added = kind if kind in KINDS else f"{kind}, with its group and resource,"
        if self.kinds is not None:
            return f"add {added} to 'kinds' in {file}"
        return (
            f"list {added} in 'kinds' in {file} together with all kinds that the domain's charts "
            "have, because a list replaces the default kinds (docs/policy.md)"
        )

    @property
    def allowed_resources(self) -> dict[str, list[str]]:
        by_group: dict[str, list[str]] = {}
        for kind in self.allowed_kinds:
            by_group.setdefault(kind.group, []).append(kind.resource)
        return by_group

    @model_validator(mode="after")
    def _consistent(self) -> AccessDomain:
        kinds = self.allowed_kinds
        missing = [name for name in NEEDED_KINDS if KINDS[name] not in kinds]
        if missing:
            raise ValueError(
                f"kinds: lacks {' and '.join(missing)}, but connections and Helm's releases need "
                "them; add what is missing"
            )
        if self.network == "namespace" and KINDS[_NETWORK_POLICY] in kinds:
            raise ValueError(
                "kinds: NetworkPolicy lets a chart open what 'network: namespace' closes; remove "
                "NetworkPolicy from 'kinds', or remove 'network'"
            )
        names = [rule.name for rule in self.rules]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"rules: two rules have the name '{name}'; give each its own name")
        return self


class AccessDomainsFile(FileModel):
    """``policy/access-domains.yaml``, and files of ``policy/access-domains/``."""

    kind: Literal["AccessDomains"]
    domains: Items[AccessDomain]
