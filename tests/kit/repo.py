"""State repos in Git for tests: a bare repository, a person with a clone, and the history.

Commits and files are read with git and pygit2, not with the generator's own code, so that tests do
not depend on that code. Only :func:`state_of`, :func:`books` and :func:`differing` read with it,
and :func:`write_tree` writes with it.
"""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import pygit2
import yaml
from demandops.decide.bookkeeping import as_data, bookkeeping
from demandops.decide.state import State
from demandops.repo import new_repo, reader
from demandops.repo.git import tree as _tree  # noqa: F401 - its import switches libgit2's fsync on
from demandops.repo.git.objects import NewObjects
from demandops.repo.history.commit_message import GENERATOR_EMAIL, GENERATOR_NAME
from demandops.repo.load import snapshot as snapshots

from tests.kit import plain_yaml
from tests.kit.memory import NOW

NO_GIT_CONFIG = {
    "GIT_CONFIG_GLOBAL": os.devnull,
    "GIT_CONFIG_NOSYSTEM": "1",
    "GIT_TEMPLATE_DIR": "",  # no sample hooks
    "GIT_TERMINAL_PROMPT": "0",
    "LC_ALL": "C.UTF-8",
}
TEST_GIT_CONFIG = NO_GIT_CONFIG | {"GIT_CONFIG_GLOBAL": str(Path(__file__).with_name("gitconfig"))}
GIT_ENVIRONMENT = TEST_GIT_CONFIG | {
    "GIT_AUTHOR_NAME": "Petra Platform",
    "GIT_AUTHOR_EMAIL": "petra@example.org",
    "GIT_COMMITTER_NAME": "Petra Platform",
    "GIT_COMMITTER_EMAIL": "petra@example.org",
}

POLICY = "policy/access-domains.yaml"

FORGER = (GENERATOR_NAME, GENERATOR_EMAIL, 1_770_000_000)
"""A person with the generator's name; only the missing signature shows who made the commit."""


def init(path: Path, *, bare: bool = True) -> Path:
    new_repo.init(path, NOW, bare=bare, gitops="flux")
    return path


def git(folder: Path | str | GitRepo, *args: str, check: bool = True, **environment: str) -> str:
    done = subprocess.run(
        ["git", "-C", os.fspath(folder).removeprefix("file://"), *args],
        capture_output=True,
        text=True,
        errors="replace",
        check=False,
        env={**os.environ, **GIT_ENVIRONMENT, **environment},
    )
    assert not check or done.returncode == 0, f"git {' '.join(args)}: {done.stdout}{done.stderr}"
    return done.stdout.removesuffix("\n")


def write_tree(
    repo: pygit2.Repository, base: pygit2.Tree | None, files: Mapping[str, str | None]
) -> pygit2.Oid:
    objects = NewObjects(repo)
    tree = objects.add_tree(base, files)
    with objects.packed(tree):
        return tree


def _index(path: Path, revision: str) -> tuple[pygit2.Repository, pygit2.Index]:
    repo, index = pygit2.Repository(str(path)), pygit2.Index()
    index.read_tree(repo.revparse_single(revision).peel(pygit2.Tree))
    return repo, index


class GitRepo:
    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def tip(self) -> str:
        return tip(self.path)

    def __fspath__(self) -> str:
        return str(self.path)

    def commits(self) -> list[str]:
        repo = pygit2.Repository(str(self.path))
        return [commit.message for commit in repo.walk(self.tip)]

    def files(self, under: str = "", revision: str = "main") -> dict[str, str]:
        """Return the texts, by path, of a revision's files whose paths start with ``under``."""
        repo, index = _index(self.path, revision)
        return {e.path: repo[e.id].data.decode() for e in index if e.path.startswith(under)}

    def ledger(self) -> dict[str, Any]:
        files = self.files("ledger/").items()
        return {path: plain_yaml.load(text) for path, text in files if path.endswith(".yaml")}

    def manifests(self) -> dict[str, str]:
        return {p: text for p, text in self.files("clusters/").items() if p.endswith(".yaml")}

    def commit(
        self,
        changed: Mapping[str, str | None],
        text: str = "By hand\n",
        who: tuple[str, str, int] = ("A person", "person@example.org", 1_770_000_000),
    ) -> str:
        """Commit in the bare repository, as a forge's web page does; return the commit's id."""
        parent = self.tip
        repo, index = _index(self.path, parent)
        for path, new in changed.items():
            if new is None:
                index.remove(path)
            else:
                blob = repo.create_blob(new.encode())
                index.add(pygit2.IndexEntry(path, blob, pygit2.enums.FileMode.BLOB))
        by = pygit2.Signature(*who, 0)
        tree = index.write_tree(repo)
        return str(repo.create_commit("refs/heads/main", by, by, text, tree, [parent]))


class Person:
    """A person who changes the state repo: at its forge, or by a push from a clone."""

    def __init__(self, remote: Path | str, folder: Path) -> None:
        """Only :meth:`fetch`, :meth:`push` and :meth:`write` take a ``remote`` with a URL."""
        self.bare, self.folder = remote, folder

    def _git(self, *args: str) -> str:
        return git(self.folder, *args)

    def fetch(self) -> None:
        """Fetch, and reset the clone's checked-out branch to main; clone if there is no clone."""
        if not self.folder.exists():
            # not by hard links, which fail if a server writes meanwhile
            ends = ("--no-local", str(self.bare), str(self.folder))
            git(self.folder.parent, "clone", "--quiet", *ends)
            return
        self._git("fetch", "--quiet", "--prune", "origin")
        self._git("reset", "--quiet", "--hard", "origin/main")

    def write(self, files: Mapping[str, str | None]) -> None:
        """Write or remove files in the clone on top of main, without a commit."""
        self.fetch()
        for path, text in files.items():
            target = self.folder / path
            if text is None:
                target.unlink()
            else:
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_text(text)

    def read(self, path: str) -> str:
        return GitRepo(Path(self.bare)).files()[path]

    def change(
        self,
        files: Mapping[str, str | None],
        message: str = "A person's change",
        who: tuple[str, str, int] | None = None,
    ) -> str:
        """Commit ``files`` on top of main (``None`` removes a file); return the commit's id."""
        who = who or ("Petra Platform", "petra@example.org", int(time.time()))
        for _ in range(100):
            with suppress(pygit2.GitError):  # a generator published first: try again
                return GitRepo(Path(self.bare)).commit(files, f"{message}\n", who)
        raise AssertionError("each of 100 attempts met a commit that was published first")

    def push(self, files: Mapping[str, str | None], message: str = "A person's change") -> str:
        """Commit and push from the clone; this fails if somebody else pushes meanwhile."""
        self.write(files)
        self._git("add", "--all")
        self._git("commit", "--quiet", "--message", message)
        self._push()
        return self._git("rev-parse", "HEAD")

    def edit(self, path: str, old: str, new: str) -> str:
        text = self.read(path)
        assert old in text, f"{path} does not hold {old!r}"
        return self.change({path: text.replace(old, new)})

    def override(self, **named: str | None) -> str:
        return self.change({f"overrides/{name}.yaml": text for name, text in named.items()})

    def policy(self, **changed: Any) -> None:
        data = plain_yaml.load(self.read(POLICY))
        for domain in data["domains"]:
            domain.update(changed)
        self.change({POLICY: yaml.safe_dump(data)}, "Demands need approval")

    def merge(self, branch: str, *options: str) -> None:
        self.fetch()
        self._git("merge", "--quiet", *options, f"origin/{branch}")
        self._push()

    def squash(self, branch: str, message: str) -> None:
        self.fetch()
        self._git("merge", "--quiet", "--squash", f"origin/{branch}")
        self._git("commit", "--quiet", "--message", message)
        self._push()

    def rebase(self, branch: str, *options: str) -> None:
        self.fetch()
        self._git("checkout", "--quiet", "-B", "work", f"origin/{branch}")
        self._git("rebase", "--quiet", *options, "origin/main")
        self._push()
        self._git("checkout", "--quiet", "-")

    def delete(self, branch: str) -> None:
        pygit2.Repository(str(self.bare)).branches.delete(branch)

    def _push(self) -> None:
        self._git("push", "--quiet", "origin", "HEAD:main")


@dataclass(frozen=True)
class Commit:
    id: str
    parents: tuple[str, ...]
    summary: str
    trailers: tuple[tuple[str, str], ...]

    def one(self, key: str) -> str:
        return next(iter(self.all(key)), "")

    def all(self, key: str) -> list[str]:
        return [value for known, value in self.trailers if known == key]


_FORMAT = "%H%x1f%P%x1f%s%x1f%(trailers:only,unfold,separator=%x1e)%x1d"


def commits(repo: Path, revisions: str = "main") -> list[Commit]:
    """Return the commits of ``revisions``, oldest first, without the repository's first commit."""
    range_ = pygit2.Repository(str(repo)).revparse(revisions)
    ends = (range_.from_object, range_.to_object)
    return [*_commits(repo, "..".join(str(end.id) for end in ends if end))]


@lru_cache(maxsize=64)  # a test that waits for a commit asks again and again
def _commits(repo: Path, revisions: str) -> tuple[Commit, ...]:
    text = git(repo, "log", "--reverse", f"--format={_FORMAT}", revisions)
    found = []
    for record in text.split("\x1d"):
        if not record.strip("\n"):
            continue
        commit, parents, summary, trailers = record.strip("\n").split("\x1f")
        pairs = [tuple(line.split(": ", 1)) for line in trailers.split("\x1e") if ": " in line]
        found.append(Commit(commit, tuple(parents.split()), summary, tuple(pairs)))  # type: ignore[arg-type]
    return tuple(commit for commit in found if commit.parents)


def program(path: Path, script: str, shell: str = "/bin/sh") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!{shell}\n{script}\n")
    path.chmod(0o755)
    return path


def hook(repo: Path | str | GitRepo, name: str, script: str) -> Path:
    return program(Path(os.fspath(repo), "hooks", name), script)


def keygen(path: Path, passphrase: str = "", kind: str = "ed25519") -> Path:
    """Make an SSH key; its public part is in a file beside it."""
    command = ["ssh-keygen", "-q", "-t", kind, "-N", passphrase, "-C", "", "-f", str(path)]
    subprocess.run(command, check=True)
    return path


@contextmanager
def away(repo: Path) -> Iterator[None]:
    elsewhere = repo.rename(repo.with_name("away.git"))
    try:
        yield
    finally:
        elsewhere.rename(repo)


def lose(repo: Path, spec: str) -> str:
    """Remove an object from a bare repository, as a disk that fails; return its id."""
    lost = git(repo, "rev-parse", spec)
    moved = [path.replace(repo.parent / path.name) for path in repo.glob("objects/pack/*")]
    for pack in (path for path in moved if path.suffix == ".pack"):
        with pack.open("rb") as file:
            subprocess.run(["git", "unpack-objects", "-q"], cwd=repo, stdin=file, check=True)
    (repo / "objects" / lost[:2] / lost[2:]).unlink()
    return lost


def tip(repo: Path | str) -> str:
    return str(pygit2.Repository(str(repo)).references["refs/heads/main"].target)


def read(repo: Path, path: str) -> str:
    return GitRepo(repo).files(path).get(path, "")


def operations(repo: Path) -> list[str]:
    return [found for commit in commits(repo) if (found := commit.one("Operation-Id"))]


def branches(repo: Path, *folders: str) -> list[str]:
    names = pygit2.Repository(str(repo)).branches.local
    return sorted(name for name in names if name.startswith(folders or "demand/"))


def state_of(repo: Path, revision: str = "main") -> State:
    opened = pygit2.Repository(str(repo))
    return snapshots.state_at(opened, opened.revparse_single(revision).id).state


def books(repo: Path, revision: str = "main") -> dict[str, Any]:
    return as_data(bookkeeping(state_of(repo, revision)), "")


def claims(repo: Path, needle: str = "") -> list[str]:
    files = GitRepo(repo).files("ledger/")
    return [path for path, text in files.items() if "Claim\n" in text and needle in text]


def differing(repo: Path, since: str | None = None) -> dict[str, tuple[str, ...]]:
    """Return the differing files of each commit after ``since`` that `demandops verify` rejects."""
    with reader.opened(str(repo)) as opened:
        commits = opened.revisions(f"{since or root(repo)}..")
        verdicts = opened.verify(commits)
    return {verdict.summary: verdict.differing for verdict in verdicts if not verdict.holds}


def root(repo: Path) -> str:
    *_, first = pygit2.Repository(str(repo)).walk(tip(repo))
    return str(first.id)


def fsck(repo: Path) -> str:
    """Return what git finds wrong in a repository, apart from notices."""
    done = subprocess.run(
        ["git", "-C", str(repo), "fsck", "--strict", "--no-dangling", "--no-progress"],
        capture_output=True,
        text=True,
        check=False,
    )
    lines = (done.stdout + done.stderr).splitlines()
    told = " ".join(line for line in lines if not line.startswith("notice: "))
    return told or "it fails" * bool(done.returncode)


def assert_sound(repo: Path, *, verify_last: int = 0) -> None:
    """Check objects, history, operations and the last ``verify_last`` commits (0 means all)."""
    assert fsck(repo) == ""
    made = commits(repo)
    assert [commit.id for commit in made if len(commit.parents) != 1] == []
    ids = [found for commit in made if (found := commit.one("Operation-Id"))]
    assert sorted(ids) == sorted(set(ids)), sorted(one for one in ids if ids.count(one) > 1)
    before = made[-verify_last - 1].id if 0 < verify_last < len(made) else None
    assert differing(repo, before) == {}


# ---- forced writes to disk ----

_CALLS: Mapping[str, object] = {name: getattr(os, name) for name in ("fsync", "fdatasync")}


def force_writes(on: bool) -> None:
    """Switch fsync in this process on or off; it is on only in tests that are marked ``synced``.

    Without fsync, a power cut can lose data, but a killed process loses none. The program has no
    switch for fsync, so tests replace the functions that it calls.
    """
    pygit2.option(pygit2.enums.Option.ENABLE_FSYNC_GITDIR, int(on))
    for name, call in _CALLS.items():
        setattr(os, name, call if on else lambda file: None)


def force_writes_in(repo: Path, on: bool) -> None:
    """Switch git's fsync in a repository on or off."""
    pygit2.Repository(str(repo)).config["core.fsync"] = "committed" if on else "none"
