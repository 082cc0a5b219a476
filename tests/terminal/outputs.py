"""What each command prints on a terminal of 80 columns, for one small fleet."""

from __future__ import annotations

import re
import shlex
from datetime import datetime, timedelta, timezone
from itertools import count
from pathlib import Path

import pytest
import yaml
from demandops.cli.main import run
from demandops.runtime import REAL

from tests.kit.goals import EXPERIMENT, put
from tests.kit.repo import GIT_ENVIRONMENT, GitRepo, init
from tests.kit.terminal import terminal

FOLDER = Path(__file__).parent / "expected"
NOW = datetime(2026, 11, 23, 8, 0, tzinfo=timezone.utc)
FUSION = "of-edge-object-detection-fusion-cf7e0180a8bb"

COMMANDS = (
    "bookkeeping",
    "decommission vehicle01 --dry-run",
    "diff main~1 main",
    "get claims",
    "get connections",
    "get demands",
    "get demands -o wide",
    "get leases",
    "get nodes",
    "get overrides",
    "get proposals",
    "get services",
    "journal",
    "log",
    "log -o wide -n 2",
    "override create calm --node edge --hold -m Demonstration --dry-run",
    "request visit.yaml --dry-run",
    "resume --requester vehicle03 --dry-run",
    "rollback main~5 -m why --dry-run --drop-newer",
    "schema",
    "status",
    "suspend --connection vehicle00/edge -m why --expires 2h --dry-run",
    "upgrade --dry-run",
    "verify main~2..main",
    "why edge",
    "why fusion",
    "why more",
    "why object-detection-fusion",
    "why patrol",
)
"""None of them changes the fleet."""

NOT_SHOWN = {
    "approve": "prints one line",
    "check": "its report has a test of its own, tests/integration/pull-request.md",
    "completion": "prints what click generates",
    "config": "prints paths of the machine",
    "demand": "needs a running node",
    "detect": "prints nothing but its log",
    "import": "prints what request prints",
    "init": "prints paths of the machine",
    "new": "prints the files that it lays down",
    "parameter-sync": "prints nothing but its log",
    "reject": "prints one line",
    "serve": "prints nothing but its log",
    "version": "depends on the machine",
    "watch": "shows the tables of get, log and status",
    "web": "prints an address",
}
"""The commands without a file here, and why."""

_HEX = re.compile(
    r"\b(?=[0-9a-f]*\d)[0-9a-f]{10}(?:[0-9a-f]{30})?\b|(?<=after commit )[0-9a-f]{12}"
)


def make_fleet(folder: Path, patch: pytest.MonkeyPatch) -> None:
    """Make a fleet with demands, a lease, overrides and contexts in ``folder``, at ``NOW``."""
    made, clock = count(), [NOW - timedelta(hours=3)]
    patch.setattr(REAL, "now", lambda: clock[0])
    patch.setattr(REAL, "fresh_id", lambda: f"00000000-0000-4000-8000-{next(made):012}")
    patch.chdir(folder)
    patch.setenv("XDG_CONFIG_HOME", str(folder / "config"))
    for name, value in GIT_ENVIRONMENT.items():
        patch.setenv(name, value)
    repo = GitRepo(init(folder / "fleet.git"))
    link = {"id": "patrol/link", "type": "mqtt", "source": "vehicle00", "target": "edge"}
    link |= {"topics": [{"source": "/patrol"}]}
    patrol = put("patrol", "vehicle00", applications=[], connections=[link], lease="4h")
    (folder / "patrol.yaml").write_text(yaml.safe_dump(patrol))
    visit = put("visit", "vehicle02", node="edge", connect="none")
    (folder / "visit.yaml").write_text(yaml.safe_dump(visit))
    run(["config", "set", "fleet", "--state-repo", "fleet.git"])
    for file in (*map(str, EXPERIMENT[:4]), "patrol.yaml"):
        clock[0] += timedelta(minutes=1)
        _done(f"request {file}")
    clock[0] += timedelta(hours=1)
    _done("suspend --requester vehicle03 -m 'In the workshop'")
    _done("override create more --service object-detection --replicas 2 -m Load --expires 2d")
    policy = repo.files()["policy/access-domains.yaml"]
    data = yaml.safe_load(policy)
    data["domains"][0]["approval"] = "required"
    repo.commit(
        {"policy/access-domains.yaml": yaml.safe_dump(data)},
        "Demands need approval\n",
        ("Petra Platform", "petra@example.org", int(NOW.timestamp()) - 3600),
    )
    _done("request visit.yaml")
    clock[0] = NOW


def _done(command: str) -> None:
    assert run(shlex.split(command)) == 0, command


def printed(command: str, patch: pytest.MonkeyPatch) -> str:
    """Return what a command prints, without colors and with equal commit ids."""
    patch.setenv("NO_COLOR", "1")
    with terminal(patch, columns=80) as screen:
        run(shlex.split(command))
    return same_ids(screen.text)


def same_ids(text: str) -> str:
    """Return a text with equal commit ids."""
    return _HEX.sub(lambda found: "c" * len(found[0]), text)


def file_of(command: str) -> Path:
    """Return the file with the expected output of a command."""
    return FOLDER / (re.sub(r"[^a-z0-9]+", "-", command.lower()).strip("-") + ".txt")
