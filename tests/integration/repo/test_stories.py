"""Stories of generators and a person at one state repo, as the files in `stories/` tell them.

A story is a list of steps, each with one word of :class:`Story`. Demands are ``join 1``,
``leave 1``, ``put d 1``, ``release d`` or a whole goal; a further number is that of the vehicle.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.decide.state import rendered_files
from demandops.model.demand import goals as demand_goals
from demandops.repo.merge_check import merge_check
from demandops.serve.generator import Generator

from tests.kit import config, goals, plain_yaml, rig
from tests.kit.clock import Clock
from tests.kit.repo import GitRepo, Person, branches, read, state_of
from tests.kit.rig import Proposed

STORIES: dict[str, list[dict[str, Any]]] = {
    f"{path.stem}: {title}": steps
    for path in sorted(Path(__file__).with_name("stories").glob("*.yaml"))
    for title, steps in plain_yaml.load(path.read_text()).items()
}
HOOKS = {
    "deletes no branch": 'case "$1 $3" in refs/heads/demand/*\\ 00000000*) exit 1;; esac',
    "takes no branch": 'case "$1" in refs/heads/demand/*) exit 1;; esac',
    "takes nothing": "echo 'main is frozen until Monday' >&2; exit 1",
}


def demand(told: str | rig.Goal) -> rig.Goal:
    if not isinstance(told, str):
        return told
    kind, *more = told.split()
    if kind == "impossible":
        return rig.impossible()
    if kind in ("join", "leave"):
        number, *vehicle = map(int, more)
        return rig.goal(number, vehicle=(vehicle or [None])[0], shutdown=kind == "leave")
    if kind == "put":
        vehicle = f"vehicle{int(more[1]):02}"
        return goals.put(more[0], "user", topic=(f"/vehicles/{vehicle}/ego_data", vehicle))
    if kind == "release":
        head = {"kind": "Demand", "demand": more[0], "requesters": ["user"]}
        return head | {"operation": "release"}
    raise ValueError(told)


class Story:
    """Each public method is a word that a step may have."""

    def __init__(
        self, bare: Path, person: Person, data: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        self._bare, self._person, self._data, self._log = bare, person, data, caplog
        self._clock = Clock()
        self._options: dict[str, Any] = {
            "runtime": self._clock,
            "fetch_interval": 0.1,
            "refusal_patience_s": 0.5,
        }
        self._open = ExitStack()
        self._running: dict[str, ExitStack] = {}
        self._generators: dict[str, Generator] = {}
        self._sent: dict[str, Proposed] = {}
        self._noted: dict[str, str] = {}
        self._before: dict[str, str | None] = {}

    def tell(self, steps: Iterable[Mapping[str, Any]]) -> None:
        for step in steps:
            for word, what in step.items():
                getattr(self, word)(what)

    def _revision(self, name: str) -> str:
        at = self._sent[name].branch if name in self._sent else name
        return rig.git(self._bare, "rev-parse", at)

    # ---- generators ----

    def start(self, name: str) -> None:
        """Start a generator that uses a clone, or the repo itself if it is called `local`."""
        address = self._bare if name == "local" else self._bare.as_uri()
        self._running[name] = self._open.enter_context(ExitStack())
        made = rig.running(address, data=self._data / name, **self._options)
        self._generators[name] = self._running[name].enter_context(made)

    def looks(self, at: str) -> None:
        """Let generators that use a clone look at the state repo only for demands."""
        assert at == "for demands"
        del self._options["fetch_interval"]

    def stop(self, name: str) -> None:
        del self._generators[name]
        self._running.pop(name).close()

    def restart(self, name: str) -> None:
        """Start and stop a generator; meanwhile it publishes all that is in its journal."""
        self.start(name)
        assert self._generators[name].close(rig.PATIENCE_S) is True
        self.stop(name)

    def by(self, name: str) -> None:
        """Let this generator do the next steps; otherwise the one that was started last does."""
        self._generators[name] = self._generators.pop(name)

    @property
    def _generator(self) -> Generator:
        return [*self._generators.values()][-1]

    def away(self, steps: list[dict[str, Any]]) -> None:
        """Tell these steps while nobody finds the state repo."""
        with rig.away(self._bare):
            self.tell(steps)

    def passes(self, seconds: float) -> None:
        self._clock.pass_(seconds)

    # ---- demands ----

    def book(self, demands: list[Any]) -> None:
        rig.book(self._generator, *map(demand, demands))

    def send(self, demands: Mapping[str, Any]) -> None:
        for name, told in demands.items():
            self._sent[name] = Proposed(self._generator, demand(told), f"op-{name}")

    def roll_back(self, what: Mapping[str, Any]) -> None:
        """Send a rollback ``to`` a commit that was noted."""
        who, to = ("A", "a@example.org"), self._noted[what["to"]]
        goal = demand_goals.rollback(to, drop_newer=what["drop_newer"], reason="x", who=who)
        assert rig.outcome(self._generator.submit(goal)) == what["gives"]

    def propose(self, demands: Mapping[str, Any]) -> None:
        for name, made in demands.items():
            self.send({name: made})
            assert self._sent[name].branch

    def while_busy(self, steps: list[dict[str, Any]]) -> None:
        """Keep the worker busy, with a demand of somebody else, until these steps are told."""
        with rig.busy(self._generator, goals.put("busy", "user9"), "op-busy"):
            self.tell(steps)

    def withdraw(self, name: str) -> None:
        assert self._generator.withdraw(f"op-{name}") is True

    def answers(self, outcomes: Mapping[str, str | None]) -> None:
        for name, outcome in outcomes.items():
            if outcome is None:
                assert not self._sent[name].ticket.future.done(), name
            else:
                assert self._sent[name].outcome() == outcome, name

    def tells(self, words: Mapping[str, str]) -> None:
        """Check words of a demand's error or warnings."""
        for name, word in words.items():
            future = self._sent[name].ticket.future
            error = future.exception(rig.PATIENCE_S)
            assert word in (f"{error}" if error else " ".join(future.result().warnings)), name

    # ---- the person ----

    def approval(self, what: str) -> None:
        self._person.policy(approval=what)

    def merge(self, name: str) -> None:
        self._person.merge(self._sent[name].branch, "-X", "theirs", "-m", "Merge")

    def rebase(self, name: str) -> None:
        self._person.rebase(self._sent[name].branch, "-X", "theirs")

    def squash(self, name: str) -> None:
        self._person.squash(self._sent[name].branch, "Without trailers")

    def squash_with_trailers(self, name: str) -> None:
        text = rig.git(self._bare, "log", "-1", "--format=%B", self._sent[name].branch)
        self._person.squash(self._sent[name].branch, f"Squashed\n\n{text}")

    def delete(self, name: str) -> None:
        self._person.delete(self._sent[name].branch)

    def change(self, files: Mapping[str, Any]) -> None:
        """Commit files: a text, data, nothing, or ``[old, new]`` to replace a text."""
        texts = dict(files)
        self._before = {path: read(self._bare, path) or None for path in files}
        for path, new in files.items():
            if isinstance(new, list):
                before = self._person.read(path)
                assert new[0] in before, path
                texts[path] = before.replace(*new)
            elif isinstance(new, dict):
                texts[path] = yaml.safe_dump(new)
        self._person.change(texts)

    def undo(self, last: str) -> None:
        """Undo the last change."""
        assert last == "change"
        self.change(self._before)

    def override(self, overrides: Mapping[str, Any]) -> None:
        head = plain_yaml.load(config.override())
        files = {f"overrides/{n}.yaml": fields and head | fields for n, fields in overrides.items()}
        self.change(files)

    def edit_claim(self, texts: Mapping[str, Any]) -> None:
        """Change the application's claim file that holds a word."""
        for word, text in texts.items():
            (path,) = [p for p in rig.claims(self._bare, word) if "applications" in p]
            self.change({path: text})

    def delete_claims(self, word: str) -> None:
        self.change(dict.fromkeys(rig.claims(self._bare, word)))

    def reset(self, name: str) -> None:
        """Set main to a commit that was noted."""
        rig.git(self._bare, "update-ref", "refs/heads/main", self._noted[name])

    def server(self, does: str | None) -> None:
        hook = self._bare / "hooks" / "update"
        hook.unlink(missing_ok=True)
        if does:
            rig.hook(self._bare, "update", HOOKS[does])

    # ---- what must be then ----

    def waits_until(self, checks: Mapping[str, Any]) -> None:
        for word, what in checks.items():
            rig.wait_until(lambda: self._is(word, what), f"{word}: {what}")  # noqa: B023

    def _is(self, word: str, what: Any) -> bool:
        try:
            getattr(self, word)(what)
        except AssertionError:
            return False
        return True

    def branches(self, names: list[str]) -> None:
        assert branches(self._bare) == sorted(self._sent[name].branch for name in names)

    def note(self, name: str) -> None:
        """Note the head of a proposal's branch, or another revision like ``main:clusters``."""
        self._noted[name] = self._revision(name)

    def stands(self, name: str) -> None:
        assert self._revision(name) == self._noted[name]

    def moved(self, name: str) -> None:
        assert self._revision(name) != self._noted[name]

    def books(self, demands: list[str]) -> None:
        assert rig.books(self._bare) == rig.books_after(map(demand, demands))

    def claims(self, counts: Mapping[str, int]) -> None:
        assert {word: len(rig.claims(self._bare, word)) for word in counts} == counts

    def services(self, nodes: Mapping[str, str]) -> None:
        found = rig.books(self._bare)["services"]
        assert {name: entry["node"] for name, entry in found.items()} == nodes

    def suspended(self, ids: list[str]) -> None:
        assert [entry["id"] for entry in rig.books(self._bare).get("suspended", ())] == ids

    def anywhere(self, texts: Mapping[str, bool]) -> None:
        """Check which texts are in files or names of files below clusters/ and ledger/."""
        found = rig.git(self._bare, "grep", "", "main", "--", "clusters", "ledger")
        assert {text: text in found for text in texts} == texts

    def holds(self, files: Mapping[str, list[str] | None]) -> None:
        """Check that a file whose path ends so has these words, or that there is none."""
        texts = GitRepo(self._bare).files().items()
        for name, words in files.items():
            found = [text for path, text in texts if f"/{path}".endswith(f"/{name}")]
            assert bool(found) is (words is not None), name
            assert [word for word in words or () if word not in "".join(found)] == [], name

    def newest(self, trailers: Mapping[str, Any]) -> None:
        """Check trailers of the newest commit: their values, or how many there are."""
        self._have(trailers, rig.commits(self._bare)[-1])

    def follow(self, trailers: Mapping[str, Any]) -> None:
        """Check trailers of the newest commit that follows a person's."""
        *_, newest = (c for c in rig.commits(self._bare) if c.one("Operation") == "follow")
        self._have(trailers, newest)

    def _have(self, trailers: Mapping[str, Any], commit: rig.Commit) -> None:
        for key, values in trailers.items():
            found = commit.all(key)
            assert (len(found) if isinstance(values, int) else found) == values

    def commits(self, kinds: list[str]) -> None:
        made = [commit.one("Operation") or "person" for commit in rig.commits(self._bare)]
        assert made == kinds

    def message(self, words: list[str]) -> None:
        """Check words of the newest commit's author, and of its message."""
        text = rig.git(self._bare, "log", "-1", "--format=%an%n%B", "main")
        assert [word for word in words if word not in text] == [], text

    def errors(self, count: int) -> None:
        """Check how many errors were logged, each of them once."""
        told = [record.message for record in self._log.records if record.levelname == "ERROR"]
        assert len(told) == len({*told}) == count, told

    def logs(self, words: str) -> None:
        assert words in self._log.text

    def operations(self, names: list[str]) -> None:
        made = rig.operations(self._bare)
        assert [one.removeprefix("op-") for one in made if one.startswith("op-")] == names

    def problems(self, files: list[str]) -> None:
        """Check which files, or folders, are told to have problems."""
        found = [fault.file for fault in self._generator.snapshot.problems]
        assert {f for f in files if any(one.startswith(f) for one in found)} == {*files}, found
        assert all(one.startswith((*files,)) for one in found), found

    def problems_soon(self, files: list[str]) -> None:
        self.waits_until({"problems": files})

    def said(self, words: list[str]) -> None:
        """Check words of the message of the newest commit."""
        text = rig.git(self._bare, "log", "-1", "--format=%B", "main")
        assert [word for word in words if word not in text] == [], text

    def check_tells(self, files: list[str]) -> None:
        """Check in which files `demandops check` finds faults once the last change is merged."""
        self._person.fetch()
        faults = merge_check.check(self._person.folder).faults
        assert {fault.file for fault in faults} == {*files}

    def fails(self, what: str) -> None:
        assert any(name.startswith(what) for name in self._generator.failures)

    def rendered(self, fits: bool) -> None:
        """Check whether the files below clusters/ are those of the ledger and configuration."""
        texts = rendered_files(state_of(self._bare))
        wanted = {p: t for p, t in texts.items() if p.startswith("clusters/") and p[-5:] == ".yaml"}
        assert (GitRepo(self._bare).manifests() == wanted) is fits

    def sound(self, last: int) -> None:
        rig.assert_sound(self._bare, verify_last=last)

    def close(self) -> None:
        self._open.close()


@pytest.fixture
def tell(
    bare: Path, petra: Person, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> Callable[[list[dict[str, Any]]], None]:
    rig.git(bare, "update-ref", "refs/heads/main", rig.root(bare))  # so nothing needs approval
    caplog.set_level("INFO", "demandops")

    def told(steps: list[dict[str, Any]]) -> None:
        story = Story(bare, petra, tmp_path / "data", caplog)
        try:
            story.tell(steps)
        finally:
            story.close()

    return told


@pytest.mark.parametrize("story", STORIES, ids=[*STORIES])
def test_story(tell: Callable[[list[dict[str, Any]]], None], story: str) -> None:
    tell(STORIES[story])
