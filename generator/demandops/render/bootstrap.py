"""The digest of a bootstrap file, which shows which version of the file a cluster has.

A person applies the file, so the cluster may have an older version of it. The object that applies
an access domain's folder has the digest of the applied file as an annotation. ``demandops status``
compares this digest with that of the file in the state repo. The functions here are pure.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

from demandops.base import strict_yaml
from demandops.base.errors import InvalidInput
from demandops.model.config.config import Config
from demandops.model.config.inventory import NODE_LABEL
from demandops.model.config.policy import AccessDomain

ANNOTATION = "demandops/bootstrap"
_LENGTH = 16


def with_digest(render: Callable[[str], str]) -> str:
    """Return the text of a bootstrap file that contains its own digest.

    ``render`` returns the text with a given digest. The digest covers neither itself nor comments.
    """
    return render(_digest(render("")))


@lru_cache(maxsize=256)  # most changes of a configuration leave the bootstrap files as they are
def _digest(text: str) -> str:
    objects = json.dumps(list(strict_yaml.load_all(text)), sort_keys=True)
    return hashlib.sha256(objects.encode()).hexdigest()[:_LENGTH]


def digest_of(item: Mapping[str, Any]) -> str:
    """Return the digest in an object's annotations; empty if there is none."""
    annotations = (item.get("metadata") or {}).get("annotations") or {}
    return str(annotations.get(ANNOTATION, ""))


@lru_cache(maxsize=1024)  # the web page asks for the same files repeatedly
def digest_in(text: str) -> str:
    """Return the digest in the text of a bootstrap file; empty if there is none."""
    try:
        items = list(strict_yaml.load_all(text))
    except InvalidInput:
        return ""
    return next(filter(None, (digest_of(item) for item in items if isinstance(item, dict))), "")


# ---- the rule by which a cluster lets pods of an access domain run only on the domain's nodes ----
#
# The rule is an expression of the Common Expression Language. Its variable ``variables.selector``
# is a pod's node selector. For nodes with the default selector, the rule contains the patterns of
# the policy instead of the nodes' names. So a new vehicle with this selector does not change the
# rule, and no person has to apply the rule again.

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
