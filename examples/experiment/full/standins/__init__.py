"""Stand-ins for the programs in the pods, and the folder that takes the place of every image.

They take the commands, parameters and topics of the real programs.
"""

from __future__ import annotations

import sys
from pathlib import Path

_PROGRAMS = {"ros2": __name__, "zenoh-bridge-ros2dds": f"{__name__}.zenoh_bridge"}


def image(folder: Path) -> Path:
    """Fill the containers' working directory with the stand-in programs; return the directory."""
    setup = folder / "install" / "setup.bash"
    setup.parent.mkdir(exist_ok=True)
    setup.write_text(f'PATH="{folder}:$PATH"\n')
    for name, module in _PROGRAMS.items():
        program = folder / name
        program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m {module} "$@"\n')
        program.chmod(0o755)
    return folder
