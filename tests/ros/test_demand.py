"""DemandOps' own action over real ROS 2: client library, leases, latched topic, command line."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops_interfaces.msg import Bookkeeping
from demandops_ros import DemandClient, DemandError
from rclpy.qos import QoSDurabilityPolicy, QoSProfile

from tests.kit import plain_yaml
from tests.kit.cli import Run
from tests.kit.goals import EXPERIMENT
from tests.kit.limits import PATIENCE_S
from tests.kit.repo import git, tip
from tests.kit.rig import wait_until
from tests.kit.ros import Client, Served

REFUSED = plain_yaml.load(Path(__file__).with_name("refused.yaml").read_text())
POINTS = "/vehicles/vehicle00/drivers/lidar/pointcloud"
RECORDER: dict[str, Any] = {
    "id": "edge/record",
    "type": "recorder",
    "node": "edge",
    "inputs": {"point_cloud": [{"topic": POINTS, "source": "vehicle00"}]},
    "parameters": {"rate": 10, "labels": ["night"]},
}


def link(id: str) -> dict[str, Any]:
    # of its own, because one connection carries a topic for all who demand it
    topics = [
        {"source": f"/{id}/a", "qos": 1, "reverse": True},
        {"source": f"/{id}/b", "target": f"/{id}/c"},
    ]
    return {"id": id, "source": "vehicle00", "target": "edge", "topics": topics}


def operations(served: Served, since: str) -> list[str]:
    form = "--format=%(trailers:key=Operation,valueonly)"
    return git(served.state_repo, "log", "--reverse", form, f"{since}..main").split()


@pytest.fixture
def before(shared: Served) -> str:
    """The newest commit of the shared node's state repo when the test begins."""
    return tip(shared.state_repo)


def test_a_third_type_of_application_is_demanded_with_yaml_alone(
    shared: Served, vehicle: DemandClient, before: str
) -> None:
    stages: list[str] = []
    with vehicle.demand(
        "v0/recording", [RECORDER], on_stage=lambda stage, _: stages.append(stage)
    ) as held:
        assert held.answer is not None and held.answer.outcome == "booked"
        assert held.answer.warnings == ()
        books = shared.bookkeeping()
        assert {entry["service"] for entry in books["services"].values()} == {"driver", "recorder"}
        assert any(id.startswith("derived/vehicle00/edge/") for id in books["connections"])
        assert books["commit"] == held.commit
    assert shared.bookkeeping()["services"] == {}
    assert operations(shared, before) == ["put", "release"]
    # an action client may miss the first feedback, and drops feedback that comes after the result
    assert stages == [s for s in ("admitted", "booked", "committed", "pushed") if s in stages]


def test_every_field_is_in_the_message_and_named_in_a_refusal(
    shared: Served, vehicle: DemandClient, before: str
) -> None:
    for fields, told in REFUSED["fields"]:
        with pytest.raises(DemandError) as caught:
            vehicle.put("refused", [RECORDER | fields])
        assert told in str(caught.value)
    with pytest.raises(DemandError) as caught:
        vehicle.release("refused")
    assert caught.value.code == "not-held"
    with pytest.raises(ValueError, match="'node_id' is not a field of an application; did you"):
        vehicle.put("refused", [{"node_id": "edge"}])
    with pytest.raises(ValueError, match="surrogates not allowed"):
        vehicle.put("refused \ud800")
    assert tip(shared.state_repo) == before
    # without access to the clusters, a goal is answered at `pushed`
    answer = vehicle.put("refused", connections=[link("refused")], answer="healthy")
    assert (answer.outcome, answer.reached) == ("booked", "pushed")
    (warning,) = answer.warnings
    assert warning.endswith("not at 'healthy': this node has no access to the clusters")
    topics = shared.bookkeeping()["connections"]["refused"]["topics"]
    assert topics == {"/refused/a": ["vehicle00"], "/refused/b": ["vehicle00"]}


def test_a_goal_that_is_sent_again_because_no_response_came_counts_once(
    shared: Served, vehicle: DemandClient, before: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(DemandError):  # after an answer, the client need not be discovered any more
        vehicle.renew("again")
    receive, lost = vehicle._sender._await, [DemandError("timeout", "the response was lost")]

    def lose_first(future: Any, deadline: float) -> Any:
        if lost:
            raise lost.pop()
        return receive(future, deadline)

    monkeypatch.setattr(vehicle._sender, "_await", lose_first)
    answer = vehicle.put("again", connections=[link("again")])
    assert answer.outcome == "unchanged", "the goal whose response was lost must be booked"
    assert operations(shared, before) == ["put"]


def test_a_held_demand_is_renewed_and_put_again_if_it_has_ended(
    shared: Served, vehicle: DemandClient, before: str
) -> None:
    with vehicle.demand("lost", connections=[link("lost")], lease=3) as held:
        first = held.commit
        wait_until(lambda: "renew" in operations(shared, before), "the lease is renewed")
        vehicle.release("lost")
        wait_until(lambda: held.commit != first, "the demand is put again")


def test_the_bookkeeping_is_published_and_latched(vehicle: DemandClient, caller: Client) -> None:
    commit = vehicle.put("latched", connections=[link("latched")]).commit
    heard: list[Any] = []
    qos = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
    caller.node.create_subscription(Bookkeeping, "/demandops/bookkeeping", heard.append, qos)
    caller.wait(lambda: any(message.commit == commit for message in heard))
    books = json.loads(heard[-1].bookkeeping_json)
    assert books["commit"] == commit and "latched" in books["connections"]


def test_the_command_line_sends_holds_and_gives_up(
    shared: Served, before: str, demandops: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(shared.domain))
    file = tmp_path / "demand.yaml"
    document = {"apiVersion": "demandops/v1", "kind": "Demand", "demand": "typed"}
    document |= {"requesters": ["vehicle01"], "connections": [link("typed")]}
    file.write_text(yaml.safe_dump(document | {"request": 5}))
    wrong = demandops("demand", file)
    assert wrong.code == 1
    assert f"{file}: request 0 '' refused\n  line " in wrong.err
    file.write_text(yaml.safe_dump(document))
    sent = demandops("demand", file, "--output", "json")
    assert sent.code == 0, sent.err
    (row,) = sent.json()
    assert (row["request"], row["outcome"], row["reached"]) == ("typed", "booked", "pushed")
    again = demandops("demand", file)
    assert again.out.startswith(f"{file}: request 0 'typed' unchanged in ")
    assert again.err.endswith("(by a node, over ROS)\n")
    assert "'typed' released in " in demandops("demand", file, "--release").out
    gone = demandops("demand", file, "--release", "--output", "json")
    assert [each["code"] for each in gone.json()[0]["faults"]] == ["not-held"]
    assert gone.code == 1
    holding = subprocess.Popen(
        [sys.executable, "-m", "demandops.cli.main", "demand", str(file), "--hold"],
        env=shared.environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    held = ["put", "release", "put"]
    wait_until(lambda: operations(shared, before) == held, "the demand is held")
    holding.send_signal(signal.SIGINT)
    out, err = holding.communicate(timeout=PATIENCE_S)
    assert holding.returncode == 0, err
    assert "'typed' booked in " in out and "held until Ctrl-C\nreleased\n" in err
    assert operations(shared, before) == [*held, "release"]


def test_the_command_line_sends_goals_of_the_reference(
    shared: Served, before: str, demandops: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(shared.domain))
    joins = EXPERIMENT[0]
    sent = demandops("demand", joins, "--via", "ros", "--output", "json")
    (row,) = sent.json()
    assert (row["outcome"], row["commit"]) == ("booked", tip(Path(shared.state_repo))), sent.err
    assert (row["warnings"], row["effects"][0].split()[0]) == ([], "starts")
    gone = demandops("demand", joins, "--via", "ros", "--release")
    assert ("released in " in gone.out, "\n  stops " in gone.out) == (True, True), gone.err
    assert operations(shared, before) == ["join", "shutdown"]
    again = demandops("demand", joins, "--via", "ros", "--release", "--output", "json")
    assert [each["code"] for each in again.json()[0]["faults"]] == ["not-held"]
    held = demandops("demand", joins, "--via", "ros", "--hold")
    assert (held.code, "--hold is for documents of the kind Demand" in held.err) == (2, True)
