"""Where a release goes: the node, and the access domain that it is in."""

from __future__ import annotations

import shlex

from generator.catalog.catalog import DOMAINS_FILE, NODES_FILE, Catalog
from generator.catalog.inventory import Node
from generator.catalog.policy import AccessDomain
from generator.errors import Refused, fault


def place(catalog: Catalog, node_id: str) -> tuple[Node, AccessDomain]:
    """Return a node and its access domain.

    Raises:
        Refused: where what is in use was taken out of the inventory or the access domains.
    """
    node, domain = catalog.nodes.get(node_id), catalog.domain_of.get(node_id)
    if node is None or domain is None:
        missing = NODES_FILE if node is None else "any access domain"
        raise Refused(
            [
                fault(
                    "node",
                    f"'{node_id}' is in use, but not in {missing}; restore it, or give up "
                    f"what it holds: demandops decommission {shlex.quote(node_id)}",
                    code="unknown-node",
                ).within(NODES_FILE if node is None else DOMAINS_FILE)
            ]
        )
    return node, domain
