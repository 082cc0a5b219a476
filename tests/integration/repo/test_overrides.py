"""Overrides that a person merges while a generator runs apply until they end.

The generator applies what a person has merged before it books the next demand. At the end of each
test, every commit verifies.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.base.errors import InvalidInput, Refused
from demandops.serve import evaluation
from demandops.serve.generator import Generator
from demandops.serve.queue import Receipt

from tests.kit import rig
from tests.kit.clock import Clock
from tests.kit.config import override
from tests.kit.repo import read as file
from tests.kit.rig import Person

EDGE = "clusters/c-its/perception/edge"
DETECTION = f"{EDGE}/od-edge-station00.yaml"
WATCHED: dict[str, Any] = {"services": ["object-detection"], "nodes": ["edge"]}


@pytest.fixture
def remote_generator(url: str, clock: Clock) -> Iterator[Generator]:
    """A generator that uses the state repo by its URL."""
    with rig.running(url, runtime=clock) as running:
        yield running


def parsed(bare: Path, path: str) -> Any:
    return yaml.safe_load(file(bare, path))


def body(bare: Path, path: str) -> str:
    lines = file(bare, path).splitlines()
    return "\n".join(line for line in lines if not line.startswith("#"))


def next_demand(generator: Generator, number: int = 100) -> Receipt:
    """Book a demand that is unrelated to the overrides, and return its receipt."""
    (receipt,) = rig.book(generator, rig.goal(number))
    return receipt


def follow_of(bare: Path, cause: str) -> rig.Commit:
    (found,) = [commit for commit in rig.commits(bare) if commit.one("Follows") == cause]
    return found


def test_nobody_takes_an_overrides_demand_id(generator: Generator) -> None:
    goal = {"kind": "Demand", "demand": "override:mine", "requesters": ["petra"]}
    with pytest.raises(InvalidInput, match="starts with 'override:', which only overrides may use"):
        rig.book(generator, goal | {"operation": "release"})


def test_a_merged_override_applies_until_it_is_deleted(
    generator: Generator, bare: Path, person: Person
) -> None:
    limits = {"resources": {"limits": {"memory": "2Gi"}}}
    image = {"object-detection": {"tag": "field-test"}}

    def arrived() -> bool:
        values = parsed(bare, DETECTION)["spec"]["values"]
        return bool(
            values["replicas"] == 3
            and values["resources"]["limits"]["memory"] == "2Gi"
            and values["image"]["tag"] == "field-test"
        )

    rig.book(generator, rig.goal(1))
    plain = file(bare, DETECTION)
    cause = person.override(tested=override(WATCHED, replicas=3, values=limits, images=image))
    next_demand(generator)
    assert arrived()
    assert file(bare, DETECTION).splitlines()[0] == (
        "# override overrides/tested.yaml: values, images, replicas; priority 0; owner petra; "
        "reason: a field test"
    )
    assert follow_of(bare, cause).all("Override") == ["overrides/tested.yaml"]
    rig.book(generator, *(rig.goal(number) for number in range(2, 8)))
    rig.book(generator, *(rig.leave(number) for number in range(1, 8)), rig.leave(100))
    assert file(bare, DETECTION) == ""
    (again,) = rig.book(generator, rig.goal(9))
    assert arrived()
    (commit,) = [commit for commit in rig.commits(bare) if commit.id == again.commit]
    assert commit.all("Override") == ["overrides/tested.yaml"]
    cause = person.override(tested=None)
    next_demand(generator)
    assert file(bare, DETECTION) == plain
    assert follow_of(bare, cause).all("Override") == ["overrides/tested.yaml"]
    rig.assert_sound(bare)


def test_a_service_is_moved_and_comes_back(
    generator: Generator, bare: Path, person: Person
) -> None:
    rig.book(generator, rig.goal(1))
    moved = "clusters/c-its/perception/cloud/od-cloud-station00.yaml"
    person.override(moved=override(WATCHED, node="cloud"))
    next_demand(generator)
    assert file(bare, DETECTION) == ""
    spec = parsed(bare, moved)["spec"]
    assert spec["values"]["nodeSelector"] == {"node_id": "cloud"}
    assert rig.books(bare)["services"]["od-cloud-station00"]["node"] == "cloud"
    person.override(moved=None)
    next_demand(generator, 101)
    assert file(bare, moved) == ""
    assert file(bare, DETECTION)
    rig.assert_sound(bare)


def test_the_connections_of_a_demand_follow_a_moved_service_also_through_a_rollback(
    generator: Generator, bare: Path, person: Person
) -> None:
    goal = {
        "kind": "Demand",
        "demand": "perception",
        "requesters": ["vehicle00"],
        "applications": [
            {
                "id": "fusion",
                "type": "object-detection-fusion",
                "node": "edge",
                "inputs": {"point_cloud": [{"topic": "/points", "source": "vehicle00"}]},
            }
        ],
    }
    rig.book(generator, goal)
    plain = rig.books(bare)["connections"]
    before = rig.tip(bare)
    cause = person.override(away=override({"services": ["object-fusion"]}, node="cloud"))
    next_demand(generator)
    moved = rig.books(bare)["connections"]
    assert {*moved} - {*plain} > {"derived/edge/cloud"}
    assert "perception" in follow_of(bare, cause).all("Demand-Id")
    who = ("A", "a@example.org")
    rolled = evaluation.goal(before, drop_newer=True, reason="x", who=who)
    assert rig.receipt(generator.submit(rolled)).outcome == "restored"
    assert "derived/edge/cloud" in rig.books(bare)["connections"], (
        "the connection must last as long as the override"
    )
    person.override(away=None)
    next_demand(generator, 2)
    assert "derived/edge/cloud" not in rig.books(bare)["connections"]
    rig.assert_sound(bare)


def test_a_held_file_stays_byte_for_byte_until_it_is_let_go(
    generator: Generator, bare: Path, person: Person
) -> None:
    rig.book(generator, rig.goal(1))
    (fusion,) = [name for name in rig.books(bare)["services"] if name.startswith("of-")]
    path = f"{EDGE}/{fusion}.yaml"
    before = body(bare, path)
    person.override(frozen=override({"services": ["object-fusion"]}, hold=True))
    next_demand(generator, 2)
    held = file(bare, path)
    assert held.startswith("# override overrides/frozen.yaml: hold; priority 0; owner petra")
    assert body(bare, path) == before
    (late,) = rig.book(generator, rig.goal(6))  # adds an input to the held fusion
    assert late.warnings[-1] == (
        f"{fusion} will not change until the 'hold' of overrides/frozen.yaml ends"
    )
    person.edit("registry/images.yaml", "2025-04", "2025-05")
    next_demand(generator, 3)
    assert "2025-05" in file(bare, DETECTION)
    assert file(bare, path) == held
    others = [n for n in rig.books(bare)["services"] if n.startswith("of-") and n != fusion]
    for other in others:
        first = file(bare, f"{EDGE}/{other}.yaml").splitlines()[0]
        assert "frozen.yaml: hold" in first, "the file must be rendered once before it is held"
    person.override(frozen=None)
    next_demand(generator, 7)
    assert "/vehicles/vehicle02/ego_data" in file(bare, path)
    person.override(frozen=override({"services": ["object-fusion"]}, hold=True))
    rig.book(generator, rig.leave(1), rig.leave(6))
    assert file(bare, path) == "", "a release that nobody demands must go, held or not"
    rig.assert_sound(bare)


def test_a_denied_requester_is_refused_and_its_claims_suspended_until_the_override_goes(
    generator: Generator, bare: Path, person: Person
) -> None:
    rig.book(generator, rig.goal(1), rig.goal(2))
    running = rig.books(bare)
    files = rig.git(bare, "rev-parse", "main:clusters")
    cause = person.override(closed=override({"requesters": ["user1"]}, deny=True))
    next_demand(generator, 2)
    now = rig.books(bare)
    assert "vehicle01/edge" not in now["connections"]
    assert {entry["id"] for entry in now["suspended"]} == {"edge/fusion-1", "vehicle01/edge"}
    assert {entry["override"] for entry in now["suspended"]} == {"overrides/closed.yaml"}
    assert len(rig.claims(bare, "user1")) == 2, "suspended claims must stay in the ledger"
    assert follow_of(bare, cause).all("Override") == ["overrides/closed.yaml"]
    anew = rig.goal(11, vehicle=3)
    anew["apps"][0]["object_detection_fusion_app"]["requester_ids"] = ["user5", "user1"]
    with pytest.raises(Refused) as refusal:
        rig.book(generator, anew)
    assert [(one.code, str(one)) for one in refusal.value.faults] == [
        (
            "denied",
            "apps[0].object_detection_fusion_app.requester_ids[1]: is denied by "
            "overrides/closed.yaml: a field test; ask the override's owner, petra, or demand "
            "something else",
        )
    ]
    (renewed,) = rig.book(generator, rig.goal(1))
    assert renewed.outcome == "unchanged"
    assert any("is suspended by overrides/closed.yaml" in text for text in renewed.warnings)
    person.override(closed=None)
    next_demand(generator, 2)
    assert rig.git(bare, "rev-parse", "main:clusters") == files
    assert rig.books(bare) == running
    person.override(closed=override({"requesters": ["user1"]}, deny=True))
    (left,) = rig.book(generator, rig.leave(1))
    assert left.outcome == "released"
    assert rig.claims(bare, "user1") == []
    rig.assert_sound(bare)


def test_a_kept_application_runs_until_a_demand_takes_over_or_the_override_goes(
    generator: Generator, bare: Path, person: Person
) -> None:
    rig.book(generator, rig.goal(1))
    person.override(lasting=override({"applications": ["edge/*"]}, keep=True))
    (left,) = rig.book(generator, rig.leave(1))
    (commit,) = [commit for commit in rig.commits(bare) if commit.id == left.commit]
    assert commit.all("Override") == ["overrides/lasting.yaml"]
    assert commit.all("Requester") == ["user1", "station00"]
    books = rig.books(bare)
    assert books["services"]["od-edge-station00"]["requesters"] == ["petra"]
    assert books["connections"] == {}, "the override keeps applications, not connections"
    assert len(rig.claims(bare, "override:lasting")) == 1
    assert "override overrides/lasting.yaml: keep;" in file(bare, DETECTION)
    with pytest.raises(Refused):
        rig.book(generator, rig.leave(1) | {"id": "another"})
    moved = rig.goal(6)
    moved["apps"][0]["header"]["node_id"] = "cloud"
    rig.book(generator, moved)
    assert rig.claims(bare, "override:lasting") == [], "a new demand takes over from the override"
    rig.book(generator, moved | {"shutdown": True})
    assert len(rig.claims(bare, "override:lasting")) == 1
    cause = person.override(lasting=None)
    next_demand(generator, 2)
    assert rig.claims(bare, "override:lasting") == []
    assert follow_of(bare, cause).all("Override") == ["overrides/lasting.yaml"]
    rig.book(generator, rig.leave(2))
    assert rig.books(bare)["services"] == {}
    rig.assert_sound(bare)


def test_a_claim_that_a_person_deletes_is_kept_too(
    generator: Generator, bare: Path, person: Person
) -> None:
    rig.book(generator, rig.goal(1))
    person.override(lasting=override({"connections": ["vehicle01/*"]}, keep=True))
    (path,) = rig.claims(bare, "ConnectionClaim")
    cause = person.change({path: None})
    next_demand(generator, 2)
    assert rig.books(bare)["connections"]["vehicle01/edge"]["requesters"] == ["petra"]
    assert follow_of(bare, cause).all("Override") == ["overrides/lasting.yaml"]
    rig.assert_sound(bare)


def test_an_expired_override_ends_in_a_commit_and_a_later_date_revives_it(
    clock: Clock, remote_generator: Generator, bare: Path, person: Person
) -> None:
    generator = remote_generator
    rig.book(generator, rig.goal(1))
    plain = file(bare, DETECTION)
    end = clock.now() + timedelta(hours=1)
    short = end.isoformat()
    person.override(
        brief=override(WATCHED, replicas=3, expires=short),
        late=override(WATCHED, replicas=4, priority=1, expires="2020-01-01T00:00:00Z"),
    )
    next_demand(generator)
    assert parsed(bare, DETECTION)["spec"]["values"]["replicas"] == 3, (
        "an override that has expired must not apply"
    )
    assert "; until 20" in file(bare, DETECTION).splitlines()[0]
    marker = "ledger/overrides/brief.yaml"
    assert file(bare, "ledger/overrides/late.yaml")
    assert file(bare, marker) == ""
    clock.pass_(59 * 60)
    next_demand(generator)
    assert file(bare, marker) == "", "the override must not end before its time"
    clock.pass_(60)
    rig.wait_until(lambda: file(bare, marker), "the override has ended")
    assert file(bare, DETECTION) == plain
    (commit,) = [c for c in rig.commits(bare) if c.one("Operation") == "expire-override"]
    assert commit.summary == "End override brief"
    assert commit.all("Override") == ["overrides/brief.yaml"]
    assert "overrides/brief.yaml by petra (a field test) expired at" in rig.git(
        bare, "log", "-1", "--format=%b", commit.id
    )
    assert parsed(bare, "overrides/brief.yaml")["expires"] == short, (
        "the generator must not change the person's file"
    )
    next_demand(generator, 2)
    assert file(bare, DETECTION) == plain
    later = (end + timedelta(days=300)).isoformat()
    person.override(brief=override(WATCHED, replicas=3, expires=later), late=None)
    next_demand(generator, 3)
    assert parsed(bare, DETECTION)["spec"]["values"]["replicas"] == 3
    assert file(bare, marker) == file(bare, "ledger/overrides/late.yaml") == ""
    rig.assert_sound(bare)


def test_what_expired_while_no_generator_ran_ends_when_one_does(
    clock: Clock, bare: Path, person: Person
) -> None:
    with rig.running(bare, runtime=clock) as generator:
        rig.book(generator, rig.goal(1))
        end = clock.now() + timedelta(hours=1)
        person.override(brief=override(WATCHED, replicas=3, expires=end.isoformat()))
        next_demand(generator)
    clock.pass_(3600)
    with rig.running(bare, runtime=clock):
        rig.wait_until(lambda: file(bare, "ledger/overrides/brief.yaml"), "the override has ended")
    assert parsed(bare, DETECTION)["spec"]["values"]["replicas"] == 1
    rig.assert_sound(bare)


def test_a_tie_is_reported_and_the_earlier_override_stays_in_force(
    generator: Generator, bare: Path, person: Person, caplog: pytest.LogCaptureFixture
) -> None:
    told = "overrides/sound.yaml: priority: is 0, as in overrides/broken.yaml"
    caplog.set_level(logging.ERROR, logger="demandops")
    person.override(sound=override(WATCHED, replicas=3, expires="2090-01-01T00:00:00Z"))
    rig.book(generator, rig.goal(1))
    person.override(broken=override({"nodes": ["e*"]}, replicas=5))
    rig.book(generator, rig.goal(2), rig.leave(1))
    assert parsed(bare, DETECTION)["spec"]["values"]["replicas"] == 3
    assert any(told in record.getMessage() for record in caplog.records), caplog.text
    person.override(broken=None, sound=None)
    next_demand(generator)
    assert parsed(bare, DETECTION)["spec"]["values"]["replicas"] == 1
    rig.assert_sound(bare)


def test_an_override_ends_while_people_have_broken_another(
    clock: Clock, remote_generator: Generator, bare: Path, person: Person
) -> None:
    generator = remote_generator
    end = clock.now() + timedelta(hours=1)
    person.override(brief=override(WATCHED, replicas=3, expires=end.isoformat()))
    rig.book(generator, rig.goal(1))
    person.override(broken="apiVersion: [")
    next_demand(generator)
    assert parsed(bare, DETECTION)["spec"]["values"]["replicas"] == 3
    clock.pass_(3600)
    rig.wait_until(lambda: file(bare, "ledger/overrides/brief.yaml"), "the override has ended")
    assert parsed(bare, DETECTION)["spec"]["values"]["replicas"] == 1
    next_demand(generator, 2)
    rig.assert_sound(bare)
