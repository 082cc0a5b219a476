"""A new node, access domain or override, each in a file of its own. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from demandops.config.config import DOMAINS_FILE, Config
from demandops.errors import InvalidInput
from demandops.naming import object_name
from demandops.scaffold.yaml_document import document


def node(id: str, type: str, cluster: str, config: Config) -> dict[str, str]:
    """Return a map from path to text, with a file for a new node.

    If the node's cluster is new too, the map also has a file for the cluster.

    Raises:
        InvalidInput: if a node of this id exists.
    """
    if id in config.nodes:
        raise InvalidInput.at("ID", f"'{id}' is a node already; choose another id")
    path = f"inventory/nodes/{object_name('', id)}.yaml"
    entry = {"id": id, "type": type, "cluster": cluster}
    note = (
        "The comments of inventory/nodes.yaml explain each field. `topics` names the usual topic\n"
        "for each input of applications."
    )
    found = {path: document(path, "nodes", "Nodes", {"nodes": [entry]}, note)}
    if cluster not in config.clusters:
        path = f"inventory/clusters/{cluster}.yaml"
        found[path] = document(path, "clusters", "Clusters", {"clusters": [{"name": cluster}]})
    return found


def access_domain(
    name: str, namespace: str, nodes: Iterable[str], requesters: Iterable[str], config: Config
) -> dict[str, str]:
    """Return a map from path to text: a file for a new access domain.

    Only requesters that match one of the patterns in ``requesters`` may demand something in the
    domain. Without patterns, everybody may demand everything.

    Raises:
        InvalidInput: if a domain of this name exists, or another domain has all nodes (``*``).
    """
    if name in config.domains:
        raise InvalidInput.at("NAME", f"'{name}' is an access domain already; choose another name")
    for other in config.domains.values():
        if "*" in other.nodes:
            file = config.file_of(DOMAINS_FILE, other.name)
            message = (
                f"access domain '{other.name}' has every node by its pattern '*', so no pattern of "
                "another access domain may match a node; narrow this pattern first"
            )
            raise InvalidInput.at("nodes", message, file=file)
    path = f"policy/access-domains/{name}.yaml"
    rules = [{"name": "all", "requesters": [*requesters]}] if requesters else []
    entry: dict[str, Any] = {"name": name, "namespace": namespace, "nodes": [*nodes]}
    entry |= {"rules": rules} if rules else {}
    note = "docs/policy.md of DemandOps explains rules, quotas, leases, kinds and podSecurity."
    return {path: document(path, "access-domains", "AccessDomains", {"domains": [entry]}, note)}


def override(
    name: str,
    reason: str,
    owner: str,
    select: Mapping[str, list[str]],
    effect: Mapping[str, Any],
    config: Config,
) -> dict[str, str]:
    """Return a map from path to text: a file for a new override with one effect.

    Raises:
        InvalidInput: if an override of this name exists.
    """
    if name in config.overrides:
        raise InvalidInput.at("NAME", f"'{name}' is an override already; choose another name")
    path = f"overrides/{name}.yaml"
    fields = {"reason": reason, "owner": owner, "select": [dict(select)], **effect}
    note = "overrides/README.md lists all effects and selectors of overrides, and when they end."
    return {path: document(path, "override", "Override", fields, note)}
