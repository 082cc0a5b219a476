"""The real git accepts commits signed with an SSH key, and `verify` reports on signatures."""

from __future__ import annotations

import os
import re
import shutil
import stat
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pygit2
import pytest
from demandops.repo.git import signing
from demandops.repo.git.signing import Signer, SigningFailed
from demandops.serve.generator import Generator

from tests.integration.conftest import On
from tests.kit import rig
from tests.kit.cli import Ran, Run
from tests.kit.goals import connection, goal
from tests.kit.repo import FORGER, GitRepo, Person, branches, git

SIGNERS = "policy/allowed-signers"
Book = Callable[..., Ran]


def keygen(path: Path, passphrase: str = "", kind: str = "ed25519") -> Path:
    command = ["ssh-keygen", "-q", "-t", kind, "-N", passphrase, "-C", "", "-f", str(path)]
    subprocess.run(command, check=True)
    return path


def listed(*keys: Path) -> str:
    public = [Path(f"{key}.pub").read_text().strip() for key in keys]
    return "".join(f'generator@example.org namespaces="git" {key}\n' for key in public)


@pytest.fixture
def key(tmp_path: Path) -> Path:
    return keygen(tmp_path / "key")


@pytest.fixture
def book(on: On) -> Book:
    """Return a function that books a connection with ``demandops request``."""

    def call(id: str, key: str | Path = "") -> Ran:
        return on.book(
            goal([], [connection(id, topics=[f"/t{sum(map(ord, id))}"])]),
            more=("--signing-key", key) if key else (),
        )

    return call


@pytest.fixture
def agent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """An ssh-agent without keys, for one test."""
    said = subprocess.run(
        ["ssh-agent", "-a", str(tmp_path / "agent")], check=True, capture_output=True, text=True
    ).stdout
    pid = re.search(r"SSH_AGENT_PID=(\d+)", said)
    assert pid
    monkeypatch.setenv("SSH_AUTH_SOCK", str(tmp_path / "agent"))
    yield
    os.kill(int(pid[1]), 15)


@pytest.fixture
def git_accepts(state: GitRepo, tmp_path: Path) -> Callable[..., bool]:
    """Return a function that says whether git accepts a commit's signature by one of the keys."""

    def accepts(key: Path, commit: str = "main") -> bool:
        (tmp_path / "allowed").write_text(listed(key))
        config = ["gpg.format=ssh", f"gpg.ssh.allowedSignersFile={tmp_path / 'allowed'}"]
        options = [word for each in config for word in ("-c", each)]
        command = ["git", "-C", str(state.path), *options, "verify-commit", commit]
        return subprocess.run(command, capture_output=True, check=False).returncode == 0

    return accepts


def test_git_accepts_the_signature(
    book: Book, state: GitRepo, key: Path, tmp_path: Path, git_accepts: Callable[..., bool]
) -> None:
    book("Straße/北京", key)
    assert git_accepts(key)
    other = keygen(tmp_path / "other", kind="rsa")
    assert not git_accepts(other)
    book("a", other)
    assert git_accepts(other)
    git(state, "fsck", "--strict")


def test_the_ssh_agent_can_sign_with_a_key_that_has_no_file(
    book: Book, agent: None, key: Path, git_accepts: Callable[..., bool]
) -> None:
    subprocess.run(["ssh-add", "-q", str(key)], check=True)
    key.unlink()
    book("a", f"{key}.pub")
    assert git_accepts(key)


@pytest.mark.usefixtures("git_environment")
def test_every_command_that_writes_signs(
    on: On,
    demandops: Run,
    book: Book,
    state: GitRepo,
    key: Path,
    git_accepts: Callable[..., bool],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("DEMANDOPS_SIGNING_KEY", str(key))
    shutil.rmtree(state.path)
    assert demandops("init", state.path, "--bare").code == 0
    made = [state.tip]
    book("a")
    made.append(state.tip)
    for command in ("rollback main~1 -y -m x --drop-newer", "decommission -y vehicle00", "upgrade"):
        if command == "decommission -y vehicle00":
            book("a")
        elif command == "upgrade":  # removes a file, so that it renders something
            state.commit({next(iter(state.manifests())): None})
        ran = on(*command.split())
        assert (ran.code, ran.err) == (0, "")
        made.append(state.tip)
    assert len(set(made)) == 5
    assert all(git_accepts(key, commit) for commit in made)


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
    with rig.running(bare):
        assert warnings() == 2


def test_the_commit_of_a_proposal_is_signed(
    book: Book, on: On, state: GitRepo, person: Person, key: Path, git_accepts: Callable[..., bool]
) -> None:
    person.policy(approval="required")
    book("a", key)
    (branch,) = branches(state.path)
    assert git_accepts(key, branch)
    before, images = state.tip, "registry/images.yaml"
    state.commit({images: state.files()[images].replace("2025-04", "2025-05")})
    assert on("rollback", before, "-m", "x", "-y").code == 0
    assert branches(state.path) == [branch]


def test_what_people_changed_is_carried_out_by_a_signed_commit(
    book: Book, state: GitRepo, key: Path
) -> None:
    book("a")
    state.commit({next(iter(state.files("ledger/connections/"))): None})
    book("b", key)
    heads = [
        git(state, "cat-file", "commit", commit).split("\n\n")[0] for commit in ("main~1", "main~2")
    ]
    assert ["\ngpgsig " in head for head in heads] == [True, False]


class TestKeysThatCannotSign:
    """If the key cannot sign, the command says why and books nothing."""

    @pytest.fixture
    def told(self, on: On) -> Callable[[Path | str], str]:
        def by(key: Path | str) -> str:
            ran = on.request(goal([], [connection("a")]), more=("--signing-key", key))
            assert (ran.code, branches(on.state.path)) == (1, [])
            assert "PRIVATE KEY-----" not in ran.out + ran.err
            return ran.err

        return by

    def test_no_file_and_a_passphrase(
        self, told: Callable[[Path | str], str], tmp_path: Path
    ) -> None:
        key = tmp_path / "nothing"
        assert told(key).startswith(f"error: signing key {key} is not a file; ")
        key = keygen(tmp_path / "key", "a passphrase")
        says = f"error: signing key {key} has a passphrase; run `ssh-add {key}` and name {key}.pub"
        assert told(key).startswith(says)

    def test_readable_by_others(self, told: Callable[[Path | str], str], key: Path) -> None:
        key.chmod(0o644)
        says = f"error: signing key {key} can be read by others; run: chmod 600 {key}\n"
        assert told(key) == says

    @pytest.mark.parametrize("name", ["key", "agent-key", "passphrase"])
    def test_no_key(self, told: Callable[[Path | str], str], tmp_path: Path, name: str) -> None:
        key = tmp_path / name
        key.write_text("hello\n")
        key.chmod(stat.S_IRUSR)
        assert told(key).startswith(f"error: signing key {key} cannot sign: ")

    def test_an_agent_that_does_not_hold_it_and_none(
        self,
        told: Callable[[Path | str], str],
        agent: None,
        key: Path,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        key.unlink()
        says = f"error: signing key {key}.pub is public, and no agent signs for it ("
        assert told(f"{key}.pub").startswith(says)
        monkeypatch.delenv("SSH_AUTH_SOCK")
        assert told(f"{key}.pub").startswith(says)


def test_a_key_that_is_gone_later_is_told_to_the_requester(
    state: GitRepo, key: Path, tmp_path: Path
) -> None:
    def submit(generator: Generator, id: str) -> None:
        rig.receipt(generator.submit(goal([], [connection(id, topics=[f"/t{sum(map(ord, id))}"])])))

    with rig.running(state.path, signing_key=key) as generator:
        submit(generator, "a")
        before, hidden = state.tip, key.rename(tmp_path / "hidden")
        with pytest.raises(SigningFailed):
            submit(generator, "b")
        assert state.tip == before
        hidden.rename(key)
        submit(generator, "c")
        assert state.tip != before


def sign_again(state: GitRepo, sign: Callable[[bytes], str]) -> None:
    """Replace the newest commit by the same with a signature."""
    repo = pygit2.Repository(str(state.path))
    content = repo[state.tip].read_raw()
    made = repo.create_commit_with_signature(content.decode(), sign(content), "gpgsig")
    repo.references["refs/heads/main"].set_target(made)


class TestVerify:
    @pytest.fixture
    def rows(self, on: On, state: GitRepo) -> Callable[[int], list[dict[str, Any]]]:
        """Return a function that verifies all commits since now, and returns their rows."""
        first = state.tip

        def verify(code: int) -> list[dict[str, Any]]:
            ran = on("verify", f"{first}..main", "--output", "json")
            assert ran.code == code
            return list(ran.json())

        return verify

    def test_without_a_list_it_only_counts(self, book: Book, on: On, key: Path) -> None:
        book("a", key)
        book("b")
        ran = on("verify", "main~2..main")
        assert ran.code == 0
        assert ran.out.splitlines()[-2:] == ["2 of 2 commits are verified", "1 of 2 are signed"]

    def test_with_a_list_every_later_commit_must_be_signed(
        self, book: Book, on: On, rows: Any, state: GitRepo, key: Path, tmp_path: Path
    ) -> None:
        book("before")
        state.commit({SIGNERS: listed(key)}, "Only signed commits\n")
        book("good", key)
        assert rows(0)[-1]["signer"] == "generator@example.org"
        book("unsigned")
        assert f"{state.tip[:10]} UNSIGNED  Join unsigned\n" in on("verify").out
        book("another", keygen(tmp_path / "another"))
        found = rows(1)
        assert [row["holds"] for row in found] == [True, True, True, False, False]
        assert [row["signature"].partition(",")[0] for row in found[-2:]] == [
            "is not signed",
            "is signed",
        ]

    def test_a_commit_cannot_vouch_for_itself(
        self, on: On, state: GitRepo, key: Path, tmp_path: Path
    ) -> None:
        forger = keygen(tmp_path / "forger")
        state.commit({SIGNERS: listed(key)})
        forged = "Forged\n\nOperation: join\nRender-Version: 3\n"
        state.commit({SIGNERS: listed(forger)}, forged, FORGER)
        for signs, told in ((None, "is not signed, but "), (forger, "is signed, but not by a key")):
            if signs:
                sign_again(state, Signer(signs).sign)
            (row,) = on("verify", "main~1..main", "-o", "json").json()
            assert (row["holds"], row["touched"]) == (False, [SIGNERS])
            assert row["signature"].startswith(told)

    def test_a_gpg_signature_that_this_machine_trusts_does_not_hold(
        self, on: On, book: Book, state: GitRepo, key: Path, tmp_path: Path, monkeypatch: Any
    ) -> None:
        gpg = tmp_path / "gpg"
        gpg.write_text("#!/bin/sh\nprintf '\\n[GNUPG:] %s\\n' 'GOODSIG 1 x' TRUST_ULTIMATE\n")
        gpg.chmod(0o755)
        for name, value in {"COUNT": "1", "KEY_0": "gpg.program", "VALUE_0": str(gpg)}.items():
            monkeypatch.setenv(f"GIT_CONFIG_{name}", value)
        state.commit({SIGNERS: listed(key)})
        book("a")
        armor = "-----{} PGP SIGNATURE-----"
        sign_again(state, lambda _: f"{armor.format('BEGIN')}\n\nx\n{armor.format('END')}")
        assert git(state, "log", "-1", "--format=%G?") == "G"
        (row,) = on("verify", "main~1..main", "-o", "json").json()
        assert row["signature"].startswith("is signed, but not by a key")

    def test_a_signature_of_another_commit_does_not_hold(
        self, book: Book, on: On, state: GitRepo, key: Path
    ) -> None:
        state.commit({SIGNERS: listed(key)})
        book("a", key)
        repo = pygit2.Repository(str(state.path))
        signed = repo[state.tip].peel(pygit2.Commit)
        signature, content = signed.gpg_signature
        assert signature and content
        text = content.decode().replace("in the name of vehicle00", "in the name of vehicle01")
        assert text != content.decode()
        made = repo.create_commit_with_signature(text, signature.decode(), "gpgsig")
        repo.references["refs/heads/main"].set_target(made)

        def verified() -> str:
            (row,) = on("verify", "main~1..main", "-o", "json").json()
            return str(row["signature"])

        assert verified() == "has a signature that does not match its content"
        # git, unlike libgit2, would check the signed commit in place of the forged one
        git(state.path, "update-ref", f"refs/replace/{made}", str(signed.id))
        assert verified() == "has a signature that does not match its content"

    def test_a_missing_ssh_keygen_is_told(
        self,
        on: On,
        book: Book,
        state: GitRepo,
        key: Path,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        state.commit({SIGNERS: listed(key)})
        book("a", key)
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

    @pytest.mark.parametrize("separator", ["\u2028", "\u0085", "\x0b", "\x1c"])
    def test_a_signer_whose_name_has_an_odd_character_stops_no_verification(
        self, book: Book, rows: Any, state: GitRepo, key: Path, separator: str
    ) -> None:
        state.commit({SIGNERS: listed(key).replace("@", f"{separator}@")})
        book("a", key)
        book("b", key)
        assert [row["holds"] for row in rows(0)] == [True, True, True]

    def test_keys_may_change(
        self, book: Book, rows: Any, state: GitRepo, key: Path, tmp_path: Path
    ) -> None:
        """For each commit, `verify` uses the list of keys that was in effect before it."""
        new = keygen(tmp_path / "new")
        state.commit({SIGNERS: listed(key)})
        book("a", key)
        state.commit({SIGNERS: listed(new)})
        book("b", new)
        assert all(row["holds"] for row in rows(0))
        book("c", key)
        assert not rows(1)[-1]["holds"]


def test_commits_are_signed_off_if_the_settings_name_who_does(on: On, state: GitRepo) -> None:
    platform = "Fleet Platform <platform@example.org>"
    settings = state.files()["demandops.yaml"]
    state.commit({"demandops.yaml": f"{settings}signedOffBy: {platform}\n"})
    on.book(goal([], [connection("c")]))
    assert on("suspend", "--connection", "c", "-m", "Repair", "--yes").code == 0
    form = "--format=%an|%(trailers:key=Signed-off-by,valueonly,separator=%x2C)"
    by_person, by_generator = git(state.path, "log", "-2", form).splitlines()
    name, _, signed = by_person.partition("|")
    assert signed.startswith(f"{name} <")
    assert by_generator.partition("|")[2] == platform
    assert on("verify", "main~2..main").code == 0
