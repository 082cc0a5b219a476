"""The digest of a bootstrap file, which shows which version of the file a cluster has.

A person applies the file, so the cluster may have an older version of it. The object that applies
an access domain's folder has the digest of the applied file as an annotation. ``demandops status``
compares this digest with that of the file in the state repo. The functions here are pure.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

from demandops import strict_yaml
from demandops.errors import InvalidInput

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
