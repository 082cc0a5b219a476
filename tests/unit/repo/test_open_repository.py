"""Which addresses of a state repo are URLs, and which are refused; no message shows a secret."""

from __future__ import annotations

from pathlib import Path

import pygit2
import pytest
from demandops.base.errors import StateRepoError
from demandops.repo.git.local_repository import connect, is_url
from demandops.repo.git.remote_repository import without_secrets
from demandops.repo.git.repository import RemoteAway

from tests.kit.repo import git

URLS = [
    "https://example.org/state.git",
    "http://127.0.0.1:8080/state.git",
    "ssh://git@example.org:2222/state.git",
    "git://example.org/state.git",
    "file:///srv/state.git",
    "git+ssh://git@example.org/state.git",
    "git@example.org:team/state.git",
    "git@example.org:/srv/state.git",
    "user.name@host-1:state.git",
    "example.org:team/state.git",
    "example.org:/srv/state.git",
    "git@[::1]:state.git",
]
FOLDERS = [
    "state.git",
    "./state.git",
    "../state.git",
    "/srv/state.git",
    "~/state.git",
    "folder/with@sign:and/colon",
    "./host:path",
    "a b/state.git",
    "",
]


@pytest.mark.parametrize("address", [*URLS, *FOLDERS])
def test_a_url_is_what_git_clones_over_a_network(address: str) -> None:
    assert is_url(address) is (address in URLS)


def test_a_folder_that_exists_wins_over_what_its_name_looks_like(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert is_url("host:path")
    (tmp_path / "host:path").mkdir()
    assert not is_url("host:path")


NO_HOST = "the state repo's address names no host after"
HIDDEN = (
    "the state repo's address holds a password or token, which process lists would show; "
    "remove it and use a credential helper, ~/.netrc or an SSH key"
)
SCHEME = "a state repo's address cannot start with '{}'; use https, ssh, git or file"


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("ext://sh", SCHEME.format("ext://")),
        ("ftp://example.org/state.git", SCHEME.format("ftp://")),
        ("javascript://x", SCHEME.format("javascript://")),
        ("s3://bucket/state.git", SCHEME.format("s3://")),
        ("https://user:secret@example.org/state.git", HIDDEN),
        ("https://:secret@example.org/state.git", HIDDEN),
        ("https://user:sec@ret@example.org/state.git", HIDDEN),
        ("http://user:secret@127.0.0.1/state.git", HIDDEN),
        ("ssh://git:secret@example.org/state.git", HIDDEN),
        # a token as the user's name; the sixth is one of Gitea, the last of Azure DevOps
        (f"https://ghp_{'secret1' * 5}@github.com/team/state.git", HIDDEN),
        (f"https://github_pat_{'secret1' * 9}@github.com/team/state.git", HIDDEN),
        ("https://glpat-secret@gitlab.com/team/state.git", HIDDEN),
        ("https://glptt-secret@gitlab.com/team/state.git", HIDDEN),
        ("https://ATBBsecret@bitbucket.org/team/state.git", HIDDEN),
        (f"https://{'5ec4e7' * 7}@git.example.org/team/state.git", HIDDEN),
        (f"https://{'secret1' * 8}@dev.azure.com/team/project/_git/state", HIDDEN),
        # remote helpers that run commands
        ("ext::sh -c touch% evil", "a state repo's address cannot start with"),
        ("ext::sh -c touch% evil% ://", "a state repo's address cannot start with"),
        ("testgit::x:y", "a state repo's address cannot start with"),
        # without a host: git would take the first part of the path as the host
        ("https://", f"{NO_HOST} 'https://'; write https://HOST/PATH, or"),
        ("https:///x", f"{NO_HOST} 'https://'; write https://HOST/PATH, or"),
        ("ssh:///x", f"{NO_HOST} 'ssh://'; write ssh://HOST/PATH, or"),
        ("ssh://git@/x", f"{NO_HOST} 'ssh://'; write ssh://HOST/PATH, or"),
        ("http://:80/x", f"{NO_HOST} 'http://'; write http://HOST/PATH, or"),
        # addresses that look like an option or are mistyped
        ("-oProxyCommand=touch@x:y", ""),
        ("--upload-pack=touch@x:y", ""),
        ("-x:y", ""),
        # names that no folder can have
        ("a" * 5000, f"'{'a' * 79}…' cannot be opened: File name too long"),
        ("~nobody-of-that-name/x", "'~nobody-of-that-name/x' cannot be opened: Could not"),
        ("~\0/x", "'~\\x00/x' cannot be opened: embedded null byte"),
        ("HTTPS://user:secret@example.org/x.git", ""),
        ("https://user:se/cret@example.org/x.git", ""),
    ],
)
def test_an_address_is_refused_before_anything_is_made_and_no_secret_repeated(
    tmp_path: Path, address: str, message: str
) -> None:
    with pytest.raises(StateRepoError) as error:
        connect(address, tmp_path / "data")
    assert str(error.value).startswith(message)
    assert "cret" not in str(error.value)
    assert not message or not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("https://user:secret@example.org/x", "https://example.org/x"),
        ("https://token@example.org/x", "https://example.org/x"),
        ("https://user:sec@ret@example.org/x", "https://example.org/x"),
        ("https://example.org/a@b", "https://example.org/a@b"),
        (
            "fatal: unable to access 'https://token@example.org/x/': 403",
            "fatal: unable to access 'https://example.org/x/': 403",
        ),
        ("https://a@one.org and https://b:c@two.org", "https://one.org and https://two.org"),
        ("git@example.org:x", "git@example.org:x"),
    ],
)
def test_secrets_are_taken_out_of_whatever_is_shown(text: str, wanted: str) -> None:
    assert without_secrets(text) == wanted


@pytest.mark.parametrize(
    "name", ["git", "x-access-token", "petra.platform", "team-of-2026-with-quite-a-long-name"]
)
def test_a_name_in_an_address_is_accepted_and_not_shown(tmp_path: Path, name: str) -> None:
    with pytest.raises(RemoteAway) as error:
        connect(f"http://{name}@127.0.0.1:9/state.git", tmp_path / "data")
    assert f"{name}@" not in str(error.value)
    assert str(error.value).startswith("http://127.0.0.1:9/state.git cannot be fetched: ")


def test_the_clone_keeps_its_address_for_its_owner_alone(tmp_path: Path) -> None:
    source = _with_main(tmp_path / "state.git")
    connect(source.as_uri(), tmp_path / "data")
    config = tmp_path / "data" / "clone.git" / "config"
    assert source.as_uri() in config.read_text()
    assert config.stat().st_mode & 0o077 == 0


def test_a_line_break_in_an_address_sets_nothing_in_the_clones_configuration(
    tmp_path: Path,
) -> None:
    source = _with_main(tmp_path / "state.git")
    address = f"{source.as_uri()}\n[core]\n\tsshCommand = touch evil"
    with pytest.raises((StateRepoError, ValueError)):
        connect(address, tmp_path / "data")
    configs = [path.read_text() for path in (tmp_path / "data").rglob("config")]
    assert not any("sshCommand" in line for text in configs for line in text.splitlines()[1:])


def test_a_folder_that_is_not_there_is_told_with_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(StateRepoError) as error:
        connect(str(tmp_path / "nothing.git"), tmp_path / "data")
    assert str(error.value) == (
        f"{tmp_path}/nothing.git does not exist; correct the path, or make a state repo there "
        f"with `demandops init {tmp_path}/nothing.git --bare`"
    )


def test_a_folder_that_is_no_repository_is_told_with_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(StateRepoError) as error:
        connect(str(tmp_path), tmp_path / "data")
    assert str(error.value) == (
        f"{tmp_path} is not a Git repository; make one with `demandops init {tmp_path} --bare`"
    )


def test_a_folder_in_which_no_state_repo_can_be_made_is_told_with_a_remedy_that_works(
    tmp_path: Path,
) -> None:
    (tmp_path / "mine").write_text("precious")
    with pytest.raises(StateRepoError) as error:
        connect(str(tmp_path), tmp_path / "data")
    assert str(error.value) == (
        f"{tmp_path} is not a Git repository; name another folder, or make one in a new folder "
        "with `demandops init DIR --bare`"
    )


def test_a_file_is_not_told_to_be_missing(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("precious")
    with pytest.raises(StateRepoError) as error:
        connect(str(tmp_path / "file"), tmp_path / "data")
    assert str(error.value) == (f"{tmp_path}/file is not a folder; name the folder of a state repo")


def test_a_repository_without_main_is_told_with_the_remedy(tmp_path: Path) -> None:
    empty = tmp_path / "empty.git"
    pygit2.init_repository(str(empty), bare=True)
    for address in (str(empty), empty.as_uri()):
        with pytest.raises(StateRepoError) as error:
            connect(address, tmp_path / "data")
        assert str(error.value) == (
            f"{address} has no branch 'main'; if it was renamed or deleted, restore it; if there "
            "is no state repo yet, push one made by `demandops init DIR`"
        )


def test_a_main_that_is_another_name_of_a_branch_is_told_with_the_remedy(tmp_path: Path) -> None:
    made = _with_main(tmp_path / "made.git")
    git(made, "branch", "--move", "main", "trunk")
    git(made, "symbolic-ref", "refs/heads/main", "refs/heads/trunk")
    with pytest.raises(StateRepoError, match="is only another name of refs/heads/trunk") as error:
        connect(str(made), tmp_path / "data")
    git(made, *str(error.value).partition(f"git -C {made} ")[2].split())
    connect(str(made), tmp_path / "data")


@pytest.mark.parametrize("option", ["--depth=1", "--filter=blob:none"])
def test_a_clone_that_lacks_a_part_is_refused(tmp_path: Path, option: str) -> None:
    made = _with_main(tmp_path / "made.git")
    git(made, "config", "uploadpack.allowFilter", "true")
    git(
        made,
        "update-ref",
        "refs/heads/main",
        git(made, "commit-tree", "-pmain", "main^{tree}", "-mx"),
    )
    git(tmp_path, "clone", "--quiet", "--bare", option, made.as_uri(), "part.git")
    with pytest.raises(StateRepoError, match="lacks a part of the history or of the files"):
        connect(str(tmp_path / "part.git"), tmp_path / "data")


def test_a_checked_out_main_is_refused_with_the_remedy(tmp_path: Path) -> None:
    work = tmp_path / "work"
    _with_main(work, bare=False)
    with pytest.raises(StateRepoError) as error:
        connect(str(work), tmp_path / "data")
    assert str(error.value) == (
        f"{work} has 'main' checked out, so its files would become outdated; use a bare "
        f"clone: git clone --bare {work} {work}.git"
    )


def _with_main(path: Path, *, bare: bool = True) -> Path:
    repo = pygit2.init_repository(str(path), bare=bare, initial_head="main")
    who = pygit2.Signature("x", "x@example.org", 0, 0)
    repo.create_commit("refs/heads/main", who, who, "x", repo.TreeBuilder().write(), [])
    return path
