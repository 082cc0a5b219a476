"""A pod whose containers run as processes of this machine."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass
class Container:
    """A container: its process, the times of its starts, and when it may start again."""

    name: str
    command: list[str]
    environment: dict[str, str]
    process: subprocess.Popen[bytes] | None = None
    starts: list[float] = field(default_factory=list)
    due: float = 0.0


@dataclass
class RunningPod:
    """A pod with its containers: `bound` is when it got a node, `ended` when it ended."""

    manifest: dict[str, Any]
    folder: Path
    bound: float
    containers: list[Container] = field(default_factory=list)
    ended: float | None = None

    @property
    def name(self) -> str:
        return str(self.manifest["metadata"]["name"])

    @property
    def service(self) -> str:
        """The name of the pod's release or connection client."""
        return str(self.manifest["metadata"]["labels"]["app.kubernetes.io/instance"])

    @property
    def node(self) -> str:
        """The name of the cluster node on which the pod runs."""
        return str(self.manifest["spec"]["nodeName"])

    def requests(self) -> tuple[float, float]:
        """Return the processor cores and the bytes of memory that the pod requests."""
        found = [c["resources"].get("requests", {}) for c in self.manifest["spec"]["containers"]]
        cores = sum(quantity(each.get("cpu", "0")) for each in found)
        return cores, sum(quantity(each.get("memory", "0")) for each in found)


def program_of(image: str) -> str:
    """Return the name of an image's stand-in program: the image's name without registry and tag."""
    return image.rpartition("/")[2].partition("@")[0].partition(":")[0]


def path_in_pod(text: str, mounts: Mapping[str, Path | str]) -> str:
    """Replace each path below a mount in ``text`` by its path on this machine; return the text."""
    if not mounts:
        return text
    longest_first = sorted(mounts, key=len, reverse=True)
    below = "|".join(map(re.escape, longest_first))
    # in one pass: a replacement may itself begin with the path of a mount, such as /tmp
    return re.sub(rf"(?<![\w./-])({below})(?=/|$)", lambda hit: str(mounts[hit[1]]), text)


_UNITS = {"m": 1e-3, "Ki": 2**10, "Mi": 2**20, "Gi": 2**30}


def quantity(text: str) -> float:
    """Return a Kubernetes quantity, such as `250m` or `1Gi`, as a number."""
    for unit, factor in _UNITS.items():
        if text.endswith(unit):
            return float(text.removesuffix(unit)) * factor
    return float(text)
