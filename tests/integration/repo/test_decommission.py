"""`demandops decommission` releases everything of a node or a requester in one commit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from demandops.cli.main import run
from demandops.serve.generator import Generator

from tests.kit import rig
from tests.kit.cli import Run
from tests.kit.rig import Person, goal, leave


def of(generator: Generator, subject: str) -> list[str]:
    """Return the requesters of each claim on a subject: one text for each claim."""
    claims = [c for c in generator.snapshot.state.ledger if c.subject.id == subject]
    return sorted(" ".join(claim.requesters) for claim in claims)


def test_a_node_gives_up_all_and_can_be_deleted_from_the_inventory(
    url: str, bare: Path, tmp_path: Path, demandops: Run
) -> None:
    """A running generator fetches the commit of `decommission` and the person's deletion."""
    person = Person(bare, tmp_path / "person")
    with rig.running(url, fetch_interval=0.1) as generator:
        rig.book(generator, goal(1), goal(2), goal(6))
        code, out, err = demandops("decommission", "vehicle01", "--state-repo", url)
        assert (code, err) == (0, "")
        commit = rig.commits(bare)[-1]
        assert out.splitlines() == [
            "reduced:  application 'edge/fusion-1' for station00, user1; kept for station00, user1",
            "released: connection 'vehicle01/edge' for station00, user1",
            f"'vehicle01' is decommissioned in {commit.id}",
        ]
        assert commit.summary == "Decommission vehicle01"
        assert [pair for pair in commit.trailers if pair[0] != "Operation-Id"] == [
            ("Operation", "decommission"),
            ("Node", "vehicle01"),
            ("Demand-Id", dict(commit.trailers)["Demand-Id"]),
            ("Requester", "station00"),
            ("Requester", "user1"),
            ("Application", "edge/fusion-1"),
            ("Connection", "vehicle01/edge"),
            ("Request-Id", "vehicle01"),
            ("Render-Version", "2"),
        ]
        author = rig.git(bare, "log", "-1", "--format=%an <%ae> %cn", commit.id)
        assert author == "Petra Platform <petra@example.org> DemandOps generator"
        made = person.change(rig.without_vehicle01(bare), "vehicle01 is sold")
        person.fetch()
        assert demandops("check", tmp_path / "person")[0] == 0
        rig.wait_until(
            lambda: "vehicle01" not in generator.snapshot.state.config.nodes,
            "the generator has followed the inventory",
        )
        assert generator.snapshot.problems == ()
        assert rig.git(bare, "ls-tree", "main", ".demandops") == ""
        assert made in [c.id for c in rig.commits(bare)]
        rig.book(generator, goal(3))
    assert not rig.git(bare, "grep", "-l", "vehicle01", "main", "--", "ledger", check=False)
    rig.assert_sound(bare)


def test_decommissioning_a_node_releases_its_applications_for_every_requester(
    bare: Path, demandops: Run
) -> None:
    with rig.running(bare) as generator:
        rig.book(generator, goal(1), goal(2))
    assert demandops("decommission", "edge", "--node", "--state-repo", bare)[0] == 0
    assert rig.claims(bare) == []
    assert rig.git(bare, "ls-tree", "-r", "--name-only", "main", "clusters").count("of-edge") == 0
    rig.assert_sound(bare)


def _by_the_edges_broker(target: str) -> rig.Goal:
    made = goal(1)
    made["connections"][0] |= {"target_node_id": target, "broker_node_id": "edge"}
    made["apps"] = []
    return made


def test_another_broker_replaces_the_demanded_broker_of_a_decommissioned_node(
    bare: Path, demandops: Run
) -> None:
    with rig.running(bare) as generator:
        rig.book(generator, _by_the_edges_broker("cloud"))
    code, out, err = demandops("decommission", "edge", "--state-repo", bare)
    assert code == 0, err
    (path,) = rig.claims(bare)
    assert "broker" not in rig.git(bare, "show", f"main:{path}")
    assert "reduced:  connection 'vehicle01/edge'" in out
    rig.assert_sound(bare)


def test_a_decommission_that_leaves_a_connection_without_a_broker_changes_nothing(
    bare: Path, demandops: Run
) -> None:
    with rig.running(bare) as generator:
        rig.book(generator, _by_the_edges_broker("station00"), goal(2))
    tip = rig.tip(bare)
    assert demandops("decommission", "edge", "--state-repo", bare) == (
        1,
        "",
        "error: broker: connection 'vehicle01/edge' has no broker; add one on 'station00' "
        "or 'vehicle01' to inventory/brokers.yaml\n",
    )
    assert rig.tip(bare) == tip


def test_with_a_requester_goes_all_that_is_claimed_in_its_name(bare: Path, demandops: Run) -> None:
    alone = goal(2)
    for subject in (alone["apps"][0]["object_detection_fusion_app"], alone["connections"][0]):
        subject["requester_ids"] = ["user1"]
    with rig.running(bare) as generator:
        rig.book(generator, goal(1), alone)
        assert of(generator, "edge/fusion-1") == ["station00 user1"]
    before = rig.git(bare, "rev-parse", "main:clusters")
    code, out, _ = demandops("decommission", "user1", "--state-repo", bare, "--output", "json")
    told = json.loads(out)
    assert (code, told["name"], told["outcome"]) == (0, "user1", "released")
    assert told["commit"] == rig.tip(bare)
    assert {tuple(c["subject"].values()): c["left"] for c in told["claims"]} == {
        ("application", "edge/fusion-1"): None,
        ("connection", "vehicle01/edge"): None,
        ("application", "edge/fusion-2"): None,
        ("connection", "vehicle02/edge"): None,
    }
    commit = rig.commits(bare)[-1]
    assert "Node" not in dict(commit.trailers)
    assert ("Requester", "user1") in commit.trailers
    assert rig.git(bare, "rev-parse", "main:clusters") != before
    with rig.running(bare) as generator:
        assert of(generator, "edge/fusion-1") == []
        assert of(generator, "edge/fusion-2") == []
        rig.book(generator, goal(1))  # user1 may demand again
        assert of(generator, "edge/fusion-1") == ["station00 user1"]
        rig.book(generator, leave(1))
    rig.assert_sound(bare)


def test_decommissioning_a_node_as_a_requester_leaves_its_topics_to_others(
    bare: Path, demandops: Run
) -> None:
    others = goal(2)
    for subject in (others["apps"][0]["object_detection_fusion_app"], others["connections"][0]):
        subject["requester_ids"] = ["user2"]
    with rig.running(bare) as generator:
        rig.book(generator, goal(1), others)
    assert demandops("decommission", "station00", "--requester", "--state-repo", bare)[0] == 0
    with rig.running(bare) as generator:
        assert of(generator, "edge/fusion-1") == []
        topics = [
            topic.topic
            for claim in generator.snapshot.state.ledger.application_claims("edge/fusion-2")
            for _, topic in claim.application.all_inputs()
        ]
    assert "/stations/station00/pointcloud" in topics


def test_dry_run_shows_the_consequence_and_releases_nothing(bare: Path, demandops: Run) -> None:
    with rig.running(bare) as generator:
        rig.book(generator, goal(1))
    tip = rig.tip(bare)
    code, out, _ = demandops("decommission", "vehicle01", "--dry-run", "--state-repo", bare)
    assert code == 0
    assert "would be released: connection 'vehicle01/edge' for station00, user1" in out
    assert "remove clusters/" in out
    assert rig.tip(bare) == tip


def test_a_name_without_claims_changes_nothing_and_an_unknown_name_is_refused(
    bare: Path, demandops: Run
) -> None:
    with rig.running(bare) as generator:
        rig.book(generator, goal(1))
    tip = rig.tip(bare)

    def call(name: str, *more: str) -> tuple[int, str, str]:
        return demandops("decommission", name, "--state-repo", bare, *more)

    assert call("cloud") == (0, "'cloud' holds nothing\n", "")
    assert json.loads(call("cloud", "--output", "json")[1])["outcome"] == "unchanged"
    assert call("vehicel01") == (
        1,
        "",
        "error: name: no claim names a node or requester 'vehicel01'; did you mean 'vehicle01'?\n",
    )
    assert call("user1", "--node")[0] == 1
    assert call("user1\n")[0] == 1
    assert call("")[0] == 1
    assert rig.tip(bare) == tip


def test_a_decommission_cut_off_before_it_was_published_is_taken_up_once(
    url: str, bare: Path, demandops: Run
) -> None:
    """A decommission waits in the journal like any demand, so the next start carries it out."""
    from demandops.model.demand.demand_request import Decommission

    generator = Generator(url)
    rig.book(generator, goal(1))
    leaving = Decommission("vehicle01", kinds=frozenset({"node"}))
    with rig.away(bare):
        generator.submit(leaving.goal(), "op-leave")
        assert generator.close(timeout=0.3) is False
    assert rig.restart(url) is True
    assert rig.operations(bare)[-1] == "op-leave"
    assert rig.commits(bare)[-1].one("Node") == "vehicle01"
    author = rig.git(bare, "log", "-1", "--format=%an", "main")
    assert author == "DemandOps generator", "without a person, the generator must be the author"
    rig.assert_sound(bare)


def test_no_file_of_demands_and_no_goal_decommissions(bare: Path, tmp_path: Path) -> None:
    asked: dict[str, Any] = {"kind": "Decommission", "name": "vehicle01", "as": ["node"]}
    file = tmp_path / "goal.yaml"
    file.write_text(json.dumps(asked))
    with rig.running(bare) as generator:
        rig.book(generator, goal(1))
    tip = rig.tip(bare)
    assert run(["request", str(file), "--state-repo", str(bare)]) == 1
    assert rig.tip(bare) == tip
