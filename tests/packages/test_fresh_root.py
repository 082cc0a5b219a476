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


LINES = Path("/etc/os-release").read_text().splitlines()
RELEASE = dict(line.split("=", 1) for line in LINES if "=" in line)["VERSION_CODENAME"]
MIRROR = "http://mirror.invalid"


@pytest.mark.parametrize("has_sources", [True, False])
def test_it_has_the_release_and_the_sources_of_the_machine(
    tmp_path: Path, has_sources: bool
) -> None:
    root, called, sources = (tmp_path / name for name in ("root", "called", "sources"))
    if has_sources:
        sources.write_text(
            f"{RELEASE}-security {MIRROR}/security main\n"
            f"{RELEASE} {MIRROR}/packages main\n"
            f"{RELEASE} {MIRROR}/packages contrib\n"
            f"other {MIRROR}/other main\n"
        )
    for name, text in STAND_INS.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)
    environment = {"PATH": f"{tmp_path}:{os.environ['PATH']}"}
    environment |= {"SOURCES": str(sources), "CALLED": str(called)}
    command = ["sh", str(SCRIPT), str(root)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if not has_sources:
        assert (done.returncode, called.exists()) == (1, False)
        assert f"apt has no source of {RELEASE}" in done.stderr
        return
    assert done.returncode == 0, done.stderr
    assert called.read_text() == f"--variant=minbase {RELEASE} {root} {MIRROR}/packages\n"
    assert (root / "etc/apt/sources.list").read_text().splitlines() == [
        f"deb {MIRROR}/packages {RELEASE} contrib",
        f"deb {MIRROR}/packages {RELEASE} main",
        f"deb {MIRROR}/security {RELEASE}-security main",
    ]
