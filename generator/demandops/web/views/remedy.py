"""Who can probably fix a release that is not ready, judged by the files and the cluster."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

from demandops.config.config import IMAGES_FILE, Config
from demandops.plan.release import Release, ServiceRelease
from demandops.staterepo.history.commit_log import GENERATOR_NAME, LogEntry

Kind = Literal["failing", "suspended", "invalid", "unread", "decision", "waiting", "starting"]

# The color of each kind of cause, in the order in which the view lists the kinds.
KINDS: dict[str, str] = {
    "unread": "bad",
    "failing": "bad",
    "invalid": "bad",
    "suspended": "bad",
    "decision": "busy",
    "waiting": "busy",
    "starting": "busy",
}

# A function that returns the newest commit that changed a file or folder, or None.
LastChange = Callable[[str], "LogEntry | None"]


@dataclass(frozen=True, slots=True)
class Remedy:
    """Who can fix a cause, how, and by which command; all but ``who`` may be empty."""

    who: str
    how: str = ""
    command: str = ""


# What kubelet and the scheduler write into a pod's status, which the reason of a release quotes.
_IMAGE = re.compile(r"ImagePull|ErrImage|InvalidImage|manifest unknown|pull access denied", re.I)
_ROOM = re.compile(r"not scheduled|Insufficient|didn't match|untolerated taint|unschedulable", re.I)
_CRASH = re.compile(r"CrashLoop|exit code|OOMKilled|RunContainerError", re.I)


def remedy_of(
    kind: Kind, release: Release, config: Config, object: str, reason: str, last_change: LastChange
) -> Remedy:
    """Return who can probably fix a release, and how.

    ``object`` names what is not ready: an object, such as ``Deployment perception/od-edge``, or a
    cluster that cannot be read. ``reason`` says why.
    """
    cluster, (word, _, name) = release.node.cluster, object.partition(" ")
    namespace, _, short = name.partition("/")
    describe = ["kubectl", "-n", namespace, "describe", word.lower(), short]
    command = shlex.join(describe) if short else ""
    if word == "cluster":
        how = "make its API reachable from here, and let this page read it (docs/status.md)"
        return Remedy(f"the operator of cluster {cluster}", how)
    if kind == "waiting" or word in ("Kustomization", "GitRepository", "Application"):
        who = f"the operator of the GitOps controller of cluster {cluster}"
        if kind != "failing":
            who = (
                f"the GitOps controller of cluster {cluster}; if the controller fails, its operator"
            )
        return Remedy(who, "", command)
    if kind == "starting":
        who = f"nobody yet; if this lasts, the operator of cluster {cluster}"
        return Remedy(who, "", command)
    if release.shaping.by:
        override = release.shaping.by[-1][0]
        return Remedy(
            f"{override.owner}, who owns {override.path}, which changes this release",
            f"correct or remove {override.path} by pull request",
            command,
        )
    if _ROOM.search(reason):
        return Remedy(
            f"the operator of node {release.node.id} in cluster {cluster}",
            "make room on the node, or name another node in the demand",
            command,
        )
    names = [name for name in release.images if name in config.images]
    if names and _IMAGE.search(reason):
        images = [
            release.image(name, config)
            if isinstance(release, ServiceRelease)
            else release.shaping.image(name, config.images[name])
            for name in names
        ]
        files = dict.fromkeys(config.file_of(IMAGES_FILE, name) for name in names)
        by = _changed_by(files, last_change)
        return Remedy(
            f"the publisher of image {', '.join(image.reference() for image in images)}",
            f"push the image, or correct its entry in {' or '.join(files)} by pull request{by}",
            command,
        )
    how = "look at the log of the container" if _CRASH.search(reason) else ""
    if not isinstance(release, ServiceRelease):
        return Remedy(f"the maintainer of the {release.type.word} client", how, command)
    where = f"appdefs/{release.service.folder}"
    by = _changed_by([where], last_change)
    return Remedy(f"the maintainer of {where}{by}", how, command)


def _changed_by(paths: Iterable[str], last_change: LastChange) -> str:
    """Return a text that names the people who last changed each path; empty if no person did."""
    changes = filter(None, map(last_change, paths))
    people = dict.fromkeys(change.author for change in changes if change.author != GENERATOR_NAME)
    return f" (last changed by {', '.join(people)})" if people else ""
