"""The paper's experiment: eight demands over ROS 2 become eight commits.

The script starts the node and a client as processes and sends the eight requests of this folder.
After each request it shows the request, the paper's bookkeeping and ours, and the changed files.
It exits with 0 only if all eight steps match.
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
    """Run git in the state repo and return what it prints."""
    command = ["git", "-C", str(STATE_REPO), *args]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


class Client:
    """The process of ``client.py``."""

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
            raise SystemExit("the client ended; see the node's log")
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


def run_step(client: Client, step: int, file: Path) -> bool:
    """Send a request and show its effect; return whether the bookkeeping equals the paper's."""
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
    expected, observed = paper.expected(step), paper.observed(books)
    table = Table("Service or connection", "Requesters (paper)", "Requesters (ours)", "")
    for subject in sorted({*expected, *observed}):
        left, right = expected.get(subject, []), observed.get(subject, [])
        mark = "[green]same[/]" if left == right else "[red bold]DIFFERS[/]"
        table.add_row(subject, ", ".join(left), ", ".join(right), mark)
    if not expected and not observed:
        table.add_row("(nothing runs)", "", "", "[green]same[/]")
    out.print(table)
    for line in git("show", "--name-status", "--format=", commit).splitlines():
        sign, path = line.split("\t")
        out.print(f"  {SIGNS[sign]} {path}")
    return expected == observed and books["commit"] == commit


def main() -> int:
    """Run all steps and return the exit code."""
    shutil.rmtree(BUILD, ignore_errors=True)
    BUILD.mkdir(parents=True)
    # a separate ROS graph, and no files in the user's home
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
            matches = [run_step(client, step, file) for step, file in enumerate(files, 1)]
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
    out.print(f"to see more: git -C {os.path.relpath(STATE_REPO)} show HEAD~3")
    if stopped != 0:
        out.print(f"the node ended with {stopped}; see {os.path.relpath(log)}")
    return 0 if good == len(files) == 8 and stopped == 0 else 1


if __name__ == "__main__":
    sys.exit(main())
