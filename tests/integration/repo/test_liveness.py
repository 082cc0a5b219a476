"""The liveness probe of the chart fails if a generator's worker is stuck, and only then."""

from __future__ import annotations

import os
import re
import subprocess
import textwrap
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from demandops.base.errors import StateRepoError
from demandops.serve.generator import Generator

from tests.kit import goals, rig
from tests.kit.git_over_http import Server
from tests.kit.rig import Goal, Person, goal, wait_until

STATEFUL_SET = Path(__file__).parents[3] / "deploy/chart/templates/statefulset.yaml"


class Probe:
    """The probe's command, with a file of this test in place of the pod's."""

    def __init__(self, file: Path) -> None:
        self.file = file
        text = STATEFUL_SET.read_text()
        match = re.search(r"^( *)livenessProbe:\n(?:\1 .*\n)+", text, re.M)
        assert match
        probe = yaml.safe_load(textwrap.dedent(match[0]))["livenessProbe"]
        (in_pod,) = re.findall(r"DEMANDOPS_ALIVE_FILE\n *value: (\S+)", text)
        self._command = [each.replace(in_pod, str(file)) for each in probe["exec"]["command"]]
        assert self._command != probe["exec"]["command"]

    def passes(self) -> bool:
        return subprocess.run(self._command, check=False).returncode == 0

    def make_old(self) -> None:
        an_hour_ago = self.file.stat().st_mtime - 3600
        os.utime(self.file, (an_hour_ago, an_hour_ago))

    def wait(self) -> None:
        wait_until(self.file.exists, "the worker touched the file")
        self.make_old()
        wait_until(self.passes, "the worker touches the file again")


@pytest.fixture
def probe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Probe:
    file = tmp_path / "alive"
    monkeypatch.setenv("DEMANDOPS_ALIVE_FILE", str(file))
    return Probe(file)


def test_it_fails_while_the_worker_is_stuck(bare: Path, probe: Probe) -> None:
    with rig.running(bare) as generator:
        with rig.busy(generator, goal(1)):
            probe.make_old()
            assert not probe.passes()
        rig.book(generator, goal(2))
        assert probe.passes()


def test_it_passes_while_the_git_server_is_away_or_silent(
    http: str, server: Server, probe: Probe
) -> None:
    silence = threading.Event()
    with rig.running(http) as generator:
        server.faults.away = True
        ticket = generator.submit(goal(1))
        probe.wait()
        server.faults.hang, server.faults.away = silence, False
        probe.wait()
        server.faults.hang = None
        silence.set()
        rig.receipt(ticket)


def test_it_passes_during_a_start_whatever_an_earlier_process_left(
    tmp_path: Path, probe: Probe
) -> None:
    probe.file.touch()
    probe.make_old()
    with pytest.raises(StateRepoError):
        Generator(str(tmp_path / "nowhere"))
    assert probe.passes()


@pytest.mark.parametrize("made", [goals.link, goal], ids=["connection", "application"])
def test_it_passes_during_a_long_check_of_proposals(
    bare: Path, petra: Person, probe: Probe, made: Callable[[int], Goal]
) -> None:
    passed = list[bool]()

    def proposed(stage: str, text: str) -> None:
        if stage == "proposed":
            passed.append(probe.passes())
            probe.make_old()

    with rig.running(bare) as generator:
        with rig.busy(generator, goal(9)):
            for number in (1, 2, 3):
                generator.submit(made(number), listener=proposed)
        wait_until(lambda: len(passed) == 3, "the demands wait for approval")
    assert passed == [True] * 3
