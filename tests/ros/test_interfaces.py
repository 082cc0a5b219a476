"""The ROS 2 interfaces: their wire format, the script that builds them, and one round trip.

Run as a script, this file is the round trip itself, so that it can be given an environment.
"""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

INTERFACES = Path(__file__).resolve().parents[2] / "ros_bridge" / "interfaces"
BUILD = INTERFACES / "build.py"
OURS = "application_manager_interfaces"

# What the clients of the reference announce: with another hash they would not connect.
TYPE_HASH = "RIHS01_1190e6ea1469f559e7fc3c50e3255e75c519f1e3ed29a5f860b0ad8f41786bd9"

needs_ros = pytest.mark.skipif(
    importlib.util.find_spec("rclpy") is None, reason="the ROS 2 wheels are not installed"
)


def run_build(*arguments: str, **environ: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(BUILD), *arguments],
        env={**os.environ, **environ},
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )


@pytest.fixture(scope="module")
def built() -> None:
    """Our interfaces in the environment that runs the tests."""
    result = run_build()
    assert result.returncode == 0, result.stdout + result.stderr


# The wire format


def described(path: str) -> dict[str, str]:
    """The type hashes in a generated type description, by type."""
    file = Path(sys.prefix) / "share" / path
    hashes = json.loads(file.read_text(encoding="utf-8"))["type_hashes"]
    return {entry["type_name"]: entry["hash_string"] for entry in hashes}


@needs_ros
@pytest.mark.usefixtures("built")
def test_the_action_has_the_type_hash_of_the_reference() -> None:
    hashes = described(f"{OURS}/action/DeploymentRequest.json")
    assert hashes[f"{OURS}/action/DeploymentRequest"] == TYPE_HASH


FIELDS: dict[str, dict[str, tuple[str, object]]] = {
    "Application": {
        "header": (f"{OURS}/ApplicationHeader", None),
        "type": ("uint8", 0),
        "object_detection_fusion_app": (f"{OURS}/ObjectDetectionFusionApp", None),
    },
    "ApplicationHeader": {"id": ("string", ""), "node_id": ("string", "")},
    "ObjectDetectionFusionApp": {
        "requester_ids": ("sequence<string>", []),
        "ego_data_topics": (f"sequence<{OURS}/Topic>", []),
        "pointcloud_topics": (f"sequence<{OURS}/Topic>", []),
    },
    "Connection": {
        "id": ("string", ""),
        "broker_node_id": ("string", ""),
        "requester_ids": ("sequence<string>", []),
        "source_node_id": ("string", ""),
        "source_topics": ("sequence<string>", []),
        "target_node_id": ("string", ""),
        "target_topics": ("sequence<string>", []),
        "type": ("uint8", 0),
    },
    "Topic": {
        "topic_name": ("string", ""),
        "source_node_id": ("string", ""),
        "type": ("string", ""),
    },
}


def check_fields(message: Any, expected: dict[str, tuple[str, object]]) -> None:
    types = {name: field_type for name, (field_type, _) in expected.items()}
    assert list(message.get_fields_and_field_types().items()) == list(types.items())
    made = message()
    for name, (_, default) in expected.items():
        if default is not None:
            assert getattr(made, name) == default, name


@needs_ros
@pytest.mark.usefixtures("built")
@pytest.mark.parametrize("name", FIELDS)
def test_a_message_has_the_fields_of_the_contract(name: str) -> None:
    messages = importlib.import_module(f"{OURS}.msg")
    check_fields(getattr(messages, name), FIELDS[name])


@needs_ros
@pytest.mark.usefixtures("built")
def test_the_action_has_the_fields_of_the_contract() -> None:
    from application_manager_interfaces.action import DeploymentRequest

    check_fields(
        DeploymentRequest.Goal,
        {
            "apps": (f"sequence<{OURS}/Application>", []),
            "connections": (f"sequence<{OURS}/Connection>", []),
            "id": ("string", ""),
            "shutdown": ("boolean", False),
        },
    )
    check_fields(DeploymentRequest.Result, {"message": ("string", "")})
    check_fields(DeploymentRequest.Feedback, {"message": ("string", "")})


@needs_ros
@pytest.mark.usefixtures("built")
def test_the_constants_have_the_values_of_the_contract() -> None:
    from application_manager_interfaces.msg import Application, Connection

    assert Application.TYPE_OBJECT_DETECTION_FUSION == 1
    assert (Connection.TYPE_ROS, Connection.TYPE_MQTT, Connection.TYPE_ZENOH) == (0, 1, 2)


@needs_ros
@pytest.mark.usefixtures("built")
def test_the_bookkeeping_is_a_service() -> None:
    from demandops_interfaces.srv import GetBookkeeping

    check_fields(GetBookkeeping.Request, {"at": ("string", "")})
    check_fields(
        GetBookkeeping.Response,
        {
            "ok": ("boolean", False),
            "message": ("string", ""),
            "commit": ("string", ""),
            "bookkeeping_json": ("string", ""),
        },
    )


# The round trip


@needs_ros
@pytest.mark.usefixtures("built")
def test_a_goal_goes_round_with_nothing_set_by_hand(tmp_path: Path, ros_domain: int) -> None:
    alone = {
        "HOME": str(tmp_path),
        "ROS_DOMAIN_ID": str(ros_domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    result = subprocess.run(
        [sys.executable, __file__],
        env=alone,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout) == {
        "feedback": ["booked"],
        "result": "corridor: edge/object_detection_fusion on edge-west, "
        "/vehicle00/points as /vehicle00/points over 1",
        "status": 4,
    }


def round_trip() -> None:
    """One goal from a client to a server in this process; prints what came back."""
    import rclpy
    from application_manager_interfaces.action import DeploymentRequest
    from application_manager_interfaces.msg import Application, Connection
    from rclpy.action import ActionClient, ActionServer

    def execute(handle: Any) -> Any:
        (app,), (connection,) = handle.request.apps, handle.request.connections
        handle.publish_feedback(DeploymentRequest.Feedback(message="booked"))
        handle.succeed()
        return DeploymentRequest.Result(
            message=f"{handle.request.id}: {app.header.id} on {app.header.node_id}, "
            f"{connection.source_topics[0]} as {connection.target_topics[0]} "
            f"over {connection.type}"
        )

    rclpy.init()
    node = rclpy.create_node("round_trip")
    server = ActionServer(node, DeploymentRequest, "demand", execute)
    client = ActionClient(node, DeploymentRequest, "demand")
    if not client.wait_for_server(timeout_sec=30):
        sys.exit("no server was discovered")

    goal = DeploymentRequest.Goal(id="corridor")
    goal.apps = [Application(type=Application.TYPE_OBJECT_DETECTION_FUSION)]
    goal.apps[0].header.id = "edge/object_detection_fusion"
    goal.apps[0].header.node_id = "edge-west"
    points = ["/vehicle00/points"]
    goal.connections = [
        Connection(source_topics=points, target_topics=points, type=Connection.TYPE_MQTT)
    ]
    feedback: list[str] = []
    sent = client.send_goal_async(
        goal, feedback_callback=lambda got: feedback.append(got.feedback.message)
    )
    rclpy.spin_until_future_complete(node, sent, timeout_sec=30)
    done = sent.result().get_result_async()
    rclpy.spin_until_future_complete(node, done, timeout_sec=30)
    answer = done.result()
    print(
        json.dumps({"feedback": feedback, "result": answer.result.message, "status": answer.status})
    )
    client.destroy()
    server.destroy()
    node.destroy_node()
    rclpy.shutdown()


# The script that builds them, as it runs


@needs_ros
@pytest.mark.usefixtures("built")
def test_nothing_changed_is_seen_without_a_compiler() -> None:
    result = run_build(PATH="")
    assert (result.returncode, result.stdout, result.stderr) == (
        0,
        f"interfaces: up to date in {sys.prefix}\n",
        "",
    )


@needs_ros
@pytest.mark.usefixtures("built")
def test_missing_tools_are_named_with_their_packages() -> None:
    result = run_build("--force", PATH="")
    assert (result.returncode, result.stdout, result.stderr) == (
        1,
        "",
        "not found: cmake, a C compiler, a C++ compiler, make or ninja\n"
        "install with: apt-get install build-essential cmake\n",
    )


def test_a_build_folder_inside_the_sources_is_refused() -> None:
    result = run_build("--build-dir", str(INTERFACES / "build"))
    assert result.returncode == 2
    assert result.stderr.endswith(
        f"error: --build-dir {INTERFACES / 'build'} is inside the sources; choose another\n"
    )


# The script that builds them, over a CMake that only writes what it was asked for

FAKE_CMAKE = """#!{python}
import sys
from pathlib import Path

prefix = Path({prefix!r})
what, folder = sys.argv[1], Path(sys.argv[2])
with (prefix / "calls").open("a") as calls:
    print(what if what.startswith("--") else "configure", file=calls)
print("as", what)
if (prefix / ("fail" + what)).exists():
    sys.exit("no space left")
if what == "--install":
    library = prefix / "lib" / f"lib{{folder.name}}__typesupport.so"
    library.parent.mkdir(exist_ok=True)
    library.touch()
    folder.mkdir(exist_ok=True)
    (folder / "install_manifest.txt").write_text(str(library))
"""


@pytest.fixture
def script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """A copy of the script with a prefix of its own and the CMake above."""
    copy, prefix, tools = (tmp_path / name for name in ("interfaces", "prefix", "bin"))
    shutil.copytree(INTERFACES, copy, ignore=shutil.ignore_patterns("__pycache__"))
    spec = importlib.util.spec_from_file_location("interfaces_build", copy / "build.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)

    (prefix / "include").mkdir(parents=True)
    (prefix / "include" / "Python.h").touch()
    monkeypatch.setattr(sysconfig, "get_path", lambda name: str(prefix / name))
    for name, value in {
        "PREFIX": prefix,
        "SITE": prefix / "site",
        "RECORD": prefix / "share" / "demandops" / "interfaces.json",
        "VERIFY": "",
    }.items():
        monkeypatch.setattr(module, name, value)
    for wheel in module.WHEELS:
        (prefix / "site" / f"{wheel}-1.0.dist-info").mkdir(parents=True)

    tools.mkdir()
    for tool in ("cmake", "ninja", "cc", "c++"):
        (tools / tool).write_text(FAKE_CMAKE.format(python=sys.executable, prefix=str(prefix)))
        (tools / tool).chmod(0o755)
    monkeypatch.setenv("PATH", str(tools))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    return module


def calls(script: ModuleType) -> list[str]:
    """What CMake was asked since the last look."""
    log: Path = script.PREFIX / "calls"
    lines = log.read_text().split() if log.exists() else []
    log.unlink(missing_ok=True)
    return lines


ALL = ["configure", "configure", "--build", "--build", "--install", "--install"]


def test_it_builds_once(script: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert script.main([]) == 0
    assert calls(script) == ALL
    stages = [line.rsplit(": ", 1)[0] for line in capsys.readouterr().out.splitlines()]
    assert sorted(stages[:2]) == [f"configure {package}" for package in script.PACKAGES]
    assert stages[2:] == [
        *(f"build {package}" for package in script.PACKAGES),
        *(f"install {package}" for package in script.PACKAGES),
        "verify",
    ]

    assert script.main([]) == 0
    assert calls(script) == []
    assert capsys.readouterr().out == f"interfaces: up to date in {script.PREFIX}\n"

    assert script.main(["--force"]) == 0
    assert calls(script) == ALL


@pytest.mark.parametrize(
    "change",
    [
        lambda script: (script.SOURCES / OURS / "msg" / "Topic.msg").write_text("string name\n"),
        lambda script: (script.SOURCES / "wheels.cmake").write_text(""),
        lambda script: (script.SITE / "ros_rclpy-1.0.dist-info").rename(
            script.SITE / "ros_rclpy-1.1.dist-info"
        ),
        lambda script: (script.PREFIX / "lib" / f"lib{OURS}__typesupport.so").unlink(),
        lambda script: script.RECORD.write_text("{"),
    ],
    ids=["source", "recipe", "wheel", "installed", "record"],
)
def test_it_builds_again_after_a_change(
    change: Callable[[ModuleType], object], script: ModuleType
) -> None:
    assert script.main([]) == 0
    calls(script)
    change(script)
    assert script.main([]) == 0
    assert calls(script) == ALL


def test_it_removes_what_an_earlier_build_installed(script: ModuleType) -> None:
    lib = script.PREFIX / "lib"
    old = [
        lib / f"lib{OURS}__old.so",
        script.SITE / OURS / "msg" / "_old.py",
        script.PREFIX / "share" / OURS / "msg" / "Old.msg",
        script.PREFIX / "share" / "ament_index" / "resource_index" / "packages" / OURS,
    ]
    others = [lib / "libother__old.so", script.SITE / "other" / "_old.py"]
    for path in (*old, *others):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    assert script.main([]) == 0
    assert [path.exists() for path in (*old, *others)] == [False] * 4 + [True] * 2


@pytest.mark.parametrize("stage", ["build", "install"])
def test_a_failed_stage_shows_its_log_and_is_not_taken_for_done(
    stage: str, script: ModuleType, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert script.main([]) == 0
    (script.SOURCES / OURS / "msg" / "Topic.msg").write_text("string name\n")
    fail = script.PREFIX / f"fail--{stage}"
    fail.touch()
    capsys.readouterr()

    assert script.main([]) == 3
    error = capsys.readouterr().err
    (log,) = tmp_path.glob(f"demandops-interfaces-*/{OURS}.log")
    assert error.endswith(
        f"    as --{stage}\n    no space left\nfailed: {stage} {OURS}\nthe full log: {log}\n"
    )

    fail.unlink()
    calls(script)
    assert script.main([]) == 0
    assert calls(script) == ALL


def test_an_interrupted_install_is_not_taken_for_done(
    script: ModuleType, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def interrupted(package: str) -> None:
        raise KeyboardInterrupt

    assert script.main([]) == 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(script, "_remove_installed", interrupted)
        assert script.main(["--force"]) == 130
    assert capsys.readouterr().err == "interrupted; run it again\n"
    assert list(tmp_path.glob("demandops-interfaces-*")) == []

    calls(script)
    assert script.main([]) == 0
    assert calls(script) == ALL


def test_a_given_build_folder_is_kept(script: ModuleType, tmp_path: Path) -> None:
    assert script.main(["--build-dir", str(tmp_path / "kept")]) == 0
    assert (tmp_path / "kept" / f"{OURS}.log").is_file()


def test_missing_wheels_are_named(script: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    for wheel in ("ros_rclpy", "ros_rmw_fastrtps_cpp", "ros_ament_cmake", "catkin_pkg"):
        (script.SITE / f"{wheel}-1.0.dist-info").rmdir()
    assert script.main([]) == 1
    assert capsys.readouterr().err == (
        f"Python packages are missing in {script.PREFIX}\n"
        f"install with: {sys.executable} -m pip install "
        "catkin-pkg ros-ament-cmake 'ros-rclpy[fastrtps]'\n"
    )


@pytest.mark.parametrize(
    ("absent", "named", "package"),
    [
        ("cmake", "cmake", "cmake"),
        ("cc", "a C compiler", "build-essential"),
        ("c++", "a C++ compiler", "build-essential"),
        ("ninja", "make or ninja", "build-essential"),
    ],
)
def test_each_missing_tool_is_named(
    absent: str, named: str, package: str, script: ModuleType
) -> None:
    tools = Path(os.environ["PATH"])
    (tools / absent).unlink()
    assert script.missing(os.environ) == [
        f"not found: {named}",
        f"install with: apt-get install {package}",
    ]


def test_a_compiler_of_ones_own_choice_is_looked_for(script: ModuleType) -> None:
    tools = os.environ["PATH"]
    assert script.missing({"PATH": tools, "CC": "cc -m64"}) == []
    assert script.missing({"PATH": tools, "CC": "icx -m64"}) == [
        "not found: a C compiler",
        "install with: apt-get install build-essential",
    ]


def test_missing_headers_are_named(script: ModuleType) -> None:
    header = script.PREFIX / "include" / "Python.h"
    header.unlink()
    assert script.missing(os.environ) == [
        f"not found: Python's headers ({header})",
        "install with: apt-get install python3-dev",
    ]


if __name__ == "__main__":
    round_trip()
