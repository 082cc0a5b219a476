"""A merged template that never ends refuses the demands that need it, and stops nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest
from demandops.base.errors import OverLimit
from demandops.model.demand import goals as demand_goals
from demandops.serve import worker
from demandops.serve.generator import Generator

from tests.kit import rig
from tests.kit.config import skeleton
from tests.kit.goals import CLOUD, Goal, application, put
from tests.kit.goals import goal as request
from tests.kit.repo import GitRepo
from tests.kit.rig import Person, goal, leave, receipt

SHARED = "appdefs/object-detection-fusion/values/object-detection.yaml.j2"
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


def test_what_shares_a_service_may_leave_and_is_renewed(bare: Path, person: Person) -> None:
    def sharing(number: int) -> Goal:
        app = application(f"edge/fusion-{number}", who=[f"user{number}"])
        return request([app], id=f"demand-{number}")

    leased = put("leased", topic=CLOUD, lease=600)
    short = {key: leased[key] for key in ("kind", "demand", "requesters")}
    with rig.running(bare) as generator:
        rig.book(generator, sharing(1), sharing(2), leased)
        person.change({path: ENDLESS + skeleton()[path] for path in (SHARED, TEMPLATE)})
        assert refused(generator, sharing(3))
        rig.book(generator, leased, short | {"operation": "renew"})
        rig.book(generator, sharing(1) | {"shutdown": True})
        assert {claim.subject.id for claim in generator.snapshot.state.ledger} >= {"edge/fusion-2"}
        rig.book(generator, sharing(2) | {"shutdown": True}, short | {"operation": "release"})
    assert not rig.claims(bare)


def test_a_rollback_may_take_longer_than_a_demand(
    bare: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker, "DEMAND_S", 0.05)  # hundreds of services take half a second
    with rig.running(bare) as generator:
        demands = []
        for number in range(60):
            app = application(f"edge/f-{number}", clouds=[(f"/p{number}", "vehicle00")])
            demands.append(request([app], id=f"demand-{number}"))
        rig.book(generator, *demands)
        then = rig.tip(bare)
        rig.book(generator, *(demand | {"shutdown": True} for demand in demands))
        who = ("A person", "person@example.org")
        back = demand_goals.rollback(then, drop_newer=False, reason="a test", who=who)
        assert receipt(generator.submit(back)).outcome == "restored"
    assert len(rig.claims(bare)) == 120
