"""Stories of generators and a person at one state repo, as the files in `stories/` tell them.

A story is a list of steps, each with words of :class:`Story`. A story that starts ``both`` is told
once with a generator that uses the repo itself, and once with one that uses a clone. Demands are
``join 1``, ``leave 1``, ``put d 1``, ``release d`` or a whole goal; a further number is that of the
vehicle, and a further name the requester. In texts, ``{one}`` is the branch of proposal ``one``.
"""

from __future__ import annotations

import shlex
import shutil
import subprocess
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.base.errors import DemandOpsError
from demandops.base.naming import Subject, SubjectKind
from demandops.decide.state import rendered_files
from demandops.model.demand import goals as demand_goals
from demandops.model.ledger.claim import ClaimKey, path_of
from demandops.repo import reader
from demandops.repo.git.remote_repository import Slot
from demandops.repo.merge_check import merge_check
from demandops.serve import agenda
from demandops.serve.generator import Generator
from demandops.serve.journal import open_journal

from tests.kit import config, git_over_http, goals, plain_yaml, rig
from tests.kit.cli import Run
from tests.kit.clock import Clock
from tests.kit.repo import FORGER, GitRepo, Person, branches, read, state_of
from tests.kit.rig import Proposed

Steps = list[dict[str, Any]]


def stories() -> Iterator[tuple[str, Steps]]:
    for path in sorted(Path(__file__).with_name("stories").glob("*.yaml")):
        for title, steps in plain_yaml.load(path.read_text()).items():
            name = f"{path.stem}: {title}"
            if not any(step.get("start") == "both" for step in steps):
                yield name, steps
                continue
            for mode in ("local", "remote"):
                yield f"{name} ({mode})", [_in_mode(step, mode) for step in steps]


def _in_mode(step: dict[str, Any], mode: str) -> dict[str, Any]:
    return {word: mode if what == "both" else what for word, what in step.items()}


STORIES = dict(stories())
HOOKS = {
    "deletes no branch": 'case "$1 $3" in refs/heads/demand/*\\ 00000000*) exit 1;; esac',
    "takes no branch": 'case "$1" in refs/heads/demand/*) exit 1;; esac',
    "takes all": "true",
    "takes nothing": "echo 'main is frozen until Monday' >&2; exit 1",
    "refuses messages": '! git log --format=%B "$2..$3" | grep "vehicle01\\|expire-override" >&2',
    "refuses authors": '! git log --format=%an "$2..$3" | grep vehicle01 >&2',
    "refuses files": '! git log -p "$2..$3" -- ledger | grep "^+.*vehicle01" >&2',
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
        who = more[2:] or ["user"]
        return goals.put(more[0], *who, topic=(f"/vehicles/{vehicle}/ego_data", vehicle))
    if kind == "release":
        head = {"kind": "Demand", "demand": more[0], "requesters": ["user"]}
        return head | {"operation": "release"}
    raise ValueError(told)


class Story:
    """Each public method is a word that a step may have."""

    def __init__(
        self, bare: Path, person: Person, data: Path, caplog: pytest.LogCaptureFixture, command: Run
    ) -> None:
        self._bare, self._person, self._data, self._log = bare, person, data, caplog
        self._command = command
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
        self._branches: dict[str, str] = {}
        self._before: dict[str, str | None] = {}
        self._server = git_over_http.Server("")

    def tell(self, steps: Iterable[Mapping[str, Any]]) -> None:
        for step in steps:
            for word, what in step.items():
                getattr(self, word)(what)

    def _revision(self, name: str) -> str:
        at = self._sent[name].branch if name in self._sent else name
        return rig.git(self._bare, "rev-parse", at)

    # ---- generators ----

    def start(self, name: str) -> None:
        """Start a generator that uses a clone, or the repo itself if it is called `local`.

        If it is called `http`, it uses a smart-HTTP server.
        """
        address: str | Path = self._bare if name == "local" else self._bare.as_uri()
        if name == "http":
            if not self._server.url:
                self._server = self._open.enter_context(git_over_http.serving(self._bare.parent))
            address = f"{self._server.url}/{self._bare.name}"
        self._running[name] = self._open.enter_context(ExitStack())
        made = rig.running(address, data=self._data / name, **self._options)
        self._generators[name] = self._running[name].enter_context(made)

    def looks(self, at: str) -> None:
        """Let generators that use a clone look at the state repo only for demands."""
        assert at == "for demands"
        del self._options["fetch_interval"]

    def cut_off(self, name: str) -> None:
        """Stop a generator at once, so that what it has not published stays in the journal."""
        self._generators[name].close(0)
        self.stop(name)

    def in_journal(self, demands: Mapping[str, Any]) -> None:
        """Leave demands in a journal, as a process that was killed; `main` may be noted."""
        base = self._noted.get("main") or rig.tip(self._bare)
        at = self._clock.now().isoformat()
        slot = Slot(self._data / "remote")
        with closing(slot), closing(open_journal(slot.folder)) as journal:
            for name, told in demands.items():
                journal.append([rig.journaled(f"op-{name}", self._goal(told), at, base)])

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

    def away(self, steps: Steps) -> None:
        """Tell these steps while nobody finds the state repo."""
        with rig.away(self._bare):
            self.tell(steps)

    def passes(self, seconds: float) -> None:
        self._clock.pass_(seconds)

    def is_set(self, seconds: float) -> None:
        self._clock.set_by(seconds)

    # ---- demands ----

    def _goal(self, told: Any) -> Any:
        made = demand(told)
        return made | ({"to": self._noted[made["to"]]} if made.get("kind") == "Rollback" else {})

    def book(self, demands: list[Any]) -> None:
        rig.book(self._generator, *map(demand, demands))

    def send(self, demands: Mapping[str, Any]) -> None:
        for name, told in demands.items():
            self._sent[name] = Proposed(self._generator, demand(told), f"op-{name}")

    def roll_back(self, what: Mapping[str, Any]) -> None:
        who, to = ("A", "a@example.org"), self._noted[what["to"]]
        goal = demand_goals.rollback(to, drop_newer=what["drop_newer"], reason="x", who=who)
        assert rig.outcome(self._generator.submit(goal)) == what["gives"]

    def propose(self, demands: Mapping[str, Any]) -> None:
        for name, made in demands.items():
            self.send({name: made})
            assert self._sent[name].branch

    def while_busy(self, steps: Steps) -> None:
        """Keep the worker busy, with a demand of somebody else, until these steps are told."""
        before = {*self._sent}
        with rig.busy(self._generator, goals.put("busy", "user9"), "op-busy"):
            self.tell(steps)
            for name in self._sent.keys() - before:  # so that they are one batch
                self._sent[name].ticket.journaled.result(rig.PATIENCE_S)

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
            told = f"{error}" if error else " ".join(future.result().warnings)
            assert self._named(word) in told, told

    def hears(self, told: Mapping[str, Mapping[str, str]]) -> None:
        """Wait until a requester hears a word at a stage of its demand."""
        for name, words in told.items():
            for at, word in words.items():
                heard = self._sent[name].told
                rig.wait_until(
                    lambda: any(s == at and word in text for s, text in heard),  # noqa: B023
                    f"{name} hears {word} of {at}",
                )

    def stages(self, names: Mapping[str, list[str]]) -> None:
        assert {name: [stage for stage, _ in self._sent[name].told] for name in names} == names

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

    def fast_forward(self, name: str) -> None:
        self._person.merge(self._sent[name].branch, "--ff-only")

    def delete(self, name: str) -> None:
        self._person.delete(self._sent[name].branch)

    def commit_on(self, names: Mapping[str, list[str]]) -> None:
        """Commit on a proposal's branch: replace a text in the first claim of a connection."""
        for name, (old, new) in names.items():
            branch = self._sent[name].branch
            self.in_clone([["fetch", "-q"], ["checkout", "-q", "-B", "work", f"origin/{branch}"]])
            claim, *_ = sorted(self._person.folder.glob("ledger/connections/*/*/*.yaml"))
            claim.write_text(claim.read_text().replace(old, new))
            self.in_clone([["commit", "-qam", "Edit"], ["push", "-q", "origin", f"HEAD:{branch}"]])

    def in_clone(self, commands: list[list[str]]) -> None:
        """Run git in the person's clone; ``write`` writes a file and adds it."""
        if not self._person.folder.exists():
            self._person.fetch()
        for command in commands:
            if command[0] == "write":
                self._person.folder.joinpath(command[1]).write_text(command[2])
            args = ["add", command[1]] if command[0] == "write" else command
            rig.git(self._person.folder, *args)

    def runs(self, commands: Mapping[str, Mapping[str, Any]]) -> None:
        """Run commands on the state repo; check words of what they print, and their codes."""
        for command, wanted in commands.items():
            args = map(self._named, shlex.split(command))
            ran = self._command(*args, "--state-repo", self._bare)
            told = ran.out + ran.err
            assert ran.code == wanted.get("code", 0), told
            assert [word for word in wanted.get("says", ()) if word not in told] == [], told

    def _named(self, text: str) -> str:
        for name, sent in self._sent.items():
            if f"{{{name}}}" in text:
                text = text.replace(f"{{{name}}}", sent.branch)
        return text

    def change(self, files: Mapping[str, Any], **commit: Any) -> None:
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
        self._person.change(texts, **commit)

    def prepend(self, texts: Mapping[str, str]) -> None:
        self.change({path: text + self._person.read(path) for path, text in texts.items()})

    def forge(self, commit: Mapping[str, Any]) -> None:
        """Commit in the generator's name, with trailers: texts of files, or a broken claim.

        A trailer may have the name of a revision that was noted.
        """
        trailers = commit["trailers"].items()
        lines = "".join(f"{key}: {self._noted.get(text, text)}\n" for key, text in trailers)
        how = {"message": f"x\n\nWhy: x\n\n{lines}Render-Version: 3", "who": FORGER}
        if word := commit.get("claim"):
            self.edit_claim({word: "kind: 5\n"}, **how)
        else:
            self.change(commit["files"], **how)

    def commit(self, commit: Mapping[str, Any]) -> None:
        self.change(commit["files"], message=commit["message"])

    def undo(self, last: str) -> None:
        assert last == "change"
        self.change(self._before)

    def override(self, overrides: Mapping[str, Any]) -> None:
        head = plain_yaml.load(config.override())
        files = {f"overrides/{n}.yaml": fields and head | fields for n, fields in overrides.items()}
        self.change(files)

    def edit_claim(self, texts: Mapping[str, Any], **commit: Any) -> None:
        """Change the application's claim file that holds a word."""
        for word, text in texts.items():
            (path,) = [p for p in rig.claims(self._bare, word) if "applications" in p]
            self.change({path: text}, **commit)

    def claim_by_hand(self, claims: Mapping[str, Mapping[str, Any]]) -> None:
        """Copy the application's claim that holds a word, with changes, of which `check` tells."""
        for word, new in claims.items():
            (path,) = [p for p in rig.claims(self._bare, word) if "applications" in p]
            data = plain_yaml.load(read(self._bare, path))
            data |= {name: new[name] for name in ("demand", "requesters") if name in new}
            data["application"] |= {name: new[name] for name in ("id", "node") if name in new}
            subject = Subject(SubjectKind.APPLICATION, data["application"]["id"])
            files = {path_of(ClaimKey(subject, data["demand"])): yaml.safe_dump(data)}
            self._person.write(files)
            told = [f"{one.code} {one}" for one in merge_check.check(self._person.folder).faults]
            assert new["told"] in told[0] if "told" in new else told == [], told
            self._person.change(files)

    def delete_claims(self, word: str) -> None:
        self.change(dict.fromkeys(rig.claims(self._bare, word)))

    def reset(self, name: str) -> None:
        rig.git(self._bare, "update-ref", "refs/heads/main", self._noted[name])

    def policy(self, changed: Mapping[str, Any]) -> None:
        self._person.policy(**changed)

    def shorten(self, what: str) -> None:
        """Take away the commits before main, as if nobody had ever made them."""
        assert what == "history"
        self.git([["replace", "--graft", "main"]])
        root = rig.git(self._bare, "for-each-ref", "--format=%(objectname)", "refs/replace")
        self.git([["update-ref", "refs/heads/main", root], ["pack-refs"]])
        shutil.rmtree(self._bare / "refs" / "replace")
        self.git([["reflog", "expire", "--expire=now", "--all"], ["gc", "-q", "--prune=now"]])

    def git(self, commands: list[list[str]]) -> None:
        for command in commands:
            rig.git(self._bare, *command)

    def lay(self, files: Mapping[str, str | None]) -> None:
        """Write or remove files, or folders, in the folder of the bare repository."""
        for path, text in files.items():
            file = self._bare / path
            if path.endswith("/"):
                file.mkdir() if text is not None else file.rmdir()
            else:
                file.write_text(text) if text is not None else file.unlink()

    def loses(self, spec: str) -> None:
        rig.lose(self._bare, spec)

    def clone_loses(self, path: str) -> None:
        """Let the disk of the clone of `remote`, which is stopped, lose a file of main."""
        rig.lose(self._data / "remote/slot-0/clone.git", f"refs/remotes/origin/main:{path}")

    def damage(self, command: str) -> None:
        """Run a shell command in the clone of `remote`, which is stopped."""
        clone = self._data / "remote/slot-0/clone.git"
        subprocess.run(["sh", "-ec", command], cwd=clone, check=True)

    def cannot_start(self, why: str) -> None:
        with pytest.raises(DemandOpsError, match=why):
            Generator(str(self._bare))

    def http(self, faults: Mapping[str, Any]) -> None:
        for name, value in faults.items():
            setattr(self._server.faults, name, value)

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
        if name in self._sent:
            self._branches[name] = self._sent[name].branch

    def replaces(self, names: Mapping[str, str]) -> None:
        """Wait until a proposal says that it replaces the one that was noted."""
        for name, old in names.items():
            sent, before = self._sent[name], self._branches[old]
            rig.wait_until(lambda: sent.branch != before, f"{name} is another proposal")  # noqa: B023
            seen = f"{before} {self._noted[old]}"
            self.proposal({name: {"Replaces": [seen]}})
            text = rig.git(self._bare, "log", "-1", "--format=%b", sent.branch)
            assert text.startswith(f"Changed: replaces {seen};")

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

    def check_tells(self, files: list[str]) -> None:
        """Check in which files `demandops check` finds faults once the last change is merged."""
        self._person.fetch()
        faults = merge_check.check(self._person.folder).faults
        assert {fault.file for fault in faults} == {*files}

    def proposal(self, trailers: Mapping[str, Mapping[str, Any]]) -> None:
        """Check trailers of the commit on a proposal's branch."""
        for name, wanted in trailers.items():
            [commit] = rig.commits(self._bare, f"main..{self._sent[name].branch}")
            self._have(wanted, commit)

    def status(self, reasons: Mapping[str, str]) -> None:
        """Wait until the generator says why the remote cannot be used; "" if it can be."""
        for name, word in reasons.items():

            def why(name: str = name) -> str:
                return str(getattr(self._generator.remote_status, name))

            rig.wait_until(lambda: word in why() and bool(word) == bool(why()), word)  # noqa: B023

    def pushes(self, count: int) -> None:
        assert self._server.taken == count

    def requests_refused(self, count: int) -> None:
        rig.wait_until(lambda: self._server.refused >= count, f"{count} requests are refused")

    def follows(self, name: str) -> None:
        """Wait until the generator knows this branch or revision."""
        seen = self._revision(name)
        rig.wait_until(
            lambda: self._generator.includes(str(self._generator.snapshot.commit), seen), name
        )

    def verified(self, holds: list[bool]) -> None:
        """Check which commits since the first verify, each alone and as a whole."""
        with reader.opened(str(self._bare)) as repo:
            commits = repo.revisions(f"{rig.root(self._bare)}..")
            found = repo.verify(commits)
            assert found == repo.verify(commits, whole=True)
        assert [verdict.holds for verdict in found] == holds, found

    def whole(self, what: str) -> None:
        """Check that each commit verifies, without a claim about who made it."""
        assert what == "history" and rig.differing(self._bare) == {}

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
    bare: Path,
    petra: Person,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    demandops: Run,
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[[Steps], None]:
    monkeypatch.setattr(agenda, "LONGEST_EVALUATION_S", 60.0)  # so that no batch is cut in two
    rig.git(bare, "update-ref", "refs/heads/main", rig.root(bare))  # so nothing needs approval
    caplog.set_level("INFO", "demandops")

    def told(steps: Steps) -> None:
        story = Story(bare, petra, tmp_path / "data", caplog, demandops)
        try:
            story.tell(steps)
        finally:
            story.close()

    return told


@pytest.mark.parametrize("story", STORIES, ids=[*STORIES])
def test_story(tell: Callable[[Steps], None], story: str) -> None:
    tell(STORIES[story])
