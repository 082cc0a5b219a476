"""What commands do and say, told step by step in ``stories/*.yaml``.

A file has `names` (``$name`` stands for a text in its stories) and `stories`. A story starts from
a state repo in which the demands of `starts` are booked. Its steps have the form of :class:`Step`.
"""

from __future__ import annotations

import json
import shlex
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from string import Template
from typing import Any

import pytest
import yaml
from demandops.cli.main import run
from demandops.model.config.base_model import FrozenModel
from pydantic import Field

from tests.kit import plain_yaml
from tests.kit.cli import Run
from tests.kit.goals import EXPERIMENT
from tests.kit.repo import GIT_ENVIRONMENT, GitRepo, branches, git, keygen, root

Edits = Mapping[str, str | dict[str, str] | None]
"""Paths and their new texts: a whole text, old and new parts of it, or None to remove the file."""

_NAMED_BY_FOLDER = ("check", "config", "init", "new", "schema")


class Step(FrozenModel):
    """What people change, and then a command and what it must do."""

    sends: list[Any] = Field(default_factory=list)
    """Goals, or numbers of the experiment's demands, which must be booked."""
    commits: Edits = Field(default_factory=dict)
    """What a person commits to main."""
    edits: Edits = Field(default_factory=dict)
    """What a person edits in the clone ``$clone``, which the first use makes."""
    git: list[str] = Field(default_factory=list)
    """Commands of git in the clone."""
    links: dict[str, str] = Field(default_factory=dict)
    """Links in the clone, by path; each replaces what is there."""
    notes: dict[str, str] = Field(default_factory=dict)
    """More names for the later steps, such as `seen: $head`."""
    run: str = ""
    """The command. Those that take a state repo get ``--state-repo $repo``, unless `inside` says in
    which folder of the clone, or `environment` with which variables, the command runs.
    """
    environment: dict[str, str] = Field(default_factory=dict)
    given: list[Any] = Field(default_factory=list)
    """Goals that the command reads from its standard input."""
    inside: str = ""
    exit: int = 0
    writes: bool | None = None
    """Whether the command changes main. One that fails must not, unless its story says so."""
    gives: dict[str, Any] = Field(default_factory=dict)
    """Parts of the command's JSON by path: ``items.0.name``, ``items.patrol.state`` for the item
    with this name, or ``items.*.name`` for the names of all.
    """
    prints: list[str] = Field(default_factory=list)
    """Parts of the standard output. A command that fails prints nothing else."""
    tells: list[str] = Field(default_factory=list)
    """Parts of the errors and warnings; without any, the command must have none."""
    leaves: dict[str, str | None] = Field(default_factory=dict)
    """A part of the text of each of these files on main afterwards; None if it must not exist."""
    hides: list[str] = Field(default_factory=list)
    """What the command must not print."""


def _files() -> Iterator[tuple[str, dict[str, Any], dict[str, str]]]:
    for path in sorted(Path(__file__).parent.glob("stories/*.yaml")):
        data = plain_yaml.load(path.read_text())
        for name, story in data["stories"].items():
            yield f"{path.stem}: {name}", story, data.get("names", {})


STORIES = {name: (story, names) for name, story, names in _files()}


@pytest.fixture(scope="session")
def started(
    bare_template: Path, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[list[Any]], Path]:
    """Return a function that returns a state repo, not to be changed, with these demands."""
    made: dict[str, Path] = {}

    def start(demands: list[Any]) -> Path:
        key = json.dumps(demands)
        if key not in made:
            made[key] = tmp_path_factory.mktemp("started") / "state.git"
            shutil.copytree(bare_template, made[key])
            send(made[key], demands)
            git(made[key], "repack", "-adq")
        return made[key]

    return start


def send(repo: Path, demands: list[Any]) -> None:
    files = [EXPERIMENT[one - 1] for one in demands if isinstance(one, int)]
    if goals := [one for one in demands if not isinstance(one, int)]:
        files.append(repo.with_suffix(".yaml"))
        files[-1].write_text(yaml.safe_dump_all(goals))
    assert not files or run(["request", *map(str, files), "--state-repo", str(repo)]) == 0


class Teller:
    """Takes the steps of a story."""

    def __init__(self, folder: Path, demandops: Run, names: dict[str, str]) -> None:
        self._folder, self._run, self._names = folder, demandops, names
        self.repo = GitRepo(folder / "state.git")
        self.clone = folder / "clone"

    def take(self, told: Any, patch: pytest.MonkeyPatch) -> None:
        repo = self.repo.path
        words = {"repo": str(repo), "url": repo.as_uri(), "first": root(repo)}
        words["branch"] = next(iter(branches(repo, "demand/", "override/")), "main")  # a proposal's
        words["head"] = git(repo, "rev-parse", words["branch"])
        words |= {"tip": self.repo.tip, "clone": str(self.clone), "folder": str(self._folder)}
        words |= self._keys(str(told))
        names = {name: _filled(text, words) for name, text in self._names.items()}
        step = Step.model_validate(_filled(told, words | names))
        self._names = self._names | step.notes
        send(repo, step.sends)
        if step.commits:
            texts = self.repo.files()
            changed = {path: _new(texts.get(path), each) for path, each in step.commits.items()}
            self.repo.commit(changed)
        uses_clone = step.edits or step.git or step.inside or words["clone"] in step.run
        if uses_clone and not self.clone.exists():
            git(self._folder, "clone", "--quiet", str(repo), str(self.clone))
        for path, each in step.edits.items():
            file = self.clone / path
            new = _new(file.read_text() if file.exists() else None, each)
            file.parent.mkdir(parents=True, exist_ok=True)
            _ = file.unlink() if new is None else file.write_text(new)
        for command in step.git:
            git(self.clone, *shlex.split(command))
        for path, target in step.links.items():
            link = self.clone / path
            _ = shutil.rmtree(link) if link.is_dir() else link.unlink(missing_ok=True)
            link.symlink_to(target)
        with patch.context() as own:
            if step.inside:
                own.chdir(self.clone / step.inside)
            for variable, value in step.environment.items():
                own.setenv(variable, value)
            if step.run:
                self._check(step)

    def _keys(self, told: str) -> dict[str, str]:
        """Return the SSH keys that a step or its names use, which the first use makes."""
        words = {}
        for name in ("key", "other"):
            file = self._folder / name
            if f"${name}" in told and not file.exists():
                keygen(file)
            if file.exists():
                public = file.with_suffix(".pub").read_text()
                words |= {name: str(file), f"{name}_public": public}
        return words

    def _check(self, step: Step) -> None:
        args, before = shlex.split(step.run), self.repo.tip
        named = step.inside or step.environment or "--state-repo" in args
        if not named and args[0] not in _NAMED_BY_FOLDER:
            args += ["--state-repo", str(self.repo.path)]
        if step.gives:
            args += ["--output", "json"]
        ran = self._run(*args, stdin=yaml.safe_dump_all(step.given, sort_keys=False))
        assert ran.code == step.exit, (step.run, ran)
        for part in step.prints:
            assert part in ran.out, (step.run, part, ran.out)
        for part in step.tells:
            assert part in ran.err, (step.run, part, ran.err)
        for part in step.hides:
            assert part not in ran.out + ran.err, (step.run, part)
        assert step.tells or not ran.err, (step.run, ran.err)
        assert not step.exit or step.prints or step.gives or not ran.out, (step.run, ran.out)
        for path, wanted in step.gives.items():
            found = _at(ran.json(), path.split(".") if path else [])
            assert _fits(wanted, found), (step.run, path, found)
        files = self.repo.files() if step.leaves else {}
        for path, part in step.leaves.items():
            text = files.get(path)
            assert part in (text or "") if part else text is None, (step.run, path, text)
        writes = False if step.exit and step.writes is None else step.writes
        assert writes in (None, self.repo.tip != before), step.run


def _filled(told: Any, words: Mapping[str, str]) -> Any:
    if isinstance(told, str):
        return Template(told).safe_substitute(words)
    if isinstance(told, list):
        return [_filled(each, words) for each in told]
    if isinstance(told, dict):
        return {_filled(key, words): _filled(each, words) for key, each in told.items()}
    return told


def _new(text: str | None, change: str | dict[str, str] | None) -> str | None:
    if not isinstance(change, dict):
        return change
    for old, new in change.items():
        assert text and old in text, old
        text = text.replace(old, new)
    return text


def _at(data: Any, path: list[str]) -> Any:
    for place, key in enumerate(path):
        if key == "*":
            return [_at(each, path[place + 1 :]) for each in data]
        if isinstance(data, list) and not key.lstrip("-").isdigit():
            (data,) = (each for each in data if each["name"] == key)
        else:
            data = data[int(key)] if isinstance(data, list) else data[key]
    return data


def _fits(wanted: Any, found: Any) -> bool:
    """Return whether all that is wanted was found; of a mapping, other keys do not matter."""
    if isinstance(wanted, dict) and isinstance(found, dict):
        return all(key in found and _fits(each, found[key]) for key, each in wanted.items())
    return bool(wanted == found)


@pytest.mark.parametrize("name", STORIES)
def test_commands_do_and_say_what_their_story_tells(
    name: str,
    tmp_path: Path,
    started: Callable[[list[Any]], Path],
    demandops: Run,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    story, names = STORIES[name]
    for variable, value in GIT_ENVIRONMENT.items():
        monkeypatch.setenv(variable, value)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    shutil.copytree(started(story.get("starts", [])), tmp_path / "state.git")
    teller = Teller(tmp_path, demandops, names)
    for step in story["steps"]:
        teller.take(step, monkeypatch)
