"""The history, and the form of the messages that it consists of."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from typing import Literal, get_args

import git
import pygit2
from pygit2 import Commit, Oid, Repository
from pygit2.enums import SortMode

from demandops.base.errors import StateRepoError
from demandops.base.quoting import escaped, harmless, is_visible, one_line
from demandops.render.gitops import CLUSTERS_ROOT
from demandops.repo.git import signing
from demandops.repo.git import tree as trees
from demandops.repo.git.tree import commit_of

# ---- the text of messages: paragraphs of lines, and trailers in the last paragraph ----
#
# Only this module writes and reads messages. A line of a paragraph is for people: its text is
# escaped and shortened. A trailer is for programs: its value is read back exactly. A value of
# visible characters on which no forge acts is written unchanged, so ``git log
# --format='%(trailers:key=Requester)'`` shows it; any other value is written in double quotes with
# escapes like ``\u202e``. So no value can begin a line, end the message, look like a trailer or
# give a forge an order. Messages of earlier versions, which did not quote, are read the same way.

Trailers = Iterable[tuple[str, str]]

_WHY = "Why: "
_AS_WRITTEN = ("Reason",)  # the person who runs a command may close an issue with it
_KEY = re.compile(r"[A-Za-z0-9-]+")
_ESCAPE = r"\\(?:x[0-9a-f]{2}|u[0-9a-f]{4}|U00(?:0[0-9a-f]|10)[0-9a-f]{4}|[nrt\\\"])"
_ESCAPES = re.compile(_ESCAPE)
_EDGES, _SPACE = re.compile(r"\A | \Z"), r"\\x20"
# A quoted value has an escape, because values without escapes are not quoted.
_QUOTED = re.compile(rf'"(?=.*\\)(?:[^"\\]|{_ESCAPE})*"')


@dataclass(frozen=True, slots=True)
class MessageText:
    summary: str
    why: str
    trailers: dict[str, list[str]]


def compose(paragraphs: Iterable[Iterable[str]], trailers: Trailers) -> str:
    # without empty paragraphs and trailers
    lines = [f"{key}: {_encoded(key, value)}" for key, value in trailers if value]
    body = ("\n".join(harmless(one_line(line)) for line in lines) for lines in paragraphs)
    return "\n\n".join(text for text in (*body, "\n".join(lines)) if text) + "\n"


def parse(message: str) -> MessageText:
    lines = message.split("\n")
    whys = (line.removeprefix(_WHY) for line in lines if line.startswith(_WHY))
    trailers: dict[str, list[str]] = {}
    head, _, last = message.rstrip("\n").rpartition("\n\n")
    for line in last.split("\n") if head else ():
        key, colon, value = line.partition(": ")
        if not colon or not _KEY.fullmatch(key):
            trailers.clear()  # a paragraph with any other line is text for people
            break
        if _QUOTED.fullmatch(value):
            value = _ESCAPES.sub(
                lambda m: m[0][1] if m[0][1] in '\\"' else m[0].encode().decode("unicode_escape"),
                value[1:-1],
            )
        trailers.setdefault(key, []).append(value)
    return MessageText(lines[0], next(whys, ""), trailers)


def _encoded(key: str, value: str) -> str:
    is_plain = is_visible(value) and value == value.strip() and not _QUOTED.fullmatch(value)
    if is_plain and (key in _AS_WRITTEN or harmless(value) == value):
        return value
    text = escaped(value.replace("\\", r"\\").replace('"', r"\""))
    return f'"{_EDGES.sub(_SPACE, harmless(text))}"'


# ---- the history: commits with their trailers, and which commits changed a path ----
#
# Everything comes from commit messages, trailers and ``git log -- <path>``, so plain git shows the
# same.

# The trailer that names the branch on which a commit was proposed for approval.
PROPOSAL = "Proposal"
# The trailer with the branch and commit where the demand was proposed with other content.
REPLACES = "Replaces"
REQUIRED_BY = "Approval-Required-By"  # the trailer, repeated, with what requires the approval

# The committer of every commit by a generator.
GENERATOR_NAME = "DemandOps generator"
GENERATOR_EMAIL = "generator@demandops.invalid"

# Of the year 9999: datetime has no later year, but anybody may commit with one.
_LAST_SECOND = 253402300799
_NAME = re.compile(r"[a-z0-9]([a-z0-9-]*[a-z0-9])?")


@dataclass(frozen=True, slots=True)
class LogEntry:
    commit: str
    time: datetime
    author: str
    summary: str
    trailers: dict[str, list[str]]
    why: str = ""
    # Whether the generator is the committer, so that generated files should match the ledger. False
    # for a commit of a proposal, because a person may merge it onto other changes. Anybody can
    # commit under the generator's name, so is_by_generator also checks a required signature.
    by_generator: bool = False
    # by the author's clock; for a demand's commit, the time when the demand was received
    authored: datetime | None = None

    def first(self, key: str) -> str:
        return next(iter(self.trailers.get(key, ())), "")


def time_of(commit: Commit) -> datetime:
    return _time(commit.commit_time)


def _time(seconds: int) -> datetime:
    # none before 1970 or after the year 9999
    return datetime.fromtimestamp(min(max(seconds, 0), _LAST_SECOND), tz=timezone.utc)


def author_of(commit: Commit) -> tuple[str, str]:
    return _text(commit.author.raw_name), _text(commit.author.raw_email)


def _text(raw: bytes) -> str:
    # a commit may name another encoding, also one that does not exist; UTF-8 never fails
    return raw.decode("utf-8", "replace")


def entry_of(commit: Commit) -> LogEntry:
    text = parse(_text(commit.raw_message))
    committer = _text(commit.committer.raw_name), _text(commit.committer.raw_email)
    is_ours, is_proposal = committer == (GENERATOR_NAME, GENERATOR_EMAIL), PROPOSAL in text.trailers
    # a person's message has no trailers for programs, unless it keeps those of a merged proposal
    is_told = is_ours or is_proposal
    return LogEntry(
        commit=str(commit.id),
        time=time_of(commit),
        author=author_of(commit)[0],
        summary=text.summary,
        trailers=text.trailers if is_told else {},
        why=text.why if is_told else "",
        by_generator=is_ours and not is_proposal and "Render-Version" in text.trailers,
        authored=_time(commit.author.time),
    )


def is_by_generator(repo: Repository, commit: Commit) -> bool:
    # signed, if a signature is required
    return entry_of(commit).by_generator and not signing.faults(repo, [commit])


def commits(
    repo: Repository, tip: str | Oid, after: str | Oid | None = None
) -> Iterator[tuple[Commit, LogEntry]]:
    walker = repo.walk(commit_of(repo, tip).id, SortMode.TOPOLOGICAL)
    walked: Iterable[Commit] = walker
    if after is not None:
        hidden = commit_of(repo, after).id
        walker.hide(hidden)
        walked = list(walker)
        if any(len(commit.parent_ids) > 1 for commit in walked):
            # with merges, libgit2 goes by the commits' times and may yield commits up to ``after``
            # if a wrong clock has set the times
            older = {commit.id for commit in repo.walk(hidden)}
            walked = [commit for commit in walked if commit.id not in older]
    return ((commit, entry_of(commit)) for commit in walked)


def was_rendered_with(repo: Repository, tip: Oid, version: int) -> bool:
    is_other = False
    for commit in repo.walk(tip):
        # whole messages are parsed only where they matter: the history may be long
        if b"\nRender-Version: " not in commit.raw_message:
            continue
        entry = entry_of(commit)
        if entry.first("Render-Version") == str(version) and is_by_generator(repo, commit):
            return True
        is_other = is_other or entry.by_generator
    return not is_other  # if no program committed anything, nothing contradicts the version


def person_commits(
    repo: Repository, tip: str | Oid, after: str | Oid | None = None
) -> Iterator[Commit]:
    """Yield people's commits, and those of proposals (:attr:`LogEntry.by_generator`)."""
    return (
        commit
        for commit, entry in _with_checked_signatures(repo, tip, after)
        if not entry.by_generator
    )


def _with_checked_signatures(
    repo: Repository, tip: str | Oid, after: str | Oid | None
) -> list[tuple[Commit, LogEntry]]:
    """Return :func:`commits`; those without a valid required signature are a person's."""
    pairs = list(commits(repo, tip, after))
    faults = signing.faults(repo, [commit for commit, e in pairs if e.by_generator])
    return [
        (commit, replace(entry, by_generator=entry.by_generator and entry.commit not in faults))
        for commit, entry in pairs
    ]


def first_parents(repo: Repository, tip: str | Oid) -> Iterator[Commit]:
    walker = repo.walk(commit_of(repo, tip).id)
    walker.simplify_first_parent()
    return iter(walker)


# The outcome of a demand that gets no commit of its own. The next commit records the outcome.
Settled = Literal["unchanged", "waiting", "released", "refused"]
_Outcome = Literal["changed", Settled]


def settled_trailer(outcome: Settled) -> str:
    return f"{outcome.capitalize()}-Operation-Id"


_OUTCOMES: dict[str, _Outcome] = {
    "Operation-Id": "changed",
    **{settled_trailer(outcome): outcome for outcome in get_args(Settled)},
}


@dataclass(frozen=True, slots=True)
class RecordedOutcome:
    commit: str
    outcome: _Outcome


def operations_since(repo: Repository, tip: str | Oid, base: str) -> dict[str, RecordedOutcome]:
    """Return the outcome of each operation that a commit after ``base`` records, newest first."""
    if str(tip) == base:
        return {}
    try:
        is_ancestor = bool(base) and repo.descendant_of(tip, base)
    except (pygit2.GitError, KeyError, ValueError):
        is_ancestor = False
    outcomes = {}
    # if the remote was made anew, ``base`` is unknown, and any commit may record an operation
    for _, entry in _with_checked_signatures(repo, tip, base if is_ancestor else None):
        is_record = entry.by_generator or PROPOSAL in entry.trailers
        for key, outcome in _OUTCOMES.items() if is_record else ():
            waits = key == "Operation-Id" and entry.first("Operation") == "wait"
            for operation in entry.trailers.get(key, ()):
                outcomes[operation] = RecordedOutcome(entry.commit, "waiting" if waits else outcome)
    return outcomes


def last_generator_commit(repo: Repository, tip: Oid) -> Oid | None:
    line = first_parents(repo, tip)
    return next((commit.id for commit in line if is_by_generator(repo, commit)), None)


@dataclass(frozen=True, slots=True)
class PathChange:
    entry: LogEntry
    existed_before: bool
    exists_after: bool


@dataclass(frozen=True, slots=True)
class PathHistory:
    started: LogEntry | None  # added the path; None if it never existed
    newest: tuple[LogEntry, ...]  # changed it afterwards, newest first
    more: int  # older changes, which are not listed
    stopped: LogEntry | None  # removed the path; None if it exists or never did


def changes_to(
    repo: Repository, tip: str | Oid, path: str, after: str | None = None
) -> Iterator[PathChange]:
    for revision in _git_log(repo, tip, after, "--format=%H", f":(literal){path}"):
        commit = commit_of(repo, revision)
        before = any(trees.entry(parent.tree, path) is not None for parent in commit.parents)
        yield PathChange(entry_of(commit), before, trees.entry(commit.tree, path) is not None)


def history_of(repo: Repository, tip: str | Oid, path: str, most: int) -> PathHistory:
    started = stopped = None
    changes: list[LogEntry] = []
    more = 0
    for change in changes_to(repo, tip, path):
        if not change.exists_after:
            stopped = change.entry
        elif not change.existed_before:
            started = change.entry
            break
        elif len(changes) < most:
            changes.append(change.entry)
        else:
            more += 1
    return PathHistory(started, tuple(changes), more, stopped)


def release_path(repo: Repository, tip: str | Oid, name: str) -> str | None:
    if not _NAME.fullmatch(name):
        return None
    files = trees.blobs(commit_of(repo, tip).tree, (CLUSTERS_ROOT,))
    current = (path for path, _ in files if path.endswith(f"/{name}.yaml"))
    return next(current, None) or next(iter(_removed(repo, tip, f"{name}.yaml", "-1")), None)


def stopped_release_names(repo: Repository, tip: str | Oid) -> set[str]:
    removed = _removed(repo, tip, "*.yaml")
    names = {path.rsplit("/", 1)[-1].removesuffix(".yaml") for path in removed}
    return {name for name in names if _NAME.fullmatch(name)}  # a chart's file has a version


def _removed(repo: Repository, tip: str | Oid, file: str, *more: str) -> list[str]:
    options = ("--diff-filter=D", "--no-renames", *more, "--format=", "--name-only")
    return _git_log(repo, tip, None, *options, f":(glob){CLUSTERS_ROOT}/*/*/*/{file}")


# by git, because libgit2 has no walk that is limited to a path
def _git_log(repo: Repository, tip: str | Oid, after: str | None, *query: str) -> list[str]:
    *options, path = query
    commits = [str(commit_of(repo, tip).id), *([f"^{commit_of(repo, after).id}"] if after else [])]
    with git.Repo(repo.path) as opened:
        try:
            output = opened.git.log("--no-show-signature", "-z", *options, *commits, "--", path)
        except git.GitCommandError as error:
            raise StateRepoError(f"git cannot read the history of {path}: {error.stderr}") from None
    return [item for item in output.split("\0") if item]
