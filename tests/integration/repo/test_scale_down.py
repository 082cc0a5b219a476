"""Replicas that no demand needs are removed by a later commit, whichever generator then runs."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import yaml

from tests.kit import goals, rig
from tests.kit.cli import Run
from tests.kit.clock import Clock
from tests.kit.config import skeleton
from tests.kit.repo import GitRepo

APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
SCALING = "{max: 4, per: {sources: 1}, dividesWork: true, downAfter: 10m}"
RELEASE = "of-edge-fusion"


@pytest.fixture(scope="session")
def bare_template(bare_template: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bare state repo in which a fusion has a replica for each source.

    The fusion keeps a replica for ten minutes after the last demand that needed it.
    """
    folder = tmp_path_factory.mktemp("kept") / "state.git"
    bare = Path(shutil.copytree(bare_template, folder))
    text = skeleton()[APPDEF].replace("prefix: of\n", f"prefix: of\n    scaling: {SCALING}\n")
    GitRepo(bare).commit({APPDEF: text}, "Keep replicas\n")
    return bare


def fusion(sources: int) -> rig.Goal:
    made = goals.put("fusion", connect="none")
    nodes = ["vehicle00", "vehicle01", "station00"][:sources]
    made["applications"][0]["inputs"] = {
        "ego_data": [{"topic": f"/{node}/ego", "source": node} for node in nodes]
    }
    return made


def replicas(bare: Path) -> int:
    files = GitRepo(bare).files("clusters/")
    (text,) = (text for path, text in files.items() if f"/{RELEASE}" in path)
    count: int = yaml.safe_load(text)["spec"]["values"]["replicas"]
    return count


def records(bare: Path) -> list[str]:
    return list(GitRepo(bare).files("ledger/replicas/"))


def wait_until_down(bare: Path) -> None:
    rig.wait_until(lambda: replicas(bare) == 1, "the fusion has one replica")


@pytest.mark.parametrize("restarts", [False, True])
def test_one_of_two_generators_scales_down_when_the_time_is_over(
    clock: Clock, url: str, bare: Path, tmp_path: Path, demandops: Run, restarts: bool
) -> None:
    other = tmp_path / "other"
    with rig.running(url, runtime=clock) as one, rig.running(url, data=other, runtime=clock):
        rig.book(one, fusion(3), fusion(1))
        assert (replicas(bare), len(records(bare))) == (3, 1)
        (name,) = (n for n in rig.books(bare)["services"] if n.startswith(RELEASE))
        assert "3 replicas until" in demandops("why", name, "--state-repo", url).out
        if not restarts:
            clock.pass_(600)
            wait_until_down(bare)
    clock.pass_(600)
    with rig.running(url, runtime=clock):
        wait_until_down(bare)
    (commit,) = (c for c in rig.commits(bare) if c.one("Operation") == "scale-down")
    assert commit.summary.startswith(f"Scale down {RELEASE}")
    assert records(bare) == []
    rig.assert_sound(bare, verify_last=4)
