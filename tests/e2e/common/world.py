"""A state repo and the generator that writes it.

The generator is a `demandops serve` process that pushes to the rig's Git server by smart HTTP.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.e2e.argocd.view import Domain as ArgoDomain
from tests.e2e.flux.view import Domain as FluxDomain
from tests.e2e.rig import launch
from tests.e2e.rig.clone import Clone
from tests.e2e.rig.cluster import Gitops, Rig
from tests.e2e.rig.errors import RigError
from tests.e2e.rig.kube import Kube, Manifest
from tests.e2e.rig.tools import Report
from tests.kit.limits import PATIENCE_S
from tests.kit.repo import git
from tests.kit.ros import Sent

from .expected import NAMESPACE, demand
from .namespace import Namespace
from .ros import Client

VIEWS: dict[Gitops, type[Namespace]] = {"flux": FluxDomain, "argocd": ArgoDomain}
STAGES = ("committed", "pushed", "fetched", "applied", "ready")
_READY = "taking demands on"


class Generator:
    def __init__(self, state_repo: str, folder: Path, ros_domain: int, client: Client) -> None:
        self.log = folder / "generator.log"
        self._client = client
        self._folder = folder
        self._command = ["-m", "demandops.cli.main", "serve", "--state-repo", state_repo]
        self._environment = environment(folder) | {"ROS_DOMAIN_ID": str(ros_domain)}
        self._process: subprocess.Popen[bytes] | None = None

    def start(self, *arguments: str) -> None:
        """Start the generator, which dies with this process; wait until it accepts goals."""
        command = launch.command(sys.executable, *self._command, *arguments)
        with self.log.open("ab") as log:
            start = log.tell()
            self._process = subprocess.Popen(
                command, env=self._environment, cwd=self._folder, stdout=log, stderr=log
            )
        deadline = time.monotonic() + PATIENCE_S
        while not (_READY in self._log_since(start) and self._client.reaches_a_node()):
            ended = self._process.poll() is not None
            if ended or time.monotonic() > deadline:
                raise RigError(
                    f"the generator accepts no demands; {self.log}:\n{self._log_since(start)}"
                )
            time.sleep(0.05)

    def kill(self) -> None:
        assert self._process is not None
        self._process.kill()
        self._process.wait(10)

    def stop(self) -> None:
        """Ask the generator to end, and kill it if it still runs after ten seconds."""
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(10)
            except subprocess.TimeoutExpired:
                self.kill()

    def _log_since(self, offset: int) -> str:
        return self.log.read_bytes()[offset:].decode(errors="replace")


class World:
    """A state repo, its generator, and the access domain on each cluster that follows it."""

    def __init__(self, rig: Rig, folder: Path, ros_domain: int, client: Client) -> None:
        self.rig, self.client, self.folder = rig, client, folder
        self.name = f"state-{uuid.uuid4().hex[:8]}.git"
        self.push_url = rig.push_url(self.name)
        bare = folder / "state.git"
        url = rig.git_url(self.name)
        demandops(folder, "init", str(bare), "--bare", "--gitops", rig.gitops, "--url", url)
        git(bare, "push", "--quiet", self.push_url, "main")
        self.person = Clone(self.push_url, folder / "person")
        self.generator = Generator(self.push_url, folder, ros_domain, client)
        self.domains: dict[str, Any] = {}
        self._wide: list[tuple[Kube, Manifest]] = []

    def bootstrap(self, cluster: str, rig: Rig, **source: Any) -> Any:
        """Let a cluster follow the state repo, and return the access domain on that cluster.

        Apply `bootstrap/<cluster>.yaml`, and wait until it has taken effect. `source` replaces
        fields of a GitRepository there, as an operator may do with an overlay.
        """
        manifests = self.manifests(cluster)
        for item in manifests:
            if item["kind"] == "GitRepository":
                item["spec"].update(source)
        (domain,) = VIEWS[rig.gitops].all_in(rig.kube, manifests)
        self.domains[cluster] = domain
        self.apply(rig.kube, manifests)
        domain.settle(self.tip())
        return domain

    def manifests(self, cluster: str) -> list[Manifest]:
        return list(yaml.safe_load_all(self.file(f"bootstrap/{cluster}.yaml")))

    def apply(self, kube: Kube, manifests: list[Manifest]) -> None:
        """Apply a bootstrap file's manifests; `remove_wide` removes those that are cluster-wide."""
        kube.apply(*manifests)
        self._wide += [
            (kube, item)
            for item in manifests
            if "namespace" not in item["metadata"] and item["kind"] != "Namespace"
        ]

    def remove_wide(self) -> None:
        for kube, item in self._wide:
            kube.delete(item["kind"], item["metadata"]["name"], version=item["apiVersion"])
        self._wide.clear()

    def remove(self) -> None:
        """Stop the generator and remove the state repo's objects; the namespaces stay."""
        self.generator.stop()
        for domain in self.domains.values():
            domain.remove()
        self.remove_wide()
        self.domains.clear()

    @property
    def domain(self) -> Any:
        """The access domain on the only cluster that follows the state repo."""
        (only,) = self.domains.values()
        return only

    def file(self, path: str) -> str:
        self._pull()
        return (self.person.folder / path).read_text()

    def tip(self) -> str:
        self._pull()
        return self.person.git("rev-parse", "HEAD")

    def changed_by(self, commit: str) -> list[str]:
        self._pull()
        return self.person.git("show", "--name-only", "--format=", commit).split()

    def commits_since(self, commit: str) -> int:
        self._pull()
        return int(self.person.git("rev-list", "--count", f"{commit}..HEAD"))

    def push(self, files: Mapping[str, str | None], message: str = "by hand") -> str:
        """Commit and push files as a person would; try again if the generator pushed first."""
        while True:
            self._pull()
            try:
                return self.person.push(files, message)
            except AssertionError as error:
                if "[rejected]" not in str(error):
                    raise

    def demand(self, goal: dict[str, Any]) -> Sent:
        """Send a goal, check that it succeeds, and return it with its answer."""
        sent = self.client.call(goal)
        assert sent.status == "succeeded", sent.message
        return sent

    def step(self, number: int, wanted: frozenset[str], *, wake: bool = True) -> list[float]:
        """Send the goal of a step, then `follow` the goal."""
        return self.follow(self.demand(demand(number)), wanted, wake=wake)

    def follow(self, sent: Sent, wanted: frozenset[str], *, wake: bool = True) -> list[float]:
        """Wait until the cluster has applied a goal's commit, and its `lines` are as wanted.

        Return when the goal was sent, and when it reached each of :data:`STAGES`. With `wake`,
        trigger the controller first.
        """
        domain = self.domain
        if wake:
            domain.wake()
        fetched = domain.wait_fetched(sent.commit)
        applied = domain.wait_applied(sent.commit)
        ready = domain.wait_lines(wanted)
        pushed = sent.stages["pushed"]
        committed = sent.stages.get("committed", pushed)  # no commit if nothing changed
        return [sent.at, committed, pushed, fetched, applied, ready]

    def _pull(self) -> None:
        self.person.git("fetch", "--quiet", "origin", "main")
        self.person.git("reset", "--quiet", "--hard", "FETCH_HEAD")


def show_times(say: Report, heading: str, rows: Mapping[str, list[float]]) -> None:
    """Print how long each demand took to each stage; `rows` has results of :meth:`World.follow`."""
    width = max(map(len, rows))
    say(f"\n{heading} (seconds)")
    say(" " * (width + 2) + "".join(f"{stage:>11}" for stage in (*STAGES, "in all")))
    for title, at in rows.items():
        taken = [*(after - before for before, after in pairwise(at)), at[-1] - at[0]]
        say(f"  {title:<{width}}" + "".join(f"{value:11.2f}" for value in taken))


@contextmanager
def running(rig: Rig, session: pytest.Session) -> Iterator[Rig]:
    """Start a rig and stop it after the block; keep its logs if a test failed meanwhile."""
    failed = session.testsfailed
    rig.start()
    try:
        yield rig
    finally:
        if rig.existing:
            rig.kube.delete("Namespace", NAMESPACE)
        rig.stop(failed=session.testsfailed > failed)


def demandops(folder: Path, *arguments: str) -> str:
    command = [sys.executable, "-m", "demandops.cli.main", *arguments]
    done = subprocess.run(
        command, env=environment(folder), cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"demandops {' '.join(arguments)}: {done.stderr}"
    return done.stdout


def environment(folder: Path) -> dict[str, str]:
    """Return the environment for DemandOps: data and logs in `folder`, ROS on loopback."""
    return {
        **os.environ,
        "DEMANDOPS_DATA_HOME": str(folder / "data"),
        "GIT_TERMINAL_PROMPT": "0",
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(folder / "ros-log"),
    }
