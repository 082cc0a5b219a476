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

import pytest
from demandops.repo.git import signing
from demandops.repo.git.signing import Signer, SigningFailed

from tests.kit import rig
from tests.kit.goals import connection, goal
from tests.kit.repo import FORGER, branches, git

Run = Callable[..., Any]

SIGNERS = "policy/allowed-signers"
POLICY = "policy/access-domains.yaml"


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
def book(demandops: Run, state: Any) -> Run:
    """Return a function that books a connection with ``demandops request``."""
    import yaml

    def call(id: str, *more: str | Path) -> Any:
        made = yaml.safe_dump(goal([], [connection(id)]))
        return demandops("request", "-", "--state-repo", state.path, *more, stdin=made)

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


def git_says(
    state: Any, allowed: str, tmp_path: Path, commit: str = "main"
) -> subprocess.CompletedProcess[str]:
    file = tmp_path / "allowed"
    file.write_text(allowed)
    config = ["-c", "gpg.format=ssh", "-c", f"gpg.ssh.allowedSignersFile={file}"]
    return subprocess.run(
        ["git", "-C", str(state.path), *config, "verify-commit", commit],
        capture_output=True,
        text=True,
        check=False,
    )


def test_git_accepts_the_signature(book: Run, state: Any, key: Path, tmp_path: Path) -> None:
    assert book("Straße/北京", "--signing-key", key).code == 0
    said = git_says(state, listed(key), tmp_path)
    assert said.returncode == 0
    assert said.stderr.startswith('Good "git" signature for generator@example.org with ED25519 key')
    assert git_says(state, listed(keygen(tmp_path / "other")), tmp_path).returncode != 0
    git(state, "fsck", "--strict")


def test_an_rsa_key(book: Run, state: Any, tmp_path: Path) -> None:
    key = keygen(tmp_path / "key", kind="rsa")
    assert book("a", "--signing-key", key).code == 0
    assert git_says(state, listed(key), tmp_path).returncode == 0


def test_the_ssh_agent_can_sign_with_a_key_that_has_no_file(
    book: Run, state: Any, agent: None, tmp_path: Path
) -> None:
    key = keygen(tmp_path / "key")
    subprocess.run(["ssh-add", "-q", str(key)], check=True)
    key.unlink()
    assert book("a", "--signing-key", f"{key}.pub").code == 0
    assert git_says(state, listed(key), tmp_path).returncode == 0


def test_every_command_that_writes_signs(
    git_environment: None,
    demandops: Run,
    book: Run,
    state: Any,
    key: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("DEMANDOPS_SIGNING_KEY", str(key))
    shutil.rmtree(state.path)
    assert demandops("init", state.path, "--bare").code == 0
    made = [state.tip]
    assert book("a").code == 0
    made.append(state.tip)
    commands = (
        ("rollback", "main~1", "-m", "x", "--drop-newer"),
        ("decommission", "vehicle00"),
        ("upgrade",),
    )
    for command in commands:
        if command == ("decommission", "vehicle00"):
            assert book("a").code == 0
        elif command == ("upgrade",):  # removes a file, so that it renders something
            state.commit({next(iter(state.manifests())): None})
        ran = demandops(*command, "--state-repo", state.path)
        assert (ran.code, ran.err) == (0, "")
        made.append(state.tip)
    assert len(set(made)) == 5
    for commit in made:
        assert git_says(state, listed(key), tmp_path, commit).returncode == 0


def test_a_generator_without_a_key_warns_once_where_keys_are_listed(
    bare: Path, state: Any, key: Path, caplog: pytest.LogCaptureFixture
) -> None:
    warning = (
        "policy/allowed-signers lists who may sign, but this generator has no key, so `verify` "
        "will refuse its commits, and generators will treat them as commits by a person; start the "
        "generator with --signing-key"
    )
    with rig.running(bare) as generator:
        rig.book(generator, rig.goal(1))
        assert warning not in caplog.messages
        state.commit({SIGNERS: listed(key)})
        rig.book(generator, rig.goal(2), rig.goal(3))
        assert caplog.messages.count(warning) == 1
    with rig.running(bare, signing_key=key) as generator:
        rig.book(generator, rig.goal(4))
    assert caplog.messages.count(warning) == 1
    with rig.running(bare):
        assert caplog.messages.count(warning) == 2


class TestProposals:
    """The generator also signs the commits on the branches of demands that wait for approval."""

    @pytest.fixture(autouse=True)
    def _strict(self, state: Any) -> None:
        import yaml

        policy = yaml.safe_load(state.files()[POLICY])
        policy["domains"][0]["approval"] = "required"
        state.commit({POLICY: yaml.safe_dump(policy)})

    def branch(self, state: Any) -> str:
        return "".join(branches(state.path))

    def test_its_commit_is_signed(self, book: Run, state: Any, key: Path, tmp_path: Path) -> None:
        assert book("a", "--signing-key", key).code == 0
        assert git_says(state, listed(key), tmp_path, self.branch(state)).returncode == 0

    def test_rolling_back_while_one_waits(
        self, git_environment: None, demandops: Run, book: Run, state: Any, key: Path
    ) -> None:
        assert book("a").code == 0
        waiting, before = self.branch(state), state.tip
        path = "registry/images.yaml"
        state.commit({path: state.files()[path].replace("2025-04", "2025-05")})
        ran = demandops("rollback", before, "-m", "x", "--state-repo", state.path)
        assert (ran.code, ran.err) == (0, "")
        assert self.branch(state) == waiting


def test_what_people_changed_is_carried_out_by_a_signed_commit(
    book: Run, state: Any, key: Path, tmp_path: Path
) -> None:
    assert book("a").code == 0
    path = next(iter(state.files("ledger/connections/")))
    state.commit({path: None})
    assert book("b", "--signing-key", key).code == 0
    heads = [
        git(state, "cat-file", "commit", commit).split("\n\n")[0] for commit in ("main~1", "main~2")
    ]
    assert ["\ngpgsig " in head for head in heads] == [True, False]


class TestKeysThatCannotSign:
    """If the key cannot sign, the command says why and books nothing."""

    def told(self, book: Run, state: Any, key: Path | str) -> str:
        before = state.tip
        ran = book("a", "--signing-key", key)
        assert (ran.code, ran.out, state.tip) == (1, "", before)
        assert "PRIVATE KEY-----" not in ran.err
        return str(ran.err)

    def test_none(self, book: Run, state: Any, tmp_path: Path) -> None:
        key = tmp_path / "nothing"
        assert self.told(book, state, key) == (
            f"error: signing key {key} is not a file; make one with `ssh-keygen -t ed25519 -f "
            f"{key}`, or name an existing one\n"
        )

    def test_a_passphrase(self, book: Run, state: Any, tmp_path: Path) -> None:
        key = keygen(tmp_path / "key", "a passphrase")
        assert self.told(book, state, key) == (
            f"error: signing key {key} has a passphrase; run `ssh-add {key}` and name {key}.pub, "
            "so that the agent signs\n"
        )

    def test_readable_by_others(self, book: Run, state: Any, key: Path) -> None:
        key.chmod(0o644)
        assert self.told(book, state, key) == (
            f"error: signing key {key} can be read by others; run: chmod 600 {key}\n"
        )

    @pytest.mark.parametrize("name", ["key", "agent-key", "passphrase"])
    def test_no_key(self, book: Run, state: Any, tmp_path: Path, name: str) -> None:
        key = tmp_path / name
        key.write_text("hello\n")
        key.chmod(stat.S_IRUSR)
        assert self.told(book, state, key).startswith(f"error: signing key {key} cannot sign: ")

    def test_an_agent_that_does_not_hold_it_and_none(
        self, book: Run, state: Any, agent: None, key: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        key.unlink()
        told = f"error: signing key {key}.pub is public, and no agent signs for it ("
        assert self.told(book, state, f"{key}.pub").startswith(told)
        monkeypatch.delenv("SSH_AUTH_SOCK")
        assert self.told(book, state, f"{key}.pub").startswith(told)


def test_a_key_that_is_gone_later_is_told_to_the_requester(
    state: Any, key: Path, tmp_path: Path, data_home: Path
) -> None:
    from demandops.serve.generator import Generator

    generator = Generator(str(state.path), signing_key=key)
    try:
        generator.submit(goal([], [connection("a")])).future.result(rig.PATIENCE_S)
        before, hidden = state.tip, key.rename(tmp_path / "hidden")
        with pytest.raises(SigningFailed):
            generator.submit(goal([], [connection("b")])).future.result(rig.PATIENCE_S)
        assert state.tip == before
        hidden.rename(key)
        generator.submit(goal([], [connection("c")])).future.result(rig.PATIENCE_S)
    finally:
        assert generator.close(rig.PATIENCE_S)


def test_ssh_keygen_is_missing(key: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SigningFailed, match="ssh-keygen, which signs the commits, is missing"):
        Signer(key)


class TestVerify:
    def rows(self, demandops: Run, state: Any, since: str, code: int) -> list[dict[str, Any]]:
        where = ("--state-repo", state.path, "--output", "json")
        ran = demandops("verify", f"{since}..main", *where)
        assert ran.code == code
        return list(ran.json())

    def test_without_a_list_it_only_counts(
        self, demandops: Run, book: Run, state: Any, key: Path
    ) -> None:
        first = state.tip
        book("a", "--signing-key", key)
        book("b")
        ran = demandops("verify", f"{first}..main", "--state-repo", state.path)
        assert ran.code == 0
        assert ran.out.splitlines()[-2:] == ["2 of 2 commits are verified", "1 of 2 are signed"]

    def test_with_a_list_every_later_commit_must_be_signed(
        self, demandops: Run, book: Run, state: Any, key: Path, tmp_path: Path
    ) -> None:
        first = state.tip
        book("before")
        state.commit({SIGNERS: listed(key)}, "Only signed commits\n")
        book("good", "--signing-key", key)
        good = state.tip
        assert self.rows(demandops, state, first, 0)[-1]["signer"] == "generator@example.org"
        book("unsigned")
        unsigned = state.tip
        book("another", "--signing-key", keygen(tmp_path / "another"))
        ran = demandops("verify", f"{first}..main", "--state-repo", state.path)
        assert ran.code == 1
        assert f"{unsigned[:10]} UNSIGNED  Join unsigned" in ran.out.splitlines()
        rows = {row["commit"]: row for row in self.rows(demandops, state, first, 1)}
        assert rows[good]["holds"]
        assert rows[unsigned]["signature"] == (
            "is not signed, but policy/allowed-signers requires a signature"
        )
        assert rows[state.tip]["signature"] == (
            "is signed, but not by a key that policy/allowed-signers lists"
        )
        assert [row["holds"] for row in rows.values()] == [True, True, True, False, False]

    def test_a_commit_cannot_vouch_for_itself(
        self, demandops: Run, book: Run, state: Any, key: Path, tmp_path: Path
    ) -> None:
        state.commit({SIGNERS: listed(key)})
        since = state.tip
        forged = "Forged\n\nOperation: join\nRender-Version: 2\n"
        state.commit({SIGNERS: listed(keygen(tmp_path / "forger"))}, forged, FORGER)
        (row,) = self.rows(demandops, state, since, 1)
        assert row["touched"] == [SIGNERS]
        assert row["signature"] == "is not signed, but policy/allowed-signers requires a signature"

    def test_a_signature_of_another_commit_does_not_hold(
        self, demandops: Run, book: Run, state: Any, key: Path
    ) -> None:
        import pygit2

        state.commit({SIGNERS: listed(key)})
        since = state.tip
        book("a", "--signing-key", key)
        repo = pygit2.Repository(str(state.path))
        signed = repo[state.tip].peel(pygit2.Commit)
        signature, content = signed.gpg_signature
        assert signature and content
        text = content.decode().replace("in the name of vehicle00", "in the name of vehicle01")
        assert text != content.decode()
        made = repo.create_commit_with_signature(text, signature.decode(), "gpgsig")
        repo.references["refs/heads/main"].set_target(made)
        (row,) = self.rows(demandops, state, since, 1)
        assert row["signature"] == "has a signature that does not match its content"
        # git, unlike libgit2, would check the signed commit in place of the forged one
        git(state.path, "update-ref", f"refs/replace/{made}", str(signed.id))
        (row,) = self.rows(demandops, state, since, 1)
        assert row["signature"] == "has a signature that does not match its content"

    def test_a_missing_ssh_keygen_is_told(
        self,
        demandops: Run,
        book: Run,
        state: Any,
        key: Path,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        state.commit({SIGNERS: listed(key)})
        book("a", "--signing-key", key)
        monkeypatch.setattr(signing, "_good", {})
        found = shutil.which("git")
        assert found
        (tmp_path / "bin").mkdir()
        (tmp_path / "bin" / "git").symlink_to(found)
        monkeypatch.setenv("PATH", str(tmp_path / "bin"))
        ran = demandops("verify", "--state-repo", state.path)
        assert (ran.code, ran.err) == (
            1,
            "error: ssh-keygen, which checks the signatures of commits, is missing; install it "
            "(Debian: apt-get install openssh-client)\n",
        )

    @pytest.mark.parametrize("separator", ["\u2028", "\u0085", "\x0b", "\x1c"])
    def test_a_signer_whose_name_has_an_odd_character_stops_no_verification(
        self, demandops: Run, book: Run, state: Any, key: Path, separator: str
    ) -> None:
        state.commit({SIGNERS: listed(key).replace("@", f"{separator}@")})
        since = state.tip
        book("a", "--signing-key", key)
        book("b", "--signing-key", key)
        assert [row["holds"] for row in self.rows(demandops, state, since, 0)] == [True, True]

    def test_keys_may_change(
        self, demandops: Run, book: Run, state: Any, key: Path, tmp_path: Path
    ) -> None:
        """For each commit, `verify` uses the list of keys that was in effect before it."""
        new = keygen(tmp_path / "new")
        since = state.tip
        state.commit({SIGNERS: listed(key)})
        book("a", "--signing-key", key)
        state.commit({SIGNERS: listed(new)})
        book("b", "--signing-key", new)
        assert all(row["holds"] for row in self.rows(demandops, state, since, 0))
        book("c", "--signing-key", key)
        assert not self.rows(demandops, state, since, 1)[-1]["holds"]
