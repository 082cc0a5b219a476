"""Which addresses of a state repo are URLs, and which are refused; no message shows a secret."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pygit2
import pytest
from demandops.base.addresses import without_secrets
from demandops.base.errors import StateRepoError
from demandops.repo.git.remote_repository import connect, is_url
from demandops.repo.git.repository import RemoteAway

from tests.kit import plain_yaml
from tests.kit.repo import git

ADDRESSES = plain_yaml.beside(__file__, "addresses")
TOKENS = [  # each as the user's name; the sixth is one of Gitea, the last of Azure DevOps
    f"ghp_{'secret1' * 5}@github.com",
    f"github_pat_{'secret1' * 9}@github.com",
    "glpat-secret@gitlab.com",
    "glptt-secret@gitlab.com",
    "ATBBsecret@bitbucket.org",
    f"{'5ec4e7' * 7}@git.example.org",
    f"{'secret1' * 8}@dev.azure.com",
]
REFUSED = [(one, told) for told, every in ADDRESSES["refused"].items() for one in every]
REFUSED += [(f"https://{one}/team/state.git", "holds a password or token") for one in TOKENS]
REFUSED += [("a" * 5000, f"'{'a' * 79}…' cannot be opened: File name too long")]


@pytest.mark.parametrize("address", [*ADDRESSES["urls"], *ADDRESSES["folders"]])
def test_a_url_is_what_git_clones_over_a_network(address: str) -> None:
    assert is_url(address) is (address in ADDRESSES["urls"])


def test_a_folder_that_exists_wins_over_what_its_name_looks_like(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert is_url("host:path")
    (tmp_path / "host:path").mkdir()
    assert not is_url("host:path")


@pytest.mark.parametrize(("address", "told"), REFUSED)
def test_an_address_is_refused_before_anything_is_made_and_no_secret_repeated(
    tmp_path: Path, address: str, told: str
) -> None:
    with pytest.raises(StateRepoError) as error:
        connect(address, tmp_path / "data")
    assert told in str(error.value)
    assert "cret" not in str(error.value)
    assert not told or not (tmp_path / "data").exists()


@pytest.mark.parametrize(("text", "wanted"), ADDRESSES["shown"].items())
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


def test_it_costs_a_fetch_to_look_at_a_url(tmp_path: Path) -> None:
    source = _with_main(tmp_path / "state.git")
    assert connect(str(source), tmp_path / "data").on_this_disk
    assert not connect(source.as_uri(), tmp_path / "data").on_this_disk
    git(source, "config", "core.sharedRepository", "group")  # so its clone is pushed
    pushed = connect(str(source), tmp_path / "of-a-folder")
    assert (pushed.always_current, pushed.on_this_disk) == (False, True)


def test_what_a_remote_has_confirmed_is_not_written_to_the_clone_again(tmp_path: Path) -> None:
    repository = connect(_with_main(tmp_path / "state.git").as_uri(), tmp_path / "data")
    repository.write_anew("")
    # a `main` of the clone's own would soon be outdated, and people may write `main`
    assert [*repository.reopened().references] == ["refs/remotes/origin/main"]


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
    configs = [pygit2.Config(str(path)) for path in (tmp_path / "data").rglob("config")]
    assert not any("core.sshCommand" in config for config in configs)


Make = Callable[[Path], object]
NO_REPO: dict[str, Make] = {
    "does not exist; correct the path, or make a state repo there with `demandops init {} --bare`":
        lambda path: None,
    "is not a Git repository; name another folder, or make one in a new folder":
        lambda path: (path / "mine").mkdir(parents=True),
    "is not a folder; name the folder of a state repo": Path.touch,
    "has no branch 'main'; ": lambda path: pygit2.init_repository(str(path), bare=True),
    "has 'main' checked out, so its files would become outdated; use a bare clone: "
    "git clone --bare {0} {0}.git": lambda path: _with_main(path, bare=False),
}  # fmt: skip


@pytest.mark.parametrize(("told", "make"), NO_REPO.items())
def test_what_is_no_state_repo_is_told_with_a_remedy_that_works(
    tmp_path: Path, make: Make, told: str
) -> None:
    make(tmp_path / "state")
    with pytest.raises(StateRepoError) as error:
        connect(str(tmp_path / "state"), tmp_path / "data")
    assert str(error.value).startswith(f"{tmp_path / 'state'} {told.format(tmp_path / 'state')}")


def test_a_remote_without_main_is_told(tmp_path: Path) -> None:
    pygit2.init_repository(str(tmp_path / "empty.git"), bare=True)
    with pytest.raises(StateRepoError, match="has no branch 'main'"):
        connect((tmp_path / "empty.git").as_uri(), tmp_path / "data")


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
    second = git(made, "commit-tree", "-pmain", "main^{tree}", "-mx")
    git(made, "update-ref", "refs/heads/main", second)
    git(tmp_path, "clone", "--quiet", "--bare", option, made.as_uri(), "part.git")
    with pytest.raises(StateRepoError, match="lacks a part of the history or of the files"):
        connect(str(tmp_path / "part.git"), tmp_path / "data")


def _with_main(path: Path, *, bare: bool = True) -> Path:
    repo = pygit2.init_repository(str(path), bare=bare, initial_head="main")
    who = pygit2.Signature("x", "x@example.org", 0, 0)
    repo.create_commit("refs/heads/main", who, who, "x", repo.TreeBuilder().write(), [])
    return path
