"""The real git accepts commits signed with an SSH key, and `verify` reports on signatures.

More is in ``stories/signing.yaml``.
"""

from __future__ import annotations

import os
import re
import shutil
import stat
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pygit2
import pytest
from demandops.repo.git import signing
from demandops.repo.git.signing import Signer, SigningFailed

from tests.integration.conftest import On
from tests.kit import rig
from tests.kit.cli import Ran, process
from tests.kit.goals import Goal, connection, goal
from tests.kit.repo import FORGER, GitRepo, branches, git, keygen, program

SIGNERS = "policy/allowed-signers"
Book = Callable[..., Ran]
Accepts = Callable[..., bool]


def listed(key: Path) -> str:
    return f'generator@example.org namespaces="git" {Path(f"{key}.pub").read_text()}'


def link(id: str) -> Goal:
    return goal([], [connection(id, topics=[f"/t{sum(map(ord, id))}"])])


@pytest.fixture
def key(tmp_path: Path) -> Path:
    return keygen(tmp_path / "key")


@pytest.fixture
def book(on: On) -> Book:
    """Return a function that books a connection with ``demandops request``."""
    return lambda id, key="": on.book(link(id), more=("--signing-key", key) if key else ())


@pytest.fixture
def agent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """An ssh-agent without keys, for one test."""
    said = process("ssh-agent", "-a", tmp_path / "agent").out
    pid = re.search(r"SSH_AGENT_PID=(\d+)", said)
    assert pid
    monkeypatch.setenv("SSH_AUTH_SOCK", str(tmp_path / "agent"))
    yield
    os.kill(int(pid[1]), 15)


@pytest.fixture
def git_accepts(state: GitRepo, tmp_path: Path) -> Accepts:
    """Return a function that says whether git accepts a commit's signature by one of the keys."""

    def accepts(key: Path, commit: str = "main") -> bool:
        (tmp_path / "allowed").write_text(listed(key))
        config = ["gpg.format=ssh", f"gpg.ssh.allowedSignersFile={tmp_path / 'allowed'}"]
        options = [word for each in config for word in ("-c", each)]
        return process("git", "-C", state.path, *options, "verify-commit", commit).code == 0

    return accepts


def test_git_accepts_the_signature_of_a_file_or_an_agent(
    book: Book, state: GitRepo, key: Path, tmp_path: Path, git_accepts: Accepts, agent: None
) -> None:
    book("Straße/北京", key)
    other = keygen(tmp_path / "other", kind="rsa")
    assert (git_accepts(key), git_accepts(other)) == (True, False)
    subprocess.run(["ssh-add", "-q", str(other)], check=True)
    other.unlink()
    book("a", f"{other}.pub")
    assert git_accepts(other)
    git(state, "fsck", "--strict")


def test_a_generator_without_a_key_warns_once_where_keys_are_listed(
    bare: Path, state: GitRepo, key: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def warnings() -> int:
        return sum("this generator has no key" in text for text in caplog.messages)

    with rig.running(bare) as generator:
        rig.book(generator, rig.goal(1))
        assert warnings() == 0
        state.commit({SIGNERS: listed(key)})
        rig.book(generator, rig.goal(2), rig.goal(3))
        assert warnings() == 1
    with rig.running(bare, signing_key=key) as generator:
        rig.book(generator, rig.goal(4))
    assert warnings() == 1


def test_a_key_that_cannot_sign_is_told_with_the_reason_and_books_nothing(
    on: On, tmp_path: Path, agent: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def told(key: Path | str, says: str) -> None:
        ran = on.request(link("a"), more=("--signing-key", key))
        assert (ran.code, branches(on.state.path)) == (1, [])
        assert "PRIVATE KEY-----" not in ran.out + ran.err
        assert ran.err.startswith(f"error: signing key {key} {says}")

    told(tmp_path / "nothing", "is not a file; ")
    key = keygen(tmp_path / "secret", "a passphrase")
    told(key, f"has a passphrase; run `ssh-add {key}` and name {key}.pub")
    key.chmod(0o644)
    told(key, f"can be read by others; run: chmod 600 {key}\n")
    for name in ("key", "agent-key", "passphrase"):
        (tmp_path / name).write_text("hello\n")
        (tmp_path / name).chmod(stat.S_IRUSR)
        told(tmp_path / name, "cannot sign: ")
    key.unlink()
    told(f"{key}.pub", "is public, and no agent signs for it (")
    monkeypatch.delenv("SSH_AUTH_SOCK")
    told(f"{key}.pub", "is public, and no agent signs for it (")


def test_a_key_that_is_gone_later_is_told_to_the_requester(
    state: GitRepo, key: Path, tmp_path: Path
) -> None:
    with rig.running(state.path, signing_key=key) as generator:
        rig.receipt(generator.submit(link("a")))
        before, hidden = state.tip, key.rename(tmp_path / "hidden")
        with pytest.raises(SigningFailed):
            rig.receipt(generator.submit(link("b")))
        assert state.tip == before
        hidden.rename(key)
        rig.receipt(generator.submit(link("c")))
        assert state.tip != before


def replace_newest(state: GitRepo, content: bytes, signature: str) -> str:
    """Put a signed commit in the place of the newest commit; return its id."""
    repo = pygit2.Repository(str(state.path))
    made = repo.create_commit_with_signature(content.decode(), signature, "gpgsig")
    repo.references["refs/heads/main"].set_target(made)
    return str(made)


class TestVerify:
    @pytest.fixture
    def signed(self, book: Book, state: GitRepo, key: Path) -> pygit2.Commit:
        """Return the newest commit, which is signed with the key that is listed."""
        state.commit({SIGNERS: listed(key)})
        book("a", key)
        return pygit2.Repository(str(state.path))[state.tip].peel(pygit2.Commit)

    @pytest.fixture
    def newest(self, on: On) -> Callable[[], str]:
        """Return a function that returns what `verify` says of the newest commit's signature."""

        def verified() -> str:
            (row,) = on("verify", "main~1..main", "-o", "json").json()
            assert not row["holds"]
            return str(row["signature"])

        return verified

    def test_a_commit_cannot_vouch_for_itself(
        self, newest: Callable[[], str], state: GitRepo, key: Path, tmp_path: Path
    ) -> None:
        forger = keygen(tmp_path / "forger")
        state.commit({SIGNERS: listed(key)})
        forged = "Forged\n\nOperation: join\nRender-Version: 3\n"
        state.commit({SIGNERS: listed(forger)}, forged, FORGER)
        assert newest().startswith("is not signed, but ")
        content = pygit2.Repository(str(state.path))[state.tip].read_raw()
        replace_newest(state, content, Signer(forger).sign(content))
        assert newest().startswith("is signed, but not by a key")

    def test_a_gpg_signature_that_this_machine_trusts_does_not_hold(
        self, newest: Callable[[], str], signed: pygit2.Commit, state: GitRepo,
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    ) -> None:  # fmt: skip
        says = "printf '\\n[GNUPG:] %s\\n' 'GOODSIG 1 x' TRUST_ULTIMATE"
        gpg = program(tmp_path / "gpg", says)
        for name, value in {"COUNT": "1", "KEY_0": "gpg.program", "VALUE_0": str(gpg)}.items():
            monkeypatch.setenv(f"GIT_CONFIG_{name}", value)
        armor = "-----{} PGP SIGNATURE-----"
        content = signed.gpg_signature[1] or b""
        replace_newest(state, content, f"{armor.format('BEGIN')}\n\nx\n{armor.format('END')}")
        assert git(state, "log", "-1", "--format=%G?") == "G"
        assert newest().startswith("is signed, but not by a key")

    def test_a_signature_of_another_commit_does_not_hold(
        self, newest: Callable[[], str], signed: pygit2.Commit, state: GitRepo
    ) -> None:
        signature, content = signed.gpg_signature
        assert signature and content
        forged = content.replace(b"in the name of vehicle00", b"in the name of vehicle01")
        assert forged != content
        made = replace_newest(state, forged, signature.decode())
        assert newest() == "has a signature that does not match its content"
        # git, unlike libgit2, would check the signed commit in place of the forged one
        git(state.path, "update-ref", f"refs/replace/{made}", str(signed.id))
        assert newest() == "has a signature that does not match its content"

    @pytest.mark.usefixtures("signed")
    def test_a_missing_ssh_keygen_is_told(
        self, on: On, key: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(signing, "_good", {})
        found = shutil.which("git")
        assert found
        (tmp_path / "bin").mkdir()
        (tmp_path / "bin" / "git").symlink_to(found)
        monkeypatch.setenv("PATH", str(tmp_path / "bin"))
        told = "ssh-keygen, which checks the signatures of commits, is missing"
        assert on.refused("verify").startswith(f"error: {told}")
        with pytest.raises(SigningFailed, match="ssh-keygen, which signs the commits, is missing"):
            Signer(key)
