"""A state repo, the generator that writes it, and the access domains that clusters run of it.

The generator is a `demandops serve` process that pushes to the rig's Git server by smart HTTP.
"""

from __future__ import annotations

import os
import signal
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from tests.e2e.rig.cluster import Gitops, Rig
from tests.e2e.rig.kube import Kube, Manifest
from tests.kit.cli import PROGRAM, process
from tests.kit.repo import Person, git
from tests.kit.ros import Client, Sent, Served, Servers

from .argocd import ArgoDomain
from .domain import Domain
from .expected import CLUSTER, WITHOUT_DEMANDS, demand
from .flux import FluxDomain

DOMAINS: dict[Gitops, type[Domain]] = {"flux": FluxDomain, "argocd": ArgoDomain}


class Generator:
    def __init__(self, state_repo: str, folder: Path, ros_domain: int, client: Client) -> None:
        self._state_repo, self._client = state_repo, client
        self._servers = Servers(folder, ros_domain, **environment(folder))
        self._served: Served | None = None

    def start(self, *arguments: str) -> None:
        """Start the generator; wait until it accepts goals."""
        self._served = self._servers.start(self._state_repo, *arguments)
        self._served.wait_for("taking demands on")
        self._client.ready()

    def kill(self) -> None:
        self._servers.kill()

    def stop(self) -> None:
        """Ask the generator to end, if it runs."""
        if self._served is not None and self._served.process.poll() is None:
            self._served.stop(signal.SIGTERM)


class World:
    """A state repo, its generator, and the access domain on each cluster that follows it."""

    def __init__(self, rig: Rig, folder: Path, ros_domain: int, client: Client) -> None:
        self.rig, self.client, self.folder = rig, client, folder
        self.name = f"state-{uuid.uuid4().hex[:8]}.git"
        self.url = rig.git_url(self.name)
        bare = folder / "state.git"
        demandops(folder, "init", str(bare), "--bare", "--gitops", rig.gitops, "--url", self.url)
        git(bare, "push", "--quiet", self.url, "main")
        self.person = Person(self.url, folder / "person")
        self.generator = Generator(self.url, folder, ros_domain, client)
        self.domains: dict[str, Any] = {}
        self._wide: list[tuple[Kube, Manifest]] = []

    def begin(self, rig: Rig) -> None:
        """Let the cluster follow the state repo, and start the generator."""
        domain = self.bootstrap(CLUSTER, rig)
        self.generator.start()
        domain.wait_lines(WITHOUT_DEMANDS)

    def bootstrap(self, cluster: str, rig: Rig, **source: Any) -> Any:
        """Let a cluster follow the state repo, and return the access domain on that cluster.

        Apply `bootstrap/<cluster>.yaml`, and wait until it has taken effect. `source` replaces
        fields of a GitRepository there, as an operator may do with an overlay.
        """
        manifests = self.manifests(cluster)
        for item in manifests:
            if item["kind"] == "GitRepository":
                item["spec"].update(source)
        (domain,) = self.lay_down(rig, manifests)
        self.domains[cluster] = domain
        domain.settle(self.tip())
        return domain

    def manifests(self, cluster: str) -> list[Manifest]:
        return list(yaml.safe_load_all(self.file(f"bootstrap/{cluster}.yaml")))

    def lay_down(self, rig: Rig, manifests: list[Manifest]) -> list[Any]:
        """Apply a bootstrap file's manifests; return the access domains that they lay down.

        `remove` also removes what is cluster-wide of them, but no namespace.
        """
        rig.kube.apply(*manifests)
        self._wide += [
            (rig.kube, item)
            for item in manifests
            if "namespace" not in item["metadata"] and item["kind"] != "Namespace"
        ]
        return [one for kind in DOMAINS.values() for one in kind.all_in(rig.kube, manifests)]

    def remove(self) -> None:
        """Stop the generator and remove the state repo's objects; the namespaces stay."""
        self.generator.stop()
        for domain in self.domains.values():
            domain.remove()
        for kube, item in self._wide:
            kube.delete(item["kind"], item["metadata"]["name"], version=item["apiVersion"])
        self._wide.clear()
        self.domains.clear()

    @property
    def domain(self) -> Any:
        """The access domain on the only cluster that follows the state repo."""
        (only,) = self.domains.values()
        return only

    def file(self, path: str) -> str:
        self.person.fetch()
        return (self.person.folder / path).read_text()

    def git(self, *arguments: str) -> str:
        """Run git in a clone that has the newest commit."""
        self.person.fetch()
        return git(self.person.folder, *arguments)

    def tip(self) -> str:
        return self.git("rev-parse", "HEAD")

    def changed_by(self, commit: str) -> list[str]:
        return self.git("show", "--name-only", "--format=", commit).split()

    def commits_since(self, commit: str) -> int:
        return int(self.git("rev-list", "--count", f"{commit}..HEAD"))

    def push(self, files: Mapping[str, str | None], message: str = "by hand") -> str:
        """Commit and push files as a person would; try again if the generator pushed first."""
        while True:
            try:
                return self.person.push(files, message)
            except AssertionError as error:
                if "[rejected]" not in str(error):
                    raise

    def demandops(self, command: str, *arguments: str, or_exit: int = 0) -> str:
        """Run a command on the state repo, which may exit with `or_exit`; return its output."""
        words = (command, "--state-repo", self.url, *arguments)
        return demandops(self.folder, *words, or_exit=or_exit)

    def upgrade(self, gitops: Gitops | None = None) -> str:
        """Render the state repo anew, or for another controller; return the new commit."""
        self.demandops("upgrade", *(("--gitops", gitops) if gitops else ()))
        return self.tip()

    def demand(self, goal: dict[str, Any]) -> Sent:
        """Send a goal, check that it succeeds, and return it with its answer."""
        self.client.ready()
        sent = self.client.call(goal)
        assert sent.status == "succeeded", sent.message
        return sent

    def step(self, number: int, wanted: frozenset[str]) -> None:
        self.follow(self.demand(demand(number)), wanted)

    def follow(self, sent: Sent, wanted: frozenset[str]) -> None:
        """Wait until the cluster has applied a goal's commit, and its `lines` are as wanted."""
        self.domain.follow(sent.commit)
        self.domain.wait_lines(wanted)


def demandops(folder: Path, *arguments: str, or_exit: int = 0) -> str:
    ran = process(*PROGRAM, *arguments, env=environment(folder), cwd=folder, timeout=None)
    assert ran.code in (0, or_exit), f"demandops {' '.join(arguments)}: {ran.err}"
    return ran.out


def environment(folder: Path) -> dict[str, str]:
    """Return the environment for DemandOps: data and logs in `folder`, ROS on loopback."""
    return {
        **os.environ,
        "DEMANDOPS_DATA_HOME": str(folder / "data"),
        "GIT_TERMINAL_PROMPT": "0",
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(folder / "ros-log"),
    }
