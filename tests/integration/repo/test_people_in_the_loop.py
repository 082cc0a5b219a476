"""A platform engineer changes the state repo while a generator runs.

The changes are an override, a broken override, a manual edit, a deleted claim and a moved node.
Each takes effect although no demand comes, and stays in effect after many demands. `make load` runs
the test with a thousand further demands and prints how long each change took.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.serve.generator import Generator

from tests.kit import rig
from tests.kit.config import override
from tests.kit.limits import LONGEST_TEST_S
from tests.kit.repo import read as text
from tests.kit.rig import Person

FURTHER = int(os.environ.get("DEMANDOPS_LOAD_FURTHER", "24"))
INTERVAL_S = 0.5
"""The generator's fetch interval in seconds.

No test checks how long a change takes, but `make load` prints it.
"""
EDGE = "clusters/c-its/perception/edge"
DETECTION = f"{EDGE}/od-edge-station00.yaml"
FUSION = f"{EDGE}/of-edge-fusion-1-118f66a66700.yaml"
FUSION_2 = f"{EDGE}/of-edge-fusion-2-0eb2168b8c74.yaml"
OVERRIDE = override({"services": ["object-detection"], "nodes": ["edge"]}, replicas=2)
BROKEN = override({"services": ["object-fusion"], "nodes": ["edge"]}, replicas="many")
REPORT = ".demandops/reports/problems.yaml"


def values(bare: Path, path: str) -> Any:
    return yaml.safe_load(text(bare, path))["spec"]["values"]


class Engineer:
    """Merges one change after the other, and waits for the effect of each."""

    def __init__(self, bare: Path, folder: Path) -> None:
        self.person = Person(bare, folder)
        self._bare = bare
        self.times: dict[str, float] = {}
        self.kept: dict[str, Callable[[], bool]] = {}

    def sees(self, what: str, files: dict[str, str | None], honoured: Callable[[], bool]) -> None:
        """Merge a change and wait until `honoured` returns true, although no demand comes."""
        assert not honoured(), f"{what}: in effect before the change already"
        made = self.person.change(files, what)
        began = time.monotonic()
        rig.wait_until(honoured, what)
        self.times[what] = time.monotonic() - began
        self.kept[what] = honoured
        rig.git(self._bare, "merge-base", "--is-ancestor", made, "main")


def story(bare: Path, engineer: Engineer) -> str:
    """Make all changes; return the text that the generator must restore in the edited file."""
    engineer.sees(
        "an override",
        {"overrides/two.yaml": OVERRIDE},
        lambda: values(bare, DETECTION)["replicas"] == 2,
    )
    engineer.sees(
        "a broken override",
        {"overrides/broken.yaml": BROKEN},
        lambda: "overrides/broken.yaml" in text(bare, REPORT),
    )
    generated = text(bare, FUSION)
    edited = generated.replace("interval:", "interval: 17m # ", 1)
    assert edited != generated
    made = engineer.person.change({FUSION: edited + "\n"}, "a hand edit")
    began = time.monotonic()
    rig.wait_until(lambda: text(bare, FUSION) == generated, "the hand edit is put right")
    engineer.times["a hand edit"] = time.monotonic() - began
    assert rig.git(bare, "log", "--format=%H", "--", FUSION).splitlines()[1] == made
    (claim,) = [path for path in rig.claims(bare, "user2") if "applications" in path]
    assert text(bare, FUSION_2)
    engineer.sees(
        "a deleted claim",
        {claim: None},
        lambda: not text(bare, claim) and rig.commits(bare)[-1].one("Operation") == "follow",
    )
    assert not text(bare, FUSION_2)
    engineer.kept["a deleted claim"] = lambda: not text(bare, claim)
    nodes = text(bare, "inventory/nodes.yaml") + "\n"
    start = nodes.index("  - id: vehicle03\n")
    moved = nodes[:start] + nodes[start:].replace("cluster: c-its", "cluster: roadside", 1)
    clusters = text(bare, "inventory/clusters.yaml") + "\n"
    engineer.sees(
        "a moved node",
        {
            "inventory/clusters.yaml": clusters.rstrip("\n") + "\n  - name: roadside\n",
            "inventory/nodes.yaml": moved,
        },
        lambda: (
            "vehicle03"
            in rig.git(bare, "ls-tree", "-r", "--name-only", "main", "clusters/roadside/")
        ),
    )
    return generated


@pytest.mark.nightly
@pytest.mark.limit(LONGEST_TEST_S + FURTHER)
def test_what_the_platform_engineer_merges_is_honoured_and_stays_so(
    bare: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    engineer = Engineer(bare, tmp_path / "petra")
    with rig.running(bare.as_uri(), fetch_interval=INTERVAL_S) as generator:
        rig.book(generator, *(rig.goal(number) for number in range(5)))
        story(bare, engineer)
        _demand_on(generator)
        for what, honoured in engineer.kept.items():
            assert honoured(), f"{what}: no longer in effect after {FURTHER} demands"
        engineer.sees(
            "the broken override mended",
            {"overrides/broken.yaml": BROKEN.replace("many", "3")},
            lambda: not text(bare, REPORT) and values(bare, FUSION)["replicas"] == 3,
        )
    rig.assert_sound(bare, verify_last=30)
    if "DEMANDOPS_LOAD_FURTHER" in os.environ:
        with capsys.disabled():
            for what, took in engineer.times.items():
                print(f"\n  {what}: honoured after {took:.2f} s", end="")


def _demand_on(generator: Generator) -> None:
    """Book demands of further requesters, and release some of these demands."""
    tickets = []
    for number in range(100, 100 + FURTHER * 2 // 3):
        tickets.append(generator.submit(rig.goal(number)))
        if number % 2:
            tickets.append(generator.submit(rig.leave(number)))
    for ticket in tickets:
        assert rig.receipt(ticket, 60 + FURTHER).outcome in ("booked", "released")
