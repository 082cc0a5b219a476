"""`deploy/fresh-root` takes its packages from where this machine takes them.

The programs that it calls are stand-ins, because the real ones need root, a network and minutes.
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "deploy" / "fresh-root"
STAND_INS = {
    "debootstrap": 'echo "$@" >"$CALLED"; mkdir -p "$3/etc/apt"',
    "chroot": "",
    "mount": "",
    "umount": "",
    "apt-get": """
test "$1" = indextargets
[ -e "$SOURCES" ] && cat "$SOURCES" || exit 0""",
}


@pytest.fixture
def called(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "bin"
    folder.mkdir()
    for name, text in STAND_INS.items():
        (folder / name).write_text(f"#!/bin/sh\n{text}\n")
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")
    monkeypatch.setenv("SOURCES", str(tmp_path / "sources"))
    monkeypatch.setenv("CALLED", str(tmp_path / "called"))
    return tmp_path / "called"


def run(root: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["sh", str(SCRIPT), str(root)], capture_output=True, text=True, check=False
    )


def release() -> str:
    lines = Path("/etc/os-release").read_text().splitlines()
    return dict(line.split("=", 1) for line in lines if "=" in line)["VERSION_CODENAME"]


def test_it_has_the_release_and_the_sources_of_the_machine(called: Path, tmp_path: Path) -> None:
    mirror, name = "http://mirror.invalid", release()
    (tmp_path / "sources").write_text(
        f"{name}-security {mirror}/security main\n"
        f"{name} {mirror}/packages main\n"
        f"{name} {mirror}/packages contrib\n"
        f"other {mirror}/other main\n"
    )
    root = tmp_path / "root"
    done = run(root)
    assert done.returncode == 0, done.stderr
    assert called.read_text() == f"--variant=minbase {name} {root} {mirror}/packages\n"
    assert (root / "etc/apt/sources.list").read_text().splitlines() == [
        f"deb {mirror}/packages {name} contrib",
        f"deb {mirror}/packages {name} main",
        f"deb {mirror}/security {name}-security main",
    ]


def test_a_machine_without_sources_is_told(called: Path, tmp_path: Path) -> None:
    done = run(tmp_path / "root")
    assert (done.returncode, called.exists()) == (1, False)
    assert f"apt has no source of {release()}" in done.stderr
