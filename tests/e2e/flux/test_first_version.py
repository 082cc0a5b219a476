"""A state repo of DemandOps' first version is upgraded while its services run."""

from __future__ import annotations

from pathlib import Path

from tests.e2e.common import expected
from tests.e2e.common.expected import CLUSTER
from tests.e2e.common.world import demandops
from tests.e2e.conftest import MakeWorld
from tests.e2e.rig.cluster import Rig
from tests.kit.repo import first_version

URL = "https://git.example/fleet/state-repo.git"


def test_an_upgrade_from_the_first_version_restarts_the_fusion_alone(
    make_world: MakeWorld, rig: Rig, tmp_path: Path
) -> None:
    world = make_world()
    old = first_version(tmp_path / "first.git", "three-joins").files()
    url = rig.git_url(world.name)
    world.person.git("fetch", "--quiet", "origin", "main")
    listed = world.person.git("ls-tree", "-r", "-z", "--name-only", "FETCH_HEAD")
    laid_down = dict.fromkeys(filter(None, listed.split("\0")))
    files = {path: text.replace(URL, url) for path, text in old.items()}
    world.push(laid_down | files, "As the first version left it")
    domain = world.bootstrap(CLUSTER, rig)
    domain.wait_lines(expected.after(3))
    domain.wait_releases()
    before = domain.uids()
    assert before

    demandops(world.folder, "upgrade", "--state-repo", world.push_url)
    domain.wake()
    domain.wait_applied(world.tip())
    domain.wait_releases()
    after = domain.uids()
    assert after.keys() == before.keys()
    assert {name for name in before if after[name] != before[name]} == {expected.FUSION}
    world.bootstrap(CLUSTER, rig)  # the upgrade requires this
    assert domain.uids() == after
    (fusion,) = domain.find("HelmRelease", expected.FUSION)
    assert fusion["metadata"]["labels"]["app.kubernetes.io/part-of"] == "object-detection-fusion"

    world.generator.start()
    world.step(4, expected.after(4))
    world.step(5, expected.after(5))
