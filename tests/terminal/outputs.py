"""The output of each command on a terminal of 80 columns, for one small fleet."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Iterator
from datetime import datetime, timedelta, timezone
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

import click
import pytest
import yaml
from demandops.base.runtime import REAL
from demandops.cli.main import COMMANDS as COMMAND_NAMES
from demandops.cli.main import cli, load, run
from demandops.repo.git import child_processes

from tests.kit import plain_yaml
from tests.kit.cli import terminal
from tests.kit.goals import EXPERIMENT, put
from tests.kit.repo import GIT_ENVIRONMENT, POLICY, GitRepo, git, init

FOLDER = Path(__file__).parent / "expected"
HELP = FOLDER / "help.txt"
NOW = datetime(2026, 11, 23, 8, 0, tzinfo=timezone.utc)

_LISTED = plain_yaml.load(Path(__file__).with_name("commands.yaml").read_text())
COMMANDS, CHANGING = tuple(_LISTED["unchanged"]), tuple(_LISTED["changing"])
NOT_SHOWN = _LISTED["not shown"]

_HEX = re.compile(
    r"\b(?=[0-9a-f]*\d)[0-9a-f]{10}(?:[0-9a-f]{30})?\b|(?<!\S)(?=[0-9a-f]*\d)[0-9a-f]{12}\b"
)
_CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


def make_fleet(folder: Path, patch: pytest.MonkeyPatch) -> None:
    """Make a fleet with demands, a lease, overrides and contexts in ``folder``.

    Afterwards the process's working directory is ``folder``, and the program's clock stands still
    at ``NOW``.
    """
    made, clock = count(), [NOW - timedelta(hours=3)]
    patch.setattr(REAL, "now", lambda: clock[0])
    child_processes.mark()  # the first takes an id, whichever test runs it
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
    with patch.context() as own:
        own.setenv("XDG_CONFIG_HOME", str(folder / "contexts"))
        for name in ("fleet", "spare"):
            run(["config", "set", name, "--state-repo", f"https://git.example/its/{name}.git"])
    run(["config", "set", "fleet", "--state-repo", "fleet.git"])
    for file in (*map(str, EXPERIMENT[:4]), "patrol.yaml"):
        clock[0] += timedelta(minutes=1)
        _done(f"request {file}")
    clock[0] += timedelta(hours=1)
    _done("suspend -y --requester vehicle03 -m 'In the workshop'")
    _done("override create -y more --service object-detection --replicas 2 -m Load --expires 2d")
    policy = yaml.safe_load(repo.files()[POLICY])
    policy["domains"][0]["approval"] = "required"
    petra = ("Petra Platform", "petra@example.org", int(NOW.timestamp()) - 3600)
    repo.commit({POLICY: yaml.safe_dump(policy)}, "Demands need approval\n", petra)
    _done("request visit.yaml")
    clock[0] = NOW
    git(folder, "clone", "-q", "fleet.git", "clone")
    more = folder / "clone" / "overrides" / "more.yaml"
    more.write_text(more.read_text().replace("replicas: 2", "replicas: 3"))


def _done(command: str) -> None:
    assert run(shlex.split(command)) == 0, command


def printed(command: str, patch: pytest.MonkeyPatch) -> str:
    """Return the output of a command without colours, and with ``c…`` in place of commit ids."""
    with patch.context() as own, TemporaryDirectory() as folder:
        own.setenv("NO_COLOR", "1")
        if command in CHANGING:
            own.chdir(shutil.copytree(Path.cwd(), Path(folder, "fleet")))
            own.setenv("DEMANDOPS_DATA_HOME", str(Path.cwd() / "home"))
            own.setenv("HELM_BIN", "no-helm")
        if command.startswith("config "):  # these contexts name URLs, no local paths
            own.setenv("XDG_CONFIG_HOME", str(Path.cwd() / "contexts"))
        if command.startswith("watch"):
            own.setattr(REAL, "sleep", _interrupt)
        with terminal(own, lines=40 if command.startswith("watch") else 1000) as screen:
            proposed = git(
                "fleet.git", "for-each-ref", "--format=%(objectname)", "refs/heads/demand"
            )
            run(shlex.split(command.replace("PROPOSED", proposed)))
        text = "\n".join(map(str.rstrip, _CONTROL.sub("", screen.text).split("\n")))
        text = text.replace(str(Path.cwd()), "/home/petra")
    if command == "version":
        text = re.sub(r"\d[\w.+-]*", "1.2.3", text)
    return _HEX.sub(lambda found: "c" * len(found[0]), text)


def _interrupt(seconds: float) -> None:
    raise KeyboardInterrupt


def helps() -> str:
    """Return the help texts of all commands at 80 columns, joined to one text."""
    root = click.Context(cli, info_name="demandops", terminal_width=80, **cli.context_settings)
    return "\n".join(
        text for name in sorted(COMMAND_NAMES) for text in _help(load(name), name, root)
    )


def _help(command: click.Command, name: str, parent: click.Context) -> Iterator[str]:
    context = click.Context(command, info_name=name, parent=parent)
    yield f"$ {context.command_path} --help\n{command.get_help(context)}\n"
    if isinstance(command, click.Group):
        for each in sorted(command.commands):
            yield from _help(command.commands[each], each, context)


def file_of(command: str) -> Path:
    """Return the path of the file with the expected output of a command."""
    words = command.split(" -C ", maxsplit=1)[0].replace(" --state-repo fleet.git", "")
    return FOLDER / (re.sub(r"[^a-z0-9]+", "-", words.lower()).strip("-") + ".txt")
