"""Messages that nobody listed: from a folder of definitions to the events of a detector."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.kit import plain_yaml
from tests.kit.cli import Run, process
from tests.kit.detection import rule, text_of
from tests.kit.limits import LONGEST_TEST_S
from tests.kit.live import DEFINITIONS, Step, heard_live, told

ROOT = Path(__file__).resolve().parents[2]
TABLE = plain_yaml.beside(__file__, "messages")
TYPES = {"/fleet/v1": "fleet_msgs/msg/Report", "/hazards": "hazard_msgs/msg/Hazard"}
STEPS: list[Step] = [(topic, TYPES[topic], fields) for topic, fields in TABLE["messages"]]
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
    ran = process(made, BUILD, DEFINITIONS, timeout=LONGEST_TEST_S)
    assert ran.code == 0 and "verify hazard_msgs" in ran.out, ran
    return made


@pytest.fixture
def rules(tmp_path: Path) -> Path:
    file = tmp_path / "rules.yaml"
    named = [rule(each.pop("name"), **each) for each in map(dict, TABLE["rules"])]
    file.write_text(text_of(*named, sources=TABLE["sources"]))
    return file


def test_built_messages_give_the_same_events_live_and_from_a_bag(
    python: Path, ros_domain: int, rules: Path, demandops: Run
) -> None:
    log = heard_live(rules, STEPS, len(TABLE["events"]), ros_domain, str(python))
    assert sorted(told(log)) == sorted(TABLE["events"])
    assert "a message on /hazards is left out: the message has no field causes[0].code" in log
    # a bag has its definitions, so a replay needs no package
    replayed = demandops("detect", rules, "--replay", rules.with_name("bag"), "--output", "json")
    of_bag = [f"rule {one['rule']}: {one['reason']}" for one in replayed.json()["events"]]
    assert of_bag == told(log)


def test_a_type_that_is_not_built_is_refused_with_the_remedy(demandops: Run, rules: Path) -> None:
    ran = demandops("detect", rules)
    assert ran.code == 1
    assert (
        "sources.fleet.type: fleet_msgs/msg/Report is not installed; build it from the" in ran.err
    )
