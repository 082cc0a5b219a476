"""Messages that nobody listed: from a folder of definitions to the events of a detector."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.kit.cli import Run
from tests.kit.detection import rule, text_of
from tests.kit.limits import LONGEST_TEST_S
from tests.kit.live import DEFINITIONS, Step, heard_live, told
from tests.kit.ros import reserved

ROOT = Path(__file__).resolve().parents[2]
BUILD = ROOT / "ros_bridge" / "interfaces" / "build.py"


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of a copy of our environment, with links as files, in which messages are built."""
    copy = tmp_path_factory.mktemp("environment") / "venv"
    subprocess.run(["cp", "-as", sys.prefix, copy], check=True)
    # the record of what is installed is changed in place only in the copy
    for name in ("interfaces.json", "interfaces.lock"):
        path = copy / "share" / "demandops" / name
        text = path.read_text()
        path.unlink()
        path.write_text(text)
    made = copy / "bin" / "python"
    ran = subprocess.run(
        [made, BUILD, DEFINITIONS],
        capture_output=True,
        text=True,
        timeout=LONGEST_TEST_S,
        check=True,
    )
    assert "verify hazard_msgs" in ran.stdout
    return made


@pytest.fixture
def domain() -> Iterator[int]:
    with reserved() as reservation:
        yield reservation


def report(x: float, heading: float = 0.0, **motion: Any) -> dict[str, Any]:
    state = [x, 0.0, *[0.0] * 7, heading]
    return {"header": {"frame_id": "map"}, "motion": {"state": state} | motion}


def hazard(station: int, *codes: int, is_known: bool = True) -> dict[str, Any]:
    causes = [{"code": code, "detail": 0} for code in codes]
    return {"station": station, "has_situation": is_known, "causes": causes}


SOURCES = {
    "fleet": {
        "topic": "/fleet/{entity}",
        "type": "fleet_msgs/msg/Report",
        "x": "motion.state[0]",
        "y": "motion.state[1]",
        "timeout": "1h",
    },
    "hazards": {
        "topic": "/hazards",
        "type": "hazard_msgs/msg/Hazard",
        "entity": "station",
        "unavailable": {"has_situation": 0},
        "timeout": "1h",
    },
}
RULES = [
    rule("near", near={"source": "fleet", "point": {"x": 0, "y": 0}, "start": 50, "stop": 50}),
    rule(
        "turned", threshold={"source": "fleet", "field": "motion.state[9]", "above": 3, "stop": 2}
    ),
    rule(
        "loaded",
        threshold={"source": "fleet", "field": "motion.axle_loads[1]", "above": 9, "stop": 8},
    ),
    rule("works", threshold={"source": "hazards", "field": "causes[0].code", "oneOf": [3, 26]}),
]
FLEET, HAZARD = "fleet_msgs/msg/Report", "hazard_msgs/msg/Hazard"
STEPS: list[Step] = [
    ("/fleet/v1", FLEET, report(60.0, axle_loads=[1.0, 2.0])),
    ("/fleet/v1", FLEET, report(50.0, 4.0, axle_loads=[1.0, 2.0])),
    ("/hazards", HAZARD, hazard(7, 94)),
    ("/hazards", HAZARD, hazard(7, 3)),
    ("/hazards", HAZARD, hazard(7, is_known=False)),
    ("/hazards", HAZARD, hazard(8, 26, 1)),
    ("/hazards", HAZARD, hazard(9)),  # no cause: the message lacks the field
    ("/hazards", HAZARD, hazard(7, 1, 3)),
    ("/fleet/v1", FLEET, report(51.0, 1.0, axle_loads=[1.0, 10.0])),
]
EVENTS = [
    "rule near: v1 is 50.0 m from the area",
    "rule turned: motion.state[9] of v1 is 4",
    "rule works: causes[0].code of 7 is 3",
    "rule works: causes[0].code of 8 is 26",
    "rule works: causes[0].code of 7 is 1",
    "rule loaded: motion.axle_loads[1] of v1 is 10",
    "rule turned: motion.state[9] of v1 is 1",
    "rule near: v1 is 51.0 m from the area",
]


def test_built_messages_give_the_same_events_live_and_from_a_bag(
    python: Path, domain: int, tmp_path: Path, demandops: Run
) -> None:
    rules = tmp_path / "rules.yaml"
    rules.write_text(text_of(*RULES, sources=SOURCES))
    log = heard_live(rules, STEPS, len(EVENTS), domain, str(python))
    assert sorted(told(log)) == sorted(EVENTS)
    assert "a message on /hazards is left out: the message has no field causes[0].code" in log
    # a bag has its definitions, so a replay needs no package
    replayed = demandops("detect", rules, "--replay", rules.with_name("bag"), "--output", "json")
    of_bag = [f"rule {one['rule']}: {one['reason']}" for one in replayed.json()["events"]]
    assert of_bag == told(log)


def test_a_type_that_is_not_built_is_refused_with_the_remedy(
    demandops: Run, tmp_path: Path
) -> None:
    rules = tmp_path / "rules.yaml"
    rules.write_text(text_of(*RULES, sources=SOURCES))
    ran = demandops("detect", rules)
    assert ran.code == 1
    assert (
        "sources.fleet.type: fleet_msgs/msg/Report is not installed; build it from the" in ran.err
    )
