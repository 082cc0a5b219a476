"""``make golden``: write the expected output of each command. Review the diff before a commit."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

import pytest

from tests.terminal import outputs

if __name__ == "__main__":
    shutil.rmtree(outputs.FOLDER, ignore_errors=True)
    outputs.FOLDER.mkdir()
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("DEMANDOPS_DATA_HOME", str(Path(folder) / "home"))
        outputs.make_fleet(Path(folder), patch)
        outputs.HELP.write_text(outputs.helps())
        for command in (*outputs.COMMANDS, *outputs.CHANGING):
            outputs.file_of(command).write_text(outputs.printed(command, patch))
        os.chdir(outputs.FOLDER)
