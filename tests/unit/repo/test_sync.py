"""The program forces its writes to disk; most tests switch that off (tests/kit/sync.py)."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from tests.kit.goals import perception

PROGRAM = """
import json, os, sys
from datetime import datetime, timezone
from pathlib import Path
import pygit2
from pygit2.enums import Option

calls = []

def recorded(owner, name):
    known = getattr(owner, name)
    def call(*args):
        calls.append([name, *map(int, args)])
        return known(*args)
    setattr(owner, name, call)

recorded(pygit2, "option")
from demandops.serve.generator import Generator
from demandops.repo import new_repo

bare = Path(sys.argv[1])
new_repo.init(bare, datetime.now(timezone.utc), bare=True, gitops="flux")
generator = Generator(str(bare))
recorded(os, "fdatasync")
before = []
goal = json.loads(sys.argv[2])
ticket = generator.submit(goal, "op", lambda stage, text: before.append((stage, calls[-1][0])))
ticket.future.result(240)
generator.close()
setting = pygit2.Repository(str(bare)).config["core.fsync"]
options = [call[2:] for call in calls if call[:2] == ["option", Option.ENABLE_FSYNC_GITDIR]]
print(json.dumps([options, setting, dict(before)["admitted"]]))
"""


def test_libgit2_git_and_the_journal_force_their_writes(tmp_path: Path) -> None:
    command = [sys.executable, "-c", PROGRAM, str(tmp_path / "state.git"), json.dumps(perception())]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    options, setting, last_call = json.loads(said)
    assert options == [[1]], "libgit2's forced writes must be switched on once, and never off"
    assert setting == "committed"
    assert last_call == "fdatasync", "the journal must be on the disk before a demand is admitted"
