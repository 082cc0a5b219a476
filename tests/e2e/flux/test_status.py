"""With Flux the answer to a demand reports whether its services run."""

from __future__ import annotations

import json
import os
import subprocess
import sys

from tests.e2e.common import expected
from tests.e2e.common.answers import *  # noqa: F403
from tests.e2e.common.expected import WITHOUT_DEMANDS, target_end
from tests.e2e.common.world import World, environment


def test_what_flux_forgot_is_named_and_its_command_deletes_it(world: World) -> None:
    domain, name = world.domain, target_end("station00")
    world.follow(world.demand(expected.demand(1)), expected.after(1))
    forgotten = domain.get("Deployment", name)
    kept = ("name", "namespace", "labels")
    metadata = {key: forgotten["metadata"][key] for key in kept} | {"name": "forgotten"}
    domain.kube.apply(
        {"apiVersion": "apps/v1", "kind": "Deployment", "metadata": metadata}
        | {"spec": forgotten["spec"]}
    )
    (orphan,) = orphans(world)
    assert (orphan["kind"], orphan["name"]) == ("Deployment", "forgotten")
    administrator = os.environ | {"KUBECONFIG": str(world.rig.kubeconfig)}
    subprocess.run(orphan["command"].split(), env=administrator, check=True)
    assert orphans(world) == []
    world.follow(world.demand(expected.demand(1) | {"shutdown": True}), WITHOUT_DEMANDS)


def orphans(world: World) -> list[dict[str, str]]:
    """Return the orphans that `status` lists; check that it exits with 1 if there are some."""
    command = [sys.executable, "-m", "demandops.cli.main", "status", "--output", "json"]
    command += ["--state-repo", world.push_url, "--clusters", str(world.folder / "clusters.yaml")]
    done = subprocess.run(
        command, env=environment(world.folder), capture_output=True, text=True, check=False
    )
    found: list[dict[str, str]] = json.loads(done.stdout)["orphans"]
    # without orphans the exit code depends on the releases, which may not be healthy yet
    assert done.returncode == 1 or not found, done.stderr
    return found
