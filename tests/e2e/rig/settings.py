"""An existing cluster for the tests, if the environment names one.

With E2E_KUBECONFIG and E2E_GIT_URL the tests use an existing cluster (kind, k3d) with Flux and
kwok, and start nothing. For the rig <NAME>, E2E_KUBECONFIG_<NAME> replaces E2E_KUBECONFIG.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from . import RigError


@dataclass(frozen=True)
class Existing:
    kubeconfig: Path
    git_url: str
    push_url: str


def existing(name: str) -> Existing | None:
    """Return the existing cluster for the rig of this name; None if the rig must start its own."""
    own = f"E2E_KUBECONFIG_{name.upper().replace('-', '_')}"
    kubeconfig = os.environ.get(own) or os.environ.get("E2E_KUBECONFIG", "")
    git_url = os.environ.get("E2E_GIT_URL", "")
    if not kubeconfig and not git_url:
        return None
    if not kubeconfig or not git_url:
        missing = "E2E_GIT_URL" if kubeconfig else "E2E_KUBECONFIG"
        raise RigError(
            f"{missing} is not set: an existing cluster needs E2E_KUBECONFIG and E2E_GIT_URL "
            "(tests/e2e/README.md); unset both and the tests start a cluster of their own"
        )
    path = Path(kubeconfig).expanduser().resolve()
    if not path.is_file():
        raise RigError(f"E2E_KUBECONFIG={kubeconfig}: the file does not exist")
    push_url = os.environ.get("E2E_GIT_PUSH_URL") or git_url
    return Existing(path, git_url.rstrip("/"), push_url.rstrip("/"))
