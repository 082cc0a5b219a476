"""The rule by which a cluster lets pods of an access domain run only on the domain's nodes.

The rule is an expression of the Common Expression Language. Its variable ``variables.selector`` is
a pod's node selector. For nodes with the default selector, the rule contains the patterns of
the policy instead of the nodes' names. So a new vehicle with this selector does not change the
rule, and no person has to apply the rule again.
"""

from __future__ import annotations

import json
import re

from demandops.config.config import Config
from demandops.config.inventory import NODE_LABEL
from demandops.config.policy import AccessDomain

_SELECTOR = "variables.selector"


def node_rule(cluster: str, domain: AccessDomain, config: Config) -> str:
    """Return the expression that is true if a pod's selector has all labels of a node's selector.

    Only nodes of the domain count.
    """
    by_label: dict[str, set[str]] = {}
    selectors: set[tuple[tuple[str, str], ...]] = set()
    for node in config.nodes.values():
        if node.selector is None or node.cluster != cluster:
            continue
        if config.domain_of.get(node.id) is not domain:
            continue
        if len(node.selector) == 1:
            ((label, value),) = node.selector.items()
            by_label.setdefault(label, set()).add(value)
        else:
            selectors.add(tuple(sorted(node.selector.items())))
    pattern = "|".join(map(expression_of, domain.nodes))
    parts = [_has(NODE_LABEL, f".matches({_text(f'^({pattern})$')})")]
    parts += [
        _has(label, f" in [{', '.join(map(_text, sorted(values)))}]")
        for label, values in sorted(by_label.items())
    ]
    for selector in sorted(selectors):
        labels = " && ".join(_has(label, f" == {_text(value)}") for label, value in selector)
        parts.append(f"({labels or 'true'})")  # a node with ``selector: {}`` takes every pod
    return " || ".join(parts)


def expression_of(pattern: str) -> str:
    """Return a pattern of the policy as a regular expression of RE2, without ``^`` and ``$``."""
    return "".join({"*": ".*", "?": "."}.get(char, re.escape(char)) for char in pattern)


def _has(label: str, test: str) -> str:
    return f"({_text(label)} in {_SELECTOR} && {_SELECTOR}[{_text(label)}]{test})"


def _text(value: str) -> str:
    return json.dumps(value, ensure_ascii=False)  # a JSON string is also a CEL string
