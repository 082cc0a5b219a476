"""Overrides that a person merges while a generator runs apply until they end.

The generator applies what a person has merged before it books the next demand. At the end of each
test, every commit verifies.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.serve import evaluation
from demandops.serve.generator import Generator

from tests.kit import goals, rig
from tests.kit.clock import Clock
from tests.kit.config import override
from tests.kit.repo import read as file
from tests.kit.rig import Person

EDGE = "clusters/c-its/perception/edge"
DETECTION = f"{EDGE}/od-edge-station00.yaml"
WATCHED: dict[str, Any] = {"services": ["object-detection"], "nodes": ["edge"]}


@pytest.fixture
def generator(generator: Generator, bare: Path) -> Iterator[Generator]:
    yield generator
    rig.assert_sound(bare)


def replicas(bare: Path) -> Any:
    return yaml.safe_load(file(bare, DETECTION))["spec"]["values"]["replicas"]


def body(bare: Path, path: str) -> str:
    lines = file(bare, path).splitlines()
    return "\n".join(line for line in lines if not line.startswith("#"))


def next_demand(generator: Generator, number: int = 100) -> None:
    """Book a demand that is unrelated to the overrides."""
    rig.book(generator, rig.goal(number))


def named(bare: Path, commit: str) -> list[str]:
    """Return the overrides that a commit names, or the commit that follows a person's."""
    found = [c for c in rig.commits(bare) if commit in (c.id, c.one("Follows"))]
    return found[-1].all("Override")


def test_a_merged_override_applies_until_it_is_deleted(
    generator: Generator, bare: Path, person: Person
) -> None:
    limits = {"resources": {"limits": {"memory": "2Gi"}}}
    image = {"object-detection": {"tag": "field-test"}}

    def applies() -> bool:
        values = yaml.safe_load(file(bare, DETECTION))["spec"]["values"]
        return (values["replicas"], values["image"]["tag"]) == (3, "field-test") and (
            values["resources"]["limits"]["memory"] == "2Gi"
        )

    rig.book(generator, rig.goal(1))
    plain = file(bare, DETECTION)
    cause = person.override(tested=override(WATCHED, replicas=3, values=limits, images=image))
    next_demand(generator)
    assert applies()
    assert file(bare, DETECTION).startswith(
        "# override overrides/tested.yaml: values, images, replicas; priority 0; owner petra;"
    )
    assert named(bare, cause) == ["overrides/tested.yaml"]
    rig.book(generator, rig.leave(1), rig.leave(100))
    assert file(bare, DETECTION) == ""
    (again,) = rig.book(generator, rig.goal(9))
    assert applies()
    assert named(bare, again.commit) == ["overrides/tested.yaml"]
    cause = person.override(tested=None)
    next_demand(generator)
    assert file(bare, DETECTION) == plain
    assert named(bare, cause) == ["overrides/tested.yaml"]


def test_the_connections_of_a_demand_follow_a_moved_service_also_through_a_rollback(
    generator: Generator, bare: Path, person: Person
) -> None:
    app = {"id": "fusion", "type": "object-detection-fusion", "node": "edge"}
    app |= {"inputs": {"point_cloud": [{"topic": "/points", "source": "vehicle00"}]}}
    goal = {"kind": "Demand", "demand": "perception", "requesters": ["vehicle00"]}
    rig.book(generator, goal | {"applications": [app]})
    before = rig.tip(bare)

    def connections() -> set[str]:
        return {*rig.books(bare)["connections"]}

    assert "derived/edge/cloud" not in connections()
    person.override(away=override({"services": ["object-fusion"]}, node="cloud"))
    next_demand(generator)
    assert "derived/edge/cloud" in connections()
    (follow,) = [c for c in rig.commits(bare) if c.one("Operation") == "follow"]
    assert "perception" in follow.all("Demand-Id")
    who = ("A", "a@example.org")
    rolled = evaluation.goal(before, drop_newer=True, reason="x", who=who)
    assert rig.outcome(generator.submit(rolled)) == "restored"
    assert "derived/edge/cloud" in connections(), "the connection lasts as long as the override"
    person.override(away=None)
    next_demand(generator, 2)
    assert "derived/edge/cloud" not in connections()


def test_a_held_file_stays_byte_for_byte_until_it_is_let_go(
    generator: Generator, bare: Path, person: Person
) -> None:
    hold = override({"services": ["object-fusion"]}, hold=True)
    rig.book(generator, rig.goal(1))
    (fusion,) = [name for name in rig.books(bare)["services"] if name.startswith("of-")]
    path = f"{EDGE}/{fusion}.yaml"
    before = body(bare, path)
    person.override(frozen=hold)
    next_demand(generator, 2)
    held = file(bare, path)
    assert held.startswith("# override overrides/frozen.yaml: hold;")
    assert body(bare, path) == before
    (late,) = rig.book(generator, rig.goal(6))  # adds an input to the held fusion
    assert late.warnings[-1].startswith(f"{fusion} will not change until")
    person.edit("registry/images.yaml", "2025-04", "2025-05")
    next_demand(generator, 3)
    assert "2025-05" in file(bare, DETECTION)
    assert file(bare, path) == held
    others = [n for n in rig.books(bare)["services"] if n.startswith("of-") and n != fusion]
    for other in others:
        assert "frozen.yaml: hold" in file(bare, f"{EDGE}/{other}.yaml"), (
            "the file must be rendered once before it is held"
        )
    person.override(frozen=None)
    next_demand(generator, 7)
    assert "/vehicles/vehicle02/ego_data" in file(bare, path)
    person.override(frozen=hold)
    rig.book(generator, rig.leave(1), rig.leave(6))
    assert file(bare, path) == "", "a release that nobody demands must go, held or not"


def test_a_denied_requester_is_refused_and_its_claims_suspended_until_the_override_goes(
    generator: Generator, bare: Path, person: Person
) -> None:
    denial = override({"requesters": ["user1"]}, deny=True)
    rig.book(generator, rig.goal(1), rig.goal(2))
    running, files = rig.books(bare), rig.git(bare, "rev-parse", "main:clusters")
    cause = person.override(closed=denial)
    next_demand(generator, 2)
    now = rig.books(bare)
    assert "vehicle01/edge" not in now["connections"]
    assert {(entry["id"], entry["override"]) for entry in now["suspended"]} == {
        (id, "overrides/closed.yaml") for id in ("edge/fusion-1", "vehicle01/edge")
    }
    assert len(rig.claims(bare, "user1")) == 2, "suspended claims must stay in the ledger"
    assert named(bare, cause) == ["overrides/closed.yaml"]
    assert rig.outcome(generator.submit(goals.put("anew", "user1"))) == "denied"
    (renewed,) = rig.book(generator, rig.goal(1))
    assert renewed.outcome == "unchanged"
    assert any("is suspended by overrides/closed.yaml" in text for text in renewed.warnings)
    person.override(closed=None)
    next_demand(generator, 2)
    assert (rig.books(bare), rig.git(bare, "rev-parse", "main:clusters")) == (running, files)
    person.override(closed=denial)
    assert rig.book(generator, rig.leave(1))[0].outcome == "released"
    assert rig.claims(bare, "user1") == []


def test_a_claim_that_a_person_deletes_is_kept_too(
    generator: Generator, bare: Path, person: Person
) -> None:
    rig.book(generator, rig.goal(1))
    person.override(lasting=override({"connections": ["vehicle01/*"]}, keep=True))
    (path,) = rig.claims(bare, "ConnectionClaim")
    cause = person.change({path: None})
    next_demand(generator, 2)
    assert rig.books(bare)["connections"]["vehicle01/edge"]["requesters"] == ["petra"]
    assert named(bare, cause) == ["overrides/lasting.yaml"]


# ---- the end of an override ----

BRIEF, LATE = "ledger/overrides/brief.yaml", "ledger/overrides/late.yaml"


@pytest.fixture
def merge(clock: Clock, person: Person) -> Callable[..., str]:
    """Return a function that merges an override which ends in so many hours, and returns it."""

    def merged(hours: int, **others: str | None) -> str:
        end = (clock.now() + timedelta(hours=hours)).isoformat()
        brief = override(WATCHED, replicas=3, expires=end)
        person.override(brief=brief, **others)
        return brief

    return merged


def test_an_expired_override_ends_in_a_commit_and_a_later_date_revives_it(
    clock: Clock, url: str, bare: Path, merge: Callable[..., str]
) -> None:
    with rig.running(url, runtime=clock) as generator:
        rig.book(generator, rig.goal(1))
        plain = file(bare, DETECTION)
        past = override(WATCHED, replicas=4, priority=1, expires="2020-01-01T00:00:00Z")
        brief = merge(1, late=past)
        next_demand(generator)
        assert replicas(bare) == 3, "an override that has expired must not apply"
        assert "; until 20" in file(bare, DETECTION).splitlines()[0]
        assert file(bare, LATE) and not file(bare, BRIEF)
        clock.pass_(59 * 60)
        next_demand(generator)
        assert file(bare, BRIEF) == "", "the override must not end before its time"
        clock.pass_(60)
        rig.wait_until(lambda: file(bare, BRIEF), "the override has ended")
        assert file(bare, DETECTION) == plain
        (commit,) = [c for c in rig.commits(bare) if c.one("Operation") == "expire-override"]
        assert commit.summary == "End override brief"
        assert commit.all("Override") == ["overrides/brief.yaml"]
        assert file(bare, "overrides/brief.yaml") == brief, "the person's file must stay"
        next_demand(generator, 2)
        assert file(bare, DETECTION) == plain
        merge(7200, late=None)
        next_demand(generator, 3)
        assert (replicas(bare), file(bare, BRIEF), file(bare, LATE)) == (3, "", "")
    rig.assert_sound(bare)


def test_what_expired_while_no_generator_ran_ends_although_people_have_broken_another(
    clock: Clock, bare: Path, merge: Callable[..., str]
) -> None:
    with rig.running(bare, runtime=clock) as generator:
        merge(1)
        rig.book(generator, rig.goal(1))
        merge(1, broken="apiVersion: [")
        next_demand(generator)
        assert replicas(bare) == 3
    clock.pass_(3600)
    with rig.running(bare, runtime=clock) as generator:
        rig.wait_until(lambda: file(bare, BRIEF), "the override has ended")
        assert replicas(bare) == 1
        next_demand(generator, 2)
    rig.assert_sound(bare)


def test_a_tie_is_reported_and_the_earlier_override_stays_in_force(
    generator: Generator, bare: Path, person: Person, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.ERROR, logger="demandops")
    person.override(sound=override(WATCHED, replicas=3, expires="2090-01-01T00:00:00Z"))
    rig.book(generator, rig.goal(1))
    person.override(broken=override({"nodes": ["e*"]}, replicas=5))
    rig.book(generator, rig.goal(2), rig.leave(1))
    assert replicas(bare) == 3
    assert "overrides/sound.yaml: priority: is 0, as in overrides/broken.yaml" in caplog.text
    person.override(broken=None, sound=None)
    next_demand(generator)
    assert replicas(bare) == 1
