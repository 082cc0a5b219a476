"""The script that builds the ROS 2 interfaces: when it builds, and what it reports."""

from __future__ import annotations

import importlib.util
import os
import shutil
import sys
import sysconfig
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from tests.kit import plain_yaml
from tests.kit.cli import process
from tests.kit.repo import program

INTERFACES = Path(__file__).resolve().parents[2] / "ros_bridge" / "interfaces"
BUILD = INTERFACES / "build.py"
TOOLS = plain_yaml.load(Path(__file__).with_name("tools.yaml").read_text())
OURS = "application_manager_interfaces"
FOLDERS = Path(__file__).resolve().parents[1] / "fixtures" / "messages"


def test_nothing_changed_is_seen_without_a_compiler() -> None:
    for environment in (os.environ, {"PATH": ""}):
        ran = process(sys.executable, BUILD, env=environment)
        assert ran == (0, f"interfaces: up to date in {sys.prefix}\n", "")


FAKE_CMAKE = Path(__file__).with_name("fake-cmake.sh").read_text()


@pytest.fixture
def script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """A copy of the script that installs into a folder of the test and calls a fake CMake."""
    copy, prefix, tools = (tmp_path / name for name in ("interfaces", "prefix", "bin"))
    shutil.copytree(INTERFACES, copy, ignore=shutil.ignore_patterns("__pycache__"))
    spec = importlib.util.spec_from_file_location("interfaces_build", copy / "build.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)  # its dataclass looks there
    spec.loader.exec_module(module)

    (prefix / "include").mkdir(parents=True)
    (prefix / "include" / "Python.h").touch()
    for shared in ("geometry_msgs/msg", "std_msgs/msg", "ament_index/resource_index"):
        (prefix / "share" / shared).mkdir(parents=True)
    monkeypatch.setattr(sysconfig, "get_path", lambda name: str(prefix / name))
    record = prefix / "share" / "demandops" / "interfaces.json"
    kept = record.with_name("messages")
    names = {"PREFIX": prefix, "SITE": prefix / "site", "RECORD": record, "KEPT": kept}
    names["VERIFY"] = ""
    for name, value in names.items():
        monkeypatch.setattr(module, name, value)
    for wheel in module.WHEELS:
        (prefix / "site" / f"{wheel}-1.0.dist-info").mkdir(parents=True)

    for tool in ("cmake", "ninja", "cc", "c++"):
        program(tools / tool, FAKE_CMAKE.replace("PREFIX", str(prefix)))
    monkeypatch.setenv("PATH", str(tools))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    return module


def calls(script: ModuleType) -> list[str]:
    """Return the stages of CMake that the script has run, and clear the log of these stages."""
    log: Path = script.PREFIX / "calls"
    lines = log.read_text().split() if log.exists() else []
    log.unlink(missing_ok=True)
    return lines


MADE = ["--build", "--install"]
ALL = ["configure", "configure", *MADE, *MADE, "configure", *MADE]


def test_it_builds_once(script: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert script.main() == 0
    assert calls(script) == ALL
    stages = [line.rsplit(": ", 1)[0] for line in capsys.readouterr().out.splitlines()]
    made = ["build", "install", "verify"]
    assert [stage.split()[0] for stage in stages] == [
        *("configure", "configure", *made, *made),
        *("configure", *made),
    ]
    assert {" ".join(stage.split()[1:]) for stage in stages} == {*script.PACKAGES, "tf2_msgs"}

    assert script.main() == 0
    assert calls(script) == []
    assert capsys.readouterr().out == f"interfaces: up to date in {script.PREFIX}\n"


def test_it_builds_again_after_a_change(script: ModuleType) -> None:
    wheels = [script.SITE / f"ros_rclpy-1.{number}.dist-info" for number in (0, 1)]
    one = ["configure", *MADE]
    changes: list[tuple[Callable[[], object], list[str]]] = [
        (lambda: None, ALL),
        (lambda: (script.SOURCES / OURS / "msg" / "Topic.msg").write_text("string name\n"), one),
        (lambda: wheels[0].rename(wheels[1]), ALL),
        (lambda: (script.SOURCES / "wheels.cmake").write_text(""), ALL),
        ((script.PREFIX / "lib" / f"lib{OURS}__typesupport.so").unlink, one),
        (lambda: script.RECORD.write_text("{"), ALL),
        (lambda: script.RECORD.write_text('{"digest": "", "files": []}'), ALL),
    ]
    for change, made in changes:
        change()
        assert script.main() == 0
        assert calls(script) == made


def test_folders_of_messages_are_built_after_what_they_need_and_kept(
    script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert script.main() == 0
    calls(script)
    given = shutil.copytree(FOLDERS, tmp_path / "given")
    assert script.main(str(given)) == 0
    assert calls(script) == ["configure", *MADE] * 2
    built = [line.split()[1] for line in capsys.readouterr().out.splitlines()[-8:]]
    assert built == ["fleet_msgs:"] * 4 + ["hazard_msgs:"] * 4
    (given / "fleet_msgs" / "msg" / "Motion.msg").write_text("float64[] state\n")
    (given / "src").mkdir()
    for name, to in {"fleet_msgs": given / "fleet_msgs", "again": given}.items():
        (given / "src" / name).symlink_to(to)
    for folders, made in (((), 0), (("fleet_msgs", "fleet_msgs", "src"), 2), ((), 0)):
        assert script.main(*(str(given / name) for name in folders)) == 0
        assert calls(script) == ["configure", *MADE] * made
    (given / "fleet_msgs" / "msg" / "Lost.msg").symlink_to("nowhere")
    assert script.main(str(given)) == 1
    # without what it needs, a kept package fails no build
    (script.KEPT / "fleet_msgs" / "msg" / "Report.msg").unlink()
    (script.SITE / "ros_rclpy-1.0.dist-info").rename(script.SITE / "ros_rclpy-2.dist-info")
    assert script.main() == 0
    assert "hazard_msgs: needs fleet_msgs/Report, which" in capsys.readouterr().err
    assert calls(script) == [*ALL, "configure", *MADE]


@pytest.mark.parametrize(("files", "told"), TOOLS["refused"].values(), ids=TOOLS["refused"])
def test_a_folder_that_cannot_be_built_is_refused_before_anything_is_built(
    files: dict[str, str],
    told: str,
    script: ModuleType,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    given = tmp_path / "given"
    given.mkdir()
    for name, text in files.items():
        path = given / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    assert script.main(str(given)) == 1
    assert told in capsys.readouterr().err
    assert calls(script) == []


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
    assert script.main() == 0
    assert [path.exists() for path in (*old, *others)] == [False] * 4 + [True] * 2


@pytest.mark.parametrize("stage", ["build", "install"])
def test_a_failed_stage_shows_its_log_and_is_not_taken_for_done(
    stage: str, script: ModuleType, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert script.main() == 0
    script.RECORD.unlink()
    fail = script.PREFIX / f"fail--{stage}"
    fail.touch()
    assert script.main() == 3
    error = capsys.readouterr().err
    log = script.RECORD.with_suffix(".log")
    assert log.read_text().endswith("no space left\n")
    assert list(tmp_path.glob("demandops-interfaces-*")) == []
    assert error.endswith(
        f"    as --{stage}\n    no space left\nfailed: {stage} {OURS}\nthe full log: {log}\n"
    )
    fail.unlink()
    calls(script)
    assert script.main() == 0
    assert calls(script) == ALL


def test_an_interrupted_install_is_not_taken_for_done(
    script: ModuleType, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def interrupted(package: str) -> None:
        raise KeyboardInterrupt

    assert script.main() == 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(script, "_remove_installed", interrupted)
        script.RECORD.unlink()
        assert script.main() == 130
    assert capsys.readouterr().err == "interrupted; run it again\n"
    assert list(tmp_path.glob("demandops-interfaces-*")) == []
    calls(script)
    assert script.main() == 0
    assert calls(script) == ALL


def test_missing_wheels_are_named(script: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    for wheel in ("ros_rclpy", "ros_rmw_fastrtps_cpp", "ros_ament_cmake", "catkin_pkg"):
        (script.SITE / f"{wheel}-1.0.dist-info").rmdir()
    assert script.main() == 1
    told = capsys.readouterr().err
    assert told.endswith(" -m pip install catkin-pkg ros-ament-cmake 'ros-rclpy[fastrtps]'\n")


@pytest.mark.parametrize(("absent", "compiler", "named", "package"), TOOLS["missing"])
def test_each_missing_tool_is_named(
    absent: str, compiler: str, named: str, package: str, script: ModuleType, tmp_path: Path
) -> None:
    environment = {"PATH": os.environ["PATH"], "CC": "cc -m64"}
    assert script.missing(environment) == []
    if absent:
        (tmp_path / absent).unlink()
    environment["CC"] = compiler
    told, remedy = script.missing(environment)
    assert told.startswith(f"not found: {named}")
    assert remedy == f"install with: apt-get install {package}"
