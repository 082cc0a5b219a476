"""Who takes part where demands need approval: the platform engineer, and a requester who waits."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import staterepo_rig as rig
import yaml
from demandops.service import Generator, Ticket
from staterepo_rig import git

POLICY = "policy/access-domains.yaml"


class Petra:
    """The platform engineer, with a clone of her own."""

    def __init__(self, bare: Path, folder: Path) -> None:
        self.bare, self.folder = bare, folder
        self._person = rig.Person(bare, folder)

    def policy(self, **changed: Any) -> None:
        """Change every access domain."""
        self.fetch()
        data = yaml.safe_load(git(self.folder, "show", f"origin/main:{POLICY}"))
        for domain in data["domains"]:
            domain.update(changed)
        self._person.change({POLICY: yaml.safe_dump(data)}, "Demands need approval")

    def change(self, files: dict[str, str | None], text: str = "By hand") -> str:
        return self._person.change(files, text)

    def fetch(self) -> None:
        git(self.folder, "fetch", "--quiet", "--prune", "origin")
        git(self.folder, "reset", "--quiet", "--hard", "origin/main")

    def merge(self, branch: str, *options: str) -> None:
        self.fetch()
        git(self.folder, "merge", "--quiet", *options, f"origin/{branch}")
        git(self.folder, "push", "--quiet", "origin", "HEAD:main")

    def squash(self, branch: str, message: str) -> None:
        self.fetch()
        git(self.folder, "merge", "--quiet", "--squash", f"origin/{branch}")
        git(self.folder, "commit", "--quiet", "--message", message)
        git(self.folder, "push", "--quiet", "origin", "HEAD:main")

    def rebase(self, branch: str, *options: str) -> None:
        self.fetch()
        git(self.folder, "checkout", "--quiet", "-B", "work", f"origin/{branch}")
        git(self.folder, "rebase", "--quiet", *options, "origin/main")
        git(self.folder, "push", "--quiet", "origin", "HEAD:main")
        git(self.folder, "checkout", "--quiet", "-")

    def delete(self, branch: str) -> None:
        git(self.folder, "push", "--quiet", "origin", f":{branch}")


def branches(bare: Path) -> list[str]:
    refs = git(bare, "for-each-ref", "--format=%(refname:short)", "refs/heads/demand")
    return refs.splitlines()


class Proposed:
    """A demand handed in, and the branch that it waits on."""

    def __init__(self, generator: Generator, made: Any, operation: str | None = None) -> None:
        self.told: list[tuple[str, str]] = []
        self._seen = threading.Event()
        self.ticket: Ticket = generator.submit(made, operation, self._listen)

    def _listen(self, stage: str, text: str) -> None:
        self.told.append((stage, text))
        if stage == "proposed":
            self._seen.set()

    @property
    def branch(self) -> str:
        if not self._seen.wait(rig.PATIENCE_S):
            raise AssertionError(f"never proposed: {self.told} {self.ticket.future}")
        text = [text for stage, text in self.told if stage == "proposed"][-1]
        assert text.startswith("awaiting approval: demand/")
        return text.split()[2]

    def outcome(self) -> str:
        return rig.receipt(self.ticket).outcome
