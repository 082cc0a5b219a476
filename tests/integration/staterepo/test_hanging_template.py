"""A merged template that never ends refuses the demands that need it, and stops nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest
from demandops.errors import OverLimit
from demandops.service import Generator

from tests.kit import rig
from tests.kit.config import skeleton
from tests.kit.generator import receipt
from tests.kit.goals import Goal
from tests.kit.repo import GitRepo
from tests.kit.rig import Person, goal, leave

TEMPLATE = "appdefs/object-detection-fusion/values/object-fusion.yaml.j2"
ENDLESS = "{% for a in range(99999) %}{% for b in range(99999) %}{% endfor %}{% endfor %}"


def refused(generator: Generator, made: Goal) -> list[tuple[str, str]]:
    with pytest.raises(OverLimit) as late:
        receipt(generator.submit(made))
    return [(fault.code, fault.file) for fault in late.value.faults]


def fusions(bare: Path) -> dict[str, str]:
    files = GitRepo(bare).files("clusters/")
    return {path: text for path, text in files.items() if "/of-edge-" in path}


def test_only_demands_that_need_the_template_are_refused(bare: Path, person: Person) -> None:
    with rig.running(bare) as generator:
        rig.book(generator, goal(1))
        for_one = f"{{% if application == 'edge/fusion-2' %}}{ENDLESS}{{% endif %}}\n"
        person.change({TEMPLATE: for_one + skeleton()[TEMPLATE]})
        assert refused(generator, goal(2)) == [("over-limit", TEMPLATE)]
        rig.book(generator, goal(3))
        assert generator.snapshot.problems == ()
    rig.assert_sound(bare)


def test_what_runs_keeps_its_files_and_may_leave(bare: Path, person: Person) -> None:
    with rig.running(bare) as generator:
        rig.book(generator, goal(1))
        before = fusions(bare)
        assert before
        person.change({TEMPLATE: ENDLESS + skeleton()[TEMPLATE]})
        assert refused(generator, goal(2)) == [("over-limit", TEMPLATE)]
        assert generator.snapshot.problems == ()
    with rig.running(bare) as generator:  # a start finds the same
        assert generator.snapshot.problems == ()
        assert fusions(bare) == before
        rig.book(generator, leave(1))
    assert not fusions(bare)
