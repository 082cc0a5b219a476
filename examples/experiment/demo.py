"""The paper's experiment, played: eight demands over ROS 2 become eight commits.

Starts the node and a client as processes of their own, sends the eight requests of this folder,
and after each shows the demand, the bookkeeping beside the paper's, and the files that changed.
Exits with 0 only if all eight steps match.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import paper
from rich.console import Console
from rich.table import Table

HERE = Path(__file__).resolve().parent
BUILD = HERE.parent.parent / "build" / "demo"
STATE_REPO = BUILD / "state-repo.git"
ACTION = "/event_detector_operator_plugin/operator_plugin/deployment_request"
SIGNS = {"A": "[green]+[/]", "M": "[yellow]~[/]", "D": "[red]-[/]"}

out = Console(highlight=False, width=None if sys.stdout.isatty() else 120)


def demandops(*args: str) -> str:
    """Run the command line and return what it prints."""
    command = [sys.executable, "-m", "demandops.cli.main", *args]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def git(*args: str) -> str:
    """Run git in the state repo: all that the demo shows can be had without this program."""
    command = ["git", "-C", str(STATE_REPO), *args]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


class Client:
    """The client process: a request file in, feedback and result out."""

    def __init__(self) -> None:
        command = [sys.executable, str(HERE / "client.py"), ACTION]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self._read()

    def _read(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit("the client ended; the node's log says more")
        answer: dict[str, Any] = json.loads(line)
        if answer.get("status") == "no server":
            raise SystemExit(answer["message"])
        return answer

    def send(self, file: Path) -> tuple[list[str], dict[str, Any]]:
        """Send one request; return the feedback and the result."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{file}\n")
        self._process.stdin.flush()
        stages = []
        while True:
            answer = self._read()
            if "feedback" not in answer:
                return stages, answer
            stages.append(answer["feedback"].split()[0])

    def close(self) -> None:
        """End the client."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(10)


def play(client: Client, step: int, file: Path) -> bool:
    """Send one request and show what came of it; tell whether it is what the paper says."""
    out.rule(f"[bold]step {step}: {paper.STEPS[step - 1]}")
    stages, result = client.send(file)
    out.print(f"[dim]request[/]  {file.relative_to(HERE.parent.parent)}")
    out.print(f"[dim]stages[/]   {' → '.join(stages)}")
    out.print(f"[dim]result[/]   {result['status']}: {result['message']}")
    if result["status"] != "succeeded":
        return False
    commit = result["message"].split()[1]
    books = json.loads(
        demandops("bookkeeping", "--state-repo", str(STATE_REPO), "--output", "json")
    )
    wanted, found = paper.expected(step), paper.observed(books)
    table = Table("Service or connection", "Requesters (paper)", "Requesters (ours)", "")
    for subject in sorted({*wanted, *found}):
        left, right = wanted.get(subject, []), found.get(subject, [])
        mark = "[green]same[/]" if left == right else "[red bold]DIFFERS[/]"
        table.add_row(subject, ", ".join(left), ", ".join(right), mark)
    if not wanted and not found:
        table.add_row("(nothing runs)", "", "", "[green]same[/]")
    out.print(table)
    for line in git("show", "--name-status", "--format=", commit).splitlines():
        sign, path = line.split("\t")
        out.print(f"  {SIGNS[sign]} {path}")
    return wanted == found and books["commit"] == commit


def main() -> int:
    """Play all steps."""
    shutil.rmtree(BUILD, ignore_errors=True)
    BUILD.mkdir(parents=True)
    # a ROS graph of its own, and no trace in the user's home
    os.environ.setdefault("ROS_DOMAIN_ID", str(random.randint(1, 100)))
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["DEMANDOPS_DATA_HOME"] = str(BUILD / "data")
    os.environ["ROS_LOG_DIR"] = str(BUILD / "ros-log")
    out.print(demandops("init", str(STATE_REPO), "--bare").splitlines()[0])
    log = BUILD / "node.log"
    command = [sys.executable, "-m", "demandops.cli.main", "serve", "--state-repo", str(STATE_REPO)]
    with log.open("w") as sink:
        node = subprocess.Popen(command, stdout=sink, stderr=subprocess.STDOUT)
        try:
            client = Client()
            files = sorted(HERE.glob("[1-8]-*.yaml"))
            matches = [play(client, step, file) for step, file in enumerate(files, 1)]
            client.close()
        finally:
            node.terminate()
            stopped = node.wait(30)
    out.rule("[bold]git log of the state repo")
    out.print(git("log", "--format=%h %<(24,trunc)%an %s"), markup=False)
    good = sum(matches)
    out.print(
        f"{good} of {len(files)} steps match the paper",
        style="bold green" if good == 8 else "bold red",
    )
    out.print(f"look further: git -C {os.path.relpath(STATE_REPO)} show HEAD~3")
    if stopped != 0:
        out.print(f"the node ended with {stopped}; see {os.path.relpath(log)}")
    return 0 if good == len(files) == 8 and stopped == 0 else 1


if __name__ == "__main__":
    sys.exit(main())
