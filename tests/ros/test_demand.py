"""Our own action over real ROS 2: the client library, leases, the latched topic, the command."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
import yaml
from demandops.settings import DEFAULT_DEMAND_ACTION_NAME
from demandops_interfaces.action import Demand
from demandops_interfaces.msg import Bookkeeping
from demandops_ros import DemandClient, DemandError
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSDurabilityPolicy, QoSProfile

from tests.kit.repo import GitRepo, git
from tests.kit.repo import init as new_state_repo
from tests.kit.repo import read as text
from tests.kit.ros import Serve

APPDEFS = Path(__file__).parent.parent / "appdefs"
POINTS = "/vehicles/vehicle00/drivers/lidar/pointcloud"
RECORDER: dict[str, Any] = {
    "id": "edge/record",
    "type": "recorder",
    "node": "edge",
    "inputs": {"point_cloud": [{"topic": POINTS, "source": "vehicle00"}]},
    "parameters": {"rate": 10, "labels": ["night"]},
}
LINK = {
    "id": "link",
    "source": "vehicle00",
    "target": "edge",
    "topics": [{"source": "/a", "qos": 1, "reverse": True}, {"source": "/b", "target": "/c"}],
}


def with_policy(state_repo: Path, **more: Any) -> None:
    path = "policy/access-domains.yaml"
    policy = yaml.safe_load(text(state_repo, path))
    policy["domains"][0] |= more
    GitRepo(state_repo).commit({path: yaml.safe_dump(policy)})


@pytest.fixture
def client(ros_domain: int) -> Iterator[DemandClient]:
    with DemandClient("vehicle00", domain_id=ros_domain) as made:
        yield made


def operations(state_repo: Path) -> list[str]:
    form = "--format=%(trailers:key=Operation,valueonly)"
    return git(state_repo, "log", "--reverse", form, "main").split()


def wait(condition: Any, what: str, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"waited {seconds:g} s for {what}"
        time.sleep(0.05)


def test_a_third_type_of_application_is_demanded_with_yaml_alone(
    serve: Serve, client: DemandClient, tmp_path: Path
) -> None:
    state = new_state_repo(tmp_path / "state.git")
    charts, images = "registry/charts.yaml", "registry/images.yaml"
    folder = "appdefs/recorder/charts/recorder"
    added = {
        f"appdefs/{path.relative_to(APPDEFS).as_posix()}": path.read_text()
        for path in sorted((APPDEFS / "recorder").rglob("*"))
        if path.is_file()
    }
    chart = f"  recorder:\n    folder: {folder}\n    version: 0.1.0\n"
    added[charts] = text(state, charts) + chart
    added[images] = text(state, images) + "".join(
        f"  {name}:\n    repository: ghcr.io/example/{name}\n    tag: v1\n"
        for name in ("driver", "recorder")
    )
    GitRepo(state).commit(added)
    served = serve(str(state))
    stages: list[str] = []
    with client.demand(
        "v0/recording", [RECORDER], on_stage=lambda stage, _: stages.append(stage)
    ) as it:
        assert it.answer is not None and it.answer.outcome == "booked"
        assert it.answer.warnings == ()
        books = served.bookkeeping()
        assert {entry["service"] for entry in books["services"].values()} == {"driver", "recorder"}
        assert list(books["connections"]) == ["derived/vehicle00/edge"]
        assert books["commit"] == it.commit
    assert served.bookkeeping()["services"] == {}
    assert operations(state)[-2:] == ["put", "release"]
    # an action client may miss feedback at the start, and forgets it once it has the result
    assert stages == [s for s in ("admitted", "booked", "committed", "pushed") if s in stages]


def test_a_refusal_names_code_field_and_remedy(serve: Serve, client: DemandClient) -> None:
    served = serve()
    with pytest.raises(DemandError) as caught:
        client.put("d", [RECORDER | {"type": "recoder", "node": "egde"}])
    assert caught.value.code == "unknown-application"
    assert "applications[0].type: 'recoder' is not a known application type" in str(caught.value)
    assert "applications[0].node: 'egde' is not in inventory/nodes.yaml" in str(caught.value)
    with pytest.raises(DemandError) as caught:
        client.release("d")
    assert caught.value.code == "not-held"
    with pytest.raises(
        ValueError, match="'node_id' is not a field of an application; did you mean"
    ):
        client.put("d", [{"node_id": "edge"}])
    assert client.put("d", connections=[LINK]).outcome == "booked"
    assert served.bookkeeping()["connections"]["link"]["topics"] == ["/a", "/b"]


def test_without_access_to_the_clusters_a_goal_is_answered_at_pushed(
    serve: Serve, client: DemandClient
) -> None:
    serve()
    answer = client.put("d", connections=[LINK], answer="healthy")
    assert (answer.outcome, answer.reached) == ("booked", "pushed")
    assert answer.warnings == ("answered at pushed: this node has no access to the clusters",)


def test_numbers_that_the_message_does_not_define_are_refused_with_their_field(
    serve: Serve, ros_domain: int
) -> None:
    serve()
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=ros_domain)
    node = rclpy.create_node("raw", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    raw = ActionClient(node, Demand, DEFAULT_DEMAND_ACTION_NAME)
    try:
        assert raw.wait_for_server(60)
        goal = Demand.Goal(operation=7, demand_id="d", requester_ids=["r"], answer=9)
        sent = raw.send_goal_async(goal)
        executor.spin_until_future_complete(sent, 60)
        done = sent.result().get_result_async()
        executor.spin_until_future_complete(done, 60)
        result = done.result().result
    finally:
        node.destroy_node()
        context.try_shutdown()
    assert result.code == "invalid"
    fields = [line.split(": ")[1] for line in result.message.split("\n")]
    assert {"operation", "answer"} <= set(fields)


def test_a_client_that_dies_loses_its_demand_and_one_that_lives_keeps_it(
    serve: Serve, client: DemandClient, tmp_path: Path
) -> None:
    state = new_state_repo(tmp_path / "state.git")
    with_policy(state, leases={"default": "2s", "slack": "0s"})
    served = serve(str(state))
    other = {**LINK, "id": "other"}
    with client.demand("kept", connections=[LINK]) as kept:
        assert kept.answer is not None and kept.answer.lease_s == 2
        assert client.put("left", connections=[other]).lease_s == 2
        wait(lambda: "expire" in operations(state), "the lease of the other to end")
        books = served.bookkeeping()["connections"]
        assert list(books) == ["link"], "renewed every third of two seconds"
    assert served.bookkeeping()["connections"] == {}


def test_the_bookkeeping_is_published_and_latched(
    serve: Serve, client: DemandClient, ros_domain: int
) -> None:
    serve()
    commit = client.put("d", connections=[LINK]).commit
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=ros_domain)
    node = rclpy.create_node("late", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    heard: list[Any] = []
    qos = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(Bookkeeping, "/demandops/bookkeeping", heard.append, qos)
    try:
        end = time.monotonic() + 60
        while not any(told.commit == commit for told in heard):
            assert time.monotonic() < end, "nothing is latched"
            executor.spin_once(0.1)
    finally:
        node.destroy_node()
        context.try_shutdown()
    books = json.loads(heard[-1].bookkeeping_json)
    assert books["commit"] == commit and list(books["connections"]) == ["link"]


def command(*args: str) -> list[str]:
    return [sys.executable, "-m", "demandops.cli.main", "demand", *args]


def test_the_command_line_sends_holds_and_gives_up(serve: Serve, tmp_path: Path) -> None:
    served = serve()
    state = Path(served.state_repo)
    file = tmp_path / "demand.yaml"
    document = {"apiVersion": "demandops/v1", "kind": "Demand", "demand": "d", "requesters": ["v"]}
    file.write_text(yaml.safe_dump(document | {"connections": [LINK]}))

    def run(*args: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            command(str(file), *args),
            check=False,
            env=served.environment,
            capture_output=True,
            text=True,
            timeout=90,
        )

    sent = run("--output", "json")
    assert sent.returncode == 0, sent.stderr
    assert json.loads(sent.stdout)["outcome"] == "booked"
    assert run().stdout.startswith("unchanged in ")
    assert run("--release").stdout.startswith("released in ")
    gone = run("--release")
    assert gone.returncode == 1 and "not-held: demand: 'd' holds nothing" in gone.stderr
    holding = subprocess.Popen(
        command(str(file), "--hold"),
        env=served.environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    wait(lambda: operations(state)[-1] == "put", "the demand to be held")
    holding.send_signal(signal.SIGINT)
    out, told = holding.communicate(timeout=60)
    assert holding.returncode == 0, told
    assert out.startswith("booked in ") and told.endswith("released\n")
    assert operations(state)[-1] == "release"


def test_who_may_not_is_told_which_rule_says_so(
    serve: Serve, client: DemandClient, tmp_path: Path
) -> None:
    state = new_state_repo(tmp_path / "state.git")
    with_policy(state, rules=[{"name": "stations", "requesters": ["station*"]}])
    serve(str(state))
    with pytest.raises(DemandError) as caught:
        client.put("d", connections=[LINK])
    assert caught.value.code == "not-allowed"
    assert "no rule of access domain 'perception' is for 'vehicle00'" in str(caught.value)
