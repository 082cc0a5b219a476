"""``make golden``: write the expected output of each command. Review the diff before a commit."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

import pytest

from tests.terminal.outputs import (
    CHANGING,
    COMMANDS,
    FOLDER,
    HELP,
    file_of,
    helps,
    make_fleet,
    printed,
)


def main() -> None:
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir()
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("DEMANDOPS_DATA_HOME", str(Path(folder) / "home"))
        make_fleet(Path(folder), patch)
        HELP.write_text(helps())
        for command in (*COMMANDS, *CHANGING):
            file_of(command).write_text(printed(command, patch))
        os.chdir(FOLDER)
    print(f"terminal: {len(COMMANDS) + len(CHANGING) + 1} files")


if __name__ == "__main__":
    main()
