"""A clone with a work tree, for tests that act as a person or as the generator."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from tests.kit.repo import git


class Clone:
    def __init__(self, url: str, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True)
        self.git("init", "--quiet", "--initial-branch=main")
        self.git("remote", "add", "origin", url)

    def push(self, files: Mapping[str, str | None], message: str = "change") -> str:
        """Write files (None removes one), commit, push, and return the commit."""
        for name, text in files.items():
            path = self.folder / name
            if text is None:
                path.unlink(missing_ok=True)
            else:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text)
        self.git("add", "--all")
        self.git("commit", "--quiet", "--allow-empty", f"--message={message}")
        self.git("push", "--quiet", "origin", "HEAD:main")
        return self.git("rev-parse", "HEAD")

    def git(self, *arguments: str) -> str:
        return git(self.folder, *arguments)
