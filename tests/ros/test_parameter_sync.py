"""`demandops parameter-sync` keeps a running node's parameters equal to those in a ConfigMap."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from demandops.base.errors import InvalidInput
from demandops_ros.parameter_sync import as_the_node_has_it, parameters_of
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import String

from tests.kit import plain_yaml
from tests.kit.cli import Run
from tests.kit.cluster import KubeApi, kube_api
from tests.kit.http import kubeconfig
from tests.kit.limits import PATIENCE_S
from tests.kit.ros import Client, Served, Servers

TARGET = "of_edge_fusion"
FILE = """
of_edge_fusion:
  ros__parameters:
    additional_inputs: {{topics_objectlist: {topics}, length: 0}}
"""
DONE = f"set 2 parameters of /{TARGET}"
FILE_NAME = "ConfigMap perception/of-params params.yml"


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[KubeApi]:
    with kube_api() as api:
        kubeconfig(tmp_path, api.url)
        yield api


def hold(cluster: KubeApi, *topics: str, text: str = "") -> None:
    """Change the ConfigMap, which names the topics that the fusion reads."""
    data = {"params.yml": text or FILE.format(topics=list(topics))}
    cluster.put("configmaps", "perception", "of-params", {}, data=data)


StartFusion = Callable[[], "subprocess.Popen[bytes]"]


@pytest.fixture
def start_fusion(tmp_path: Path, ros_domain: int) -> Iterator[StartFusion]:
    """Return a function that starts a stand-in for the fusion; the end of the test kills it."""
    environment = os.environ | {"ROS_DOMAIN_ID": str(ros_domain), "PYTHONFAULTHANDLER": "1"}
    names = ("raw_object_lists", "fused_object_lists", "fused_trajectories")
    topics = [f"{name}_topic:=/{name}" for name in names]
    launch = ["ros2", "launch", "object_fusion", "fusion_function_launch.py"]
    standin = [sys.executable, "-m", "examples.experiment.full.standins", *launch]
    command = [*standin, f"node_name:={TARGET}", *topics]
    with ExitStack() as stack:

        def start() -> subprocess.Popen[bytes]:
            log = stack.enter_context((tmp_path / "fusion.log").open("ab"))
            process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
            stack.callback(lambda: (process.kill(), process.wait(PATIENCE_S)))
            return process

        yield start


def start_sync(servers: Servers, folder: Path, *targets: str) -> Served:
    given = {"configmap_name": "of-params", "namespace": "perception"}
    given |= {"target_ros_node": ",".join(targets or [TARGET]), "state_file": f"{folder}/state"}
    parameters = [part for name, value in given.items() for part in ("-p", f"{name}:={value}")]
    config = str(folder / "kubeconfig")
    options = ["parameter-sync", "--kubeconfig", config, "--ros-args", *parameters]
    return servers.run("", *options)


def read_by_the_fusion(client: Client) -> set[str]:
    names = client.node.get_node_names()
    if TARGET not in names:
        return set()
    topics = client.node.get_subscriber_names_and_types_by_node(TARGET, "/")
    return {name for name, _ in topics} - {"/raw_object_lists"}


def test_a_node_follows_without_a_restart_and_after_one(
    cluster: KubeApi, start_fusion: StartFusion, servers: Servers, client: Client, tmp_path: Path
) -> None:
    hold(cluster, "/a", "/b")
    fusion = start_fusion()
    sync = start_sync(servers, tmp_path)
    client.wait(lambda: read_by_the_fusion(client) == {"/a", "/b"})
    hold(cluster, "/b", "/c")
    client.wait(lambda: read_by_the_fusion(client) == {"/b", "/c"})
    assert cluster.reads <= 3  # it watches the ConfigMap, and does not poll it
    log = sync.log
    hold(cluster, text="of_edge_fusion: 5")
    fault = f"{FILE_NAME}: of_edge_fusion.ros__parameters: must be a mapping"
    client.wait(lambda: f"{fault}; {TARGET} keeps its parameters" in log.read_text())
    hold(cluster, "")
    client.wait(lambda: read_by_the_fusion(client) == set())
    times = log.read_text().count(DONE)
    assert fusion.poll() is None
    fusion.kill()
    client.wait(lambda: "not answered" in (tmp_path / "state").read_text())
    start_fusion()
    client.wait(lambda: log.read_text().count(DONE) > times)
    assert sync.stop(signal.SIGTERM) == 0, log.read_text()


def test_the_example_of_the_scaffold_follows_all_at_once_or_not_at_all(
    cluster: KubeApi,
    demandops: Run,
    servers: Servers,
    client: Client,
    ros_domain: int,
    tmp_path: Path,
) -> None:
    """Its node passes on what it reads, and keeps its process and its other subscriptions."""
    options = "--input wave=std_msgs/msg/String --image x.example/y:1 --service my-echo=echo/echo"
    repo = tmp_path / "fleet"
    assert demandops("init", repo).code == 0
    assert demandops("new", "application", "echo", *options.split(), "-C", repo).code == 0
    environment = os.environ | {"ROS_DOMAIN_ID": str(ros_domain)}
    renamed = ["--ros-args", "-r", f"__node:={TARGET}"]
    program = [sys.executable, f"{repo}/appdefs/echo/nodes/my-echo.py", *renamed]
    heard = list[str]()
    client.node.create_subscription(String, "/result", lambda text: heard.append(text.data), 10)
    writers = {name: client.node.create_publisher(String, name, 10) for name in ("/a", "/b")}

    def is_passed_on(*topics: str) -> bool:
        for name, writer in writers.items():
            writer.publish(String(data=name))
        client.executor.spin_once(timeout_sec=0.05)
        arrived = {*heard[-4:]} == {*topics}
        return arrived and read_by_the_fusion(client) == {*topics}

    def want(topics: list[str], **more: object) -> None:
        parameters = {"wave_topics": topics, "result_topic": "/result", **more}
        hold(cluster, text=json.dumps({TARGET: {"ros__parameters": parameters}}))

    with subprocess.Popen(program, env=environment) as node:
        try:
            want(["/a"])
            sync = start_sync(servers, tmp_path)
            client.wait(lambda: is_passed_on("/a"))
            want(["/a", "/b"])
            client.wait(lambda: is_passed_on("/a", "/b"))
            # nothing of a change that the node refuses, and its reason where a probe shows it
            want(["/b", "two words"], result_topic="/elsewhere")
            state = tmp_path / "state"
            client.wait(lambda: "refused its parameters: wave_topics: " in state.read_text())
            assert "'two words'" in sync.log.read_text()
            client.wait(lambda: is_passed_on("/a", "/b"))
            want([""])
            client.wait(lambda: state.read_text() == "set\n")
            client.wait(lambda: read_by_the_fusion(client) == set())
            assert node.poll() is None
        finally:
            node.kill()


def test_several_nodes_get_the_types_that_they_have_and_what_they_had_before(
    cluster: KubeApi, servers: Servers, client: Client, tmp_path: Path
) -> None:
    free = {"context": client.node.context, "allow_undeclared_parameters": True}
    elsewhere = ["--ros-args", "-r", "/parameter_events:=/elsewhere"]
    nodes = [Node("first", **free), Node("second", **free, cli_args=elsewhere)]
    for node in nodes:
        client.executor.add_node(node)
        node.declare_parameter("rate", 0.5)
        node.declare_parameter("ids", [1])
        node.declare_parameter("limit", Parameter.Type.DOUBLE)  # it has no value to go back to
    (tmp_path / "state.first").write_bytes(b"")  # a power cut may leave this of the memory
    is_ready = False
    nodes[1].add_on_set_parameters_callback(
        lambda changes: SetParametersResult(successful=is_ready, reason="not yet")
    )
    section = {"ros__parameters": {"rate": 10, "ids": [""], "undeclared": 1, "limit": 2}}
    odd = {"ros__parameters": {"rate": "ten"}}
    hold(cluster, text=json.dumps({"first": odd, "second": section}))
    sync, state = start_sync(servers, tmp_path, "first", "second"), tmp_path / "state"
    client.wait(lambda: state.is_file() and "rate is DOUBLE there, not STR" in state.read_text())
    client.wait(lambda: "not yet" in sync.log.read_text())
    hold(cluster, text=json.dumps({"first": section, "second": section}))
    client.wait(lambda: nodes[0].get_parameter("rate").value == 10.0)
    assert list(nodes[0].get_parameter("ids").value) == []
    client.wait(lambda: state.read_text() == "/second refused its parameters: not yet")
    client.wait(lambda: sync.log.read_text().count("not yet") == 2)  # once for each change
    is_ready = True
    client.wait(lambda: state.read_text() == "set\n")
    assert nodes[1].get_parameter("rate").value == 10.0
    assert sync.log.read_text().count("not yet") == 2, "a refusal again is not told"
    # without the memory of the process that set them first
    assert sync.stop(signal.SIGTERM) == 0
    hold(cluster, text="first: {ros__parameters: {ids: [2]}}\nsecond:\n  ros__parameters:\n")
    start_sync(servers, tmp_path, "first", "second")
    client.wait(lambda: [n.get_parameter("rate").value for n in nodes] == [0.5, 0.5])
    client.wait(lambda: state.read_text() == "set\n")
    assert [list(node.get_parameter("ids").value) for node in nodes] == [[2], [1]]
    assert not any(node.has_parameter("undeclared") for node in nodes)
    for node in nodes:
        node.destroy_node()


def test_a_value_gets_the_type_of_the_node() -> None:
    kinds = Parameter.Type
    for value, kind, expected in (
        (3, kinds.DOUBLE, kinds.DOUBLE),
        (3.0, kinds.INTEGER, kinds.INTEGER),
        (1e300, kinds.INTEGER, kinds.DOUBLE),  # which the node refuses
        (True, kinds.DOUBLE, kinds.BOOL),  # which the node refuses
        ([1, 2], kinds.DOUBLE_ARRAY, kinds.DOUBLE_ARRAY),
        ([1, 2.5], kinds.NOT_SET, kinds.DOUBLE_ARRAY),
        ([1, 2], kinds.NOT_SET, kinds.INTEGER_ARRAY),
        ([], kinds.STRING_ARRAY, kinds.STRING_ARRAY),
        ([""], kinds.BOOL_ARRAY, kinds.BOOL_ARRAY),
        ([""], kinds.STRING, kinds.STRING_ARRAY),
    ):
        assert as_the_node_has_it("x", value, kind).type_ is expected, (value, kind)
    assert as_the_node_has_it("x", [""], kinds.STRING_ARRAY).value == [""]


def test_parameters_have_dotted_names_and_a_file_that_gives_a_node_nothing_is_refused() -> None:
    text = "/**: {ros__parameters: {a: 1, b: {c: 2}}}\n/node: {ros__parameters: {b: {c: [x]}}}\n"
    assert parameters_of("node", text, "f") == {"a": 1, "b.c": ["x"]}  # a node overrides all nodes
    text = "/f/*: {ros__parameters: {a: 2}}\n/**/n: {ros__parameters: {a: 1}}\n/*: 5\nf/m: 5\n"
    assert parameters_of("f/n", text, "f") == {"a": 2}
    assert Parameter("b.c", value=["x"]).type_ is Parameter.Type.STRING_ARRAY
    for text, told in plain_yaml.beside(__file__, "refused")["parameter files"]:
        with pytest.raises(InvalidInput) as refused:
            parameters_of("/node", text, "f")
        assert str(refused.value) == f"f: {told}"


def test_what_cannot_be_used_is_refused_at_the_start(servers: Servers, tmp_path: Path) -> None:
    (tmp_path / "kubeconfig").write_text("kind: Config")
    no_access, no_name = start_sync(servers, tmp_path), servers.run("", "parameter-sync")
    assert no_access.process.wait(PATIENCE_S) == 1
    no_access.wait_for(f"{tmp_path}/kubeconfig: --kubeconfig: cannot be used: Invalid kube-con")
    assert no_name.process.wait(PATIENCE_S) == 2
    no_name.wait_for("parameter configmap_name is not set; use --ros-args -p configmap_name:=VALUE")
