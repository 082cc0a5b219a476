"""`demandops decommission` releases everything of a node or a requester in one commit."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from demandops.connections.connection import Connection, Route
from demandops.connections.mqtt import MQTT
from demandops.model.demand import goals
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger.claim import Claim
from demandops.serve.generator import Generator

from tests.kit import rig
from tests.kit.cli import Ran, Run
from tests.kit.memory import NOW
from tests.kit.repo import GitRepo
from tests.kit.rig import Person, goal


@pytest.fixture
def decommission(demandops: Run, bare: Path) -> Run:
    def ran(*args: object) -> Ran:
        return demandops("decommission", *args, "--yes", "--state-repo", bare)

    return ran


def test_a_node_gives_up_all_and_can_be_deleted_from_the_inventory(
    url: str, bare: Path, person: Person, demandops: Run
) -> None:
    """A running generator fetches the commit of `decommission` and the person's deletion."""
    with rig.running(url, fetch_interval=0.1) as generator:
        rig.book(generator, goal(1), goal(2), goal(6))
        code, out, err = demandops("decommission", "vehicle01", "--yes", "--state-repo", url)
        assert (code, err) == (0, "")
        commit = rig.commits(bare)[-1]
        assert out.splitlines() == [
            "reduced:  application 'edge/fusion-1' for station00, user1; kept for station00, user1",
            "released: connection 'vehicle01/edge' for station00, user1",
            f"'vehicle01' is decommissioned in {commit.id}",
        ]
        assert commit.summary == "Decommission vehicle01"
        assert (commit.one("Operation"), commit.one("Node")) == ("decommission", "vehicle01")
        assert commit.all("Requester") == ["station00", "user1"]
        assert commit.all("Application") == ["edge/fusion-1"]
        assert commit.all("Connection") == ["vehicle01/edge"]
        author = rig.git(bare, "log", "-1", "--format=%an <%ae> %cn", commit.id)
        assert author == "Petra Platform <petra@example.org> DemandOps generator"
        person.change(rig.without_vehicle01(bare), "vehicle01 is sold")
        person.fetch()
        assert demandops("check", person.folder)[0] == 0
        rig.wait_until(
            lambda: "vehicle01" not in generator.snapshot.state.config.nodes,
            "the generator has followed the inventory",
        )
        assert generator.snapshot.problems == ()
        rig.book(generator, goal(3))
    assert rig.claims(bare, "vehicle01") == []
    rig.assert_sound(bare)


def test_with_a_requester_goes_all_that_is_claimed_in_its_name(
    generator: Generator, bare: Path, decommission: Run
) -> None:
    rig.book(generator, goal(1), goal(2))
    told = decommission("user1", "--output", "json").json()
    assert (told["name"], told["outcome"], told["commit"]) == ("user1", "released", rig.tip(bare))
    assert {claim["subject"]["id"]: claim["left"] for claim in told["claims"]} == dict.fromkeys(
        ("edge/fusion-1", "vehicle01/edge", "derived/station00/edge/stations/station00/pointcloud")
    )
    commit = rig.commits(bare)[-1]
    assert (commit.all("Node"), commit.all("Requester")) == ([], ["station00", "user1"])
    assert (rig.claims(bare, "user1"), len(rig.claims(bare, "user2"))) == ([], 3)
    rig.book(generator, goal(1))  # user1 may demand again
    rig.assert_sound(bare)


def test_a_claim_from_before_ids_had_one_form_can_be_released(
    generator: Generator, bare: Path, decommission: Run
) -> None:
    link = Connection("c", MQTT, "vehicle00", "edge", "edge", (Route("/a", "/a"),))
    old = Claim(link, "cafe\u0301", "d", ("user1",), NOW)
    GitRepo(bare).commit({claim_files.path_of(old.key): claim_files.text_of(old)})
    generator.fetch_now()
    rig.wait_until(lambda: generator.snapshot.state.ledger.get(old.key), "the claim is read")
    assert decommission("user1").code == 0
    assert rig.claims(bare) == []
    rig.assert_sound(bare)


def test_what_releases_nothing_changes_nothing(
    generator: Generator, bare: Path, decommission: Run
) -> None:
    rig.book(generator, goal(1))
    tip = rig.tip(bare)
    code, out, _ = decommission("vehicle01", "--dry-run")
    assert (code, "would be released: connection 'vehicle01/edge'" in out) == (0, True)
    assert "RELEASES 2 claims and STOPS 2 releases of 2 requesters\n" in out
    assert decommission("cloud") == (0, "'cloud' holds nothing\n", "")
    assert decommission("cloud", "--output", "json").json()["outcome"] == "unchanged"
    assert "did you mean 'vehicle01'?" in decommission("vehicel01").err
    for args in (["vehicel01"], ["user1", "--node"], ["user1\n"], [""]):
        assert decommission(*args).code == 1
    assert rig.tip(bare) == tip


def test_a_decommission_cut_off_before_it_was_published_is_taken_up_once(
    url: str, bare: Path
) -> None:
    """A decommission waits in the journal like any demand, so the next start carries it out."""
    generator = Generator(url)
    rig.book(generator, goal(1))
    leaving = goals.decommission("vehicle01", frozenset({"node"}), "", "")
    with rig.away(bare):
        generator.submit(leaving, "op-leave")
        assert generator.close(timeout=0.3) is False
    assert rig.restart(url) is True
    assert rig.operations(bare)[-1] == "op-leave"
    assert rig.commits(bare)[-1].one("Node") == "vehicle01"
    author = rig.git(bare, "log", "-1", "--format=%an", "main")
    assert author == "DemandOps generator", "without a person, the generator must be the author"
    rig.assert_sound(bare)


def test_no_file_of_demands_and_no_goal_decommissions(
    generator: Generator, bare: Path, demandops: Run
) -> None:
    rig.book(generator, goal(1))
    tip, asked = rig.tip(bare), {"kind": "Decommission", "name": "vehicle01", "as": ["node"]}
    ran = demandops("request", "-", "--state-repo", bare, stdin=yaml.safe_dump(asked))
    assert (ran.code, rig.tip(bare)) == (1, tip)
