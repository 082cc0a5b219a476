"""The history: its commits, who made or caused them, and how people name them."""

from __future__ import annotations

import getpass
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from functools import cache
from itertools import islice
from typing import Literal, NamedTuple, get_args

import pygit2
from pygit2 import Commit, Oid, Repository
from pygit2.enums import SortMode

from demandops.base.errors import BeforeTheFirst, StateRepoError
from demandops.base.quoting import one_line, quoted
from demandops.base.settings import GENERATED_ROOTS
from demandops.model.config.base_model import seconds_of
from demandops.model.config.config import CONFIG_ROOTS
from demandops.model.ledger.claim import LEDGER_ROOT
from demandops.render.gitops import CLUSTERS_ROOT
from demandops.repo.git import child_processes, signing
from demandops.repo.git import tree as trees
from demandops.repo.git.tree import commit_of
from demandops.repo.history.commit_message import (
    APPROVED_BY,
    GENERATOR_EMAIL,
    GENERATOR_NAME,
    PROPOSAL,
    REJECTS,
    REQUESTERS_AT,
    generator_signature,
    parse,
    signature,
    time_text,
)

# ---- the history: commits with their trailers, and which commits changed a path ----
#
# Everything comes from commit messages, trailers and ``git log -- <path>``, so plain git shows the
# same.

# Of the year 9999: datetime has no later year, but anybody may commit with one.
_LAST_SECOND = 253402300799
_GITHUB = ("GitHub", "noreply@github.com")
_NAME = re.compile(r"[a-z0-9]([a-z0-9-]*[a-z0-9])?")
RELEASE_FILES = f"{CLUSTERS_ROOT}/*/*/*/*.yaml"


@dataclass(frozen=True, slots=True)
class Answer:
    """What a person, or a rule in a person's place, said to a proposal."""

    outcome: Literal["approved", "rejected"]
    by: str  # empty if Git does not tell who moved main to the branch, or who deleted the branch
    time: datetime
    reason: str
    commit: str


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
    by_person: bool = True  # whether the author is one, and neither requesters nor the generator
    # by the author's clock; for a demand's commit, the time when the demand was received
    authored: datetime | None = None
    # of a demand that needed approval, and of the commit that rejects a proposal
    answer: Answer | None = None

    def first(self, key: str) -> str:
        return next(iter(self.trailers.get(key, ())), "")


def time_of(commit: Commit) -> datetime:
    return _time(commit.commit_time)


def _time(seconds: int) -> datetime:
    # none before 1970 or after the year 9999
    return datetime.fromtimestamp(min(max(seconds, 0), _LAST_SECOND), tz=timezone.utc)


def _name_and_email(who: pygit2.Signature) -> tuple[str, str]:
    return _text(who.raw_name), _text(who.raw_email)


def _text(raw: bytes) -> str:
    # a commit may name another encoding, also one that does not exist; UTF-8 never fails
    return raw.decode("utf-8", "replace")


def entry_of(commit: Commit) -> LogEntry:
    text = parse(_text(commit.raw_message))
    committer, (author, email) = map(_name_and_email, (commit.committer, commit.author))
    is_ours, is_proposal = committer == (GENERATOR_NAME, GENERATOR_EMAIL), PROPOSAL in text.trailers
    # a person's message has no trailers for programs, unless it keeps those of a merged proposal,
    # or rejects one
    is_told = is_ours or is_proposal or REJECTS in text.trailers
    return LogEntry(
        commit=str(commit.id),
        time=time_of(commit),
        author=author,
        summary=text.summary,
        trailers=text.trailers if is_told else {},
        why=text.why if is_told else one_line(text.body),
        by_generator=is_ours and not is_proposal and "Render-Version" in text.trailers,
        by_person=email != GENERATOR_EMAIL and not email.endswith(REQUESTERS_AT),
        authored=_time(commit.author.time),
    )


def merges(repo: Repository, tip: str | Oid) -> dict[str, Commit]:
    """Return for each commit that a merge brought to the history of ``tip`` that merge."""
    merged: dict[str, Commit] = {}
    for commit in repo.walk(commit_of(repo, tip).id, SortMode.TOPOLOGICAL):
        for side in commit.parent_ids[1:]:
            brought = repo.walk(side)
            brought.hide(commit.parent_ids[0])
            # an older merge goes before a later one that brings all of main to somebody's branch
            merged.update((str(each.id), commit) for each in brought)
    return merged


def answered(repo: Repository, entry: LogEntry, tip: Oid, merged: Mapping[str, Commit]) -> LogEntry:
    """Return ``entry`` with who approved or rejected it; ``merged`` is :func:`merges` of main."""
    by, reason, time, commit = entry.author, "", entry.time, entry.commit
    if REJECTS in entry.trailers:
        by, reason = "" if entry.by_generator else by, entry.first("Reason")
        return replace(entry, answer=Answer("rejected", by, time, reason, commit))
    if PROPOSAL not in entry.trailers:
        by = ", ".join(entry.trailers.get(APPROVED_BY, ()))
        return replace(entry, answer=Answer("approved", by, time, "", commit)) if by else entry
    made = commit_of(repo, commit)
    if merge := merged.get(commit):
        by, time, commit = _name_and_email(merge.author)[0], time_of(merge), str(merge.id)
        # forges repeat the title of the pull request there
        told = _text(merge.raw_message).split("\n\n")[1:2]
        reason = "".join(told).strip() if told != [entry.summary] else ""
    elif tip != made.id and not repo.descendant_of(tip, made.id):
        return entry  # it is on no branch but its own
    else:
        committer = _name_and_email(made.committer)
        by = "" if committer == (GENERATOR_NAME, GENERATOR_EMAIL) else committer[0]
        by = entry.author if committer == _GITHUB else by  # it squashes and rebases for a person
    return replace(entry, answer=Answer("approved", by, time, one_line(reason), commit))


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


def first_parents(
    repo: Repository, tip: str | Oid, after: str | Oid | None = None
) -> Iterator[Commit]:
    walker = repo.walk(commit_of(repo, tip).id)
    walker.simplify_first_parent()
    if after is not None:
        walker.hide(commit_of(repo, after).id)
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
    outcomes = {}
    # if the remote was made anew, ``base`` is unknown, and any commit may record an operation
    known = base if base and trees.includes(repo, str(tip), base) else None
    for _, entry in _with_checked_signatures(repo, tip, known):
        is_record = entry.by_generator or PROPOSAL in entry.trailers
        for key, outcome in _OUTCOMES.items() if is_record else ():
            waits = key == "Operation-Id" and entry.first("Operation") == "wait"
            for operation in entry.trailers.get(key, ()):
                outcomes[operation] = RecordedOutcome(entry.commit, "waiting" if waits else outcome)
    return outcomes


def rejections_since(repo: Repository, tip: str | Oid, base: str) -> dict[str, LogEntry]:
    """Return the commits after ``base`` that reject a proposal, by the proposal's branch."""
    known = base if base and base in repo else None
    entries = (entry for _, entry in commits(repo, tip, known) if REJECTS in entry.trailers)
    return {entry.first(REJECTS).partition(" ")[0]: entry for entry in entries}


@dataclass(frozen=True, slots=True)
class PathHistory:
    started: LogEntry | None  # added the path; None if it never existed
    newest: tuple[LogEntry, ...]  # changed it afterwards, newest first
    more: int  # older changes, which are not listed
    stopped: LogEntry | None  # removed the path; None if it exists or never did


def changes_to(
    repo: Repository, tip: str | Oid, path: str, after: str | None = None
) -> Iterator[tuple[LogEntry, bool, bool]]:
    # newest first; with whether the path existed before, and exists after
    for revision in _git_log(repo, tip, after, "--format=%H", f":(literal){path}"):
        commit = commit_of(repo, revision)
        before = any(trees.entry(parent.tree, path) is not None for parent in commit.parents)
        yield entry_of(commit), before, trees.entry(commit.tree, path) is not None


def history_of(repo: Repository, tip: str | Oid, path: str, most: int) -> PathHistory:
    started = stopped = None
    changes: list[LogEntry] = []
    more = 0
    for entry, existed, exists in changes_to(repo, tip, path):
        if not exists:
            stopped = entry
        elif not existed:
            started = entry
            break
        elif len(changes) < most:
            changes.append(entry)
        else:
            more += 1
    return PathHistory(started, tuple(changes), more, stopped)


def release_path(repo: Repository, tip: str | Oid, name: str) -> str | None:
    if not _NAME.fullmatch(name):
        return None
    files = trees.blobs(commit_of(repo, tip).tree, (CLUSTERS_ROOT,))
    current = (path for path, _ in files if path.endswith(f"/{name}.yaml"))
    gone = _removed(repo, tip, RELEASE_FILES.replace("*.yaml", f"{name}.yaml"), "-1")
    return next(current, None) or next(iter(gone), None)


def removed_files(repo: Repository, tip: str | Oid, glob: str) -> dict[str, dict[str, str]]:
    """Return the files of releases or overrides that each commit removed: names with paths."""
    removed, commit = dict[str, dict[str, str]](), ""
    for item in _removed(repo, tip, glob, form="%H"):
        if "/" not in item:
            commit = item
            continue
        name = item.rsplit("/", 1)[-1].removesuffix(".yaml")
        if _NAME.fullmatch(name):  # a chart's file has a version
            removed.setdefault(commit, {})[name] = item.lstrip("\n")  # git ends a commit's line
    return removed


def _removed(repo: Repository, tip: str | Oid, glob: str, *more: str, form: str = "") -> list[str]:
    options = ("--diff-filter=D", "--no-renames", *more, f"--format={form}", "--name-only")
    return _git_log(repo, tip, None, *options, f":(glob){glob}")


# by git, because libgit2 has no walk that is limited to a path
def _git_log(repo: Repository, tip: str | Oid, after: str | None, *query: str) -> list[str]:
    *options, path = query
    commits = [str(commit_of(repo, tip).id), *([f"^{commit_of(repo, after).id}"] if after else [])]
    command = ("log", "--no-show-signature", "-z", *options, *commits, "--", path)
    ran = child_processes.run_git(repo.path, *command)
    if ran.returncode:
        raise StateRepoError(f"git cannot read the history of {path}: {ran.stderr}")
    return [item for item in ran.stdout.split("\0") if item]


# ---- authors: who made a commit or caused a follow commit, and who runs this program ----
#
# A follow commit is made by the generator, and renders what people committed. Its trailers name
# people's commits, and its author names these people. A commit is by a person if no generator on
# any machine made it, or if it is of a proposal.

_ROOTS = (*CONFIG_ROOTS, LEDGER_ROOT, *GENERATED_ROOTS)
_MOST_NAMED = 20
_NO_ADDRESS = "@demandops.invalid"


class Person(NamedTuple):
    name: str
    email: str

    @property
    def is_known(self) -> bool:
        # if git knows no address, it is ``<login>@demandops.invalid``
        return not self.email.endswith(_NO_ADDRESS)

    def __str__(self) -> str:
        return f"{self.name} <{self.email}>"


def person_commits_since(repo: Repository, known: Oid, to: Oid) -> list[Commit]:
    commits = person_commits(repo, to, known)
    return [commit for commit in commits if _touches(commit, _ROOTS)]


def fault_origin(repo: Repository, known: Oid, to: Oid) -> Callable[[str], tuple[str, str]]:
    # A fault is caused by the last person's commit that changed its file, else by the last one that
    # changed any file of the generator. The function returns the commit's id and author.
    commits = list(person_commits(repo, to, known))

    @cache  # a file may have many faults
    def origin(path: str) -> tuple[str, str]:
        for paths in ((path,) if path else (), _ROOTS):
            for commit in commits:
                if _touches(commit, paths):
                    return str(commit.id), str(author_of(commit))
        return "", ""

    return origin


def _touches(commit: Commit, paths: Iterable[str]) -> bool:
    return trees.differ(trees.parent_tree(commit), commit.tree, paths)


def author_of(commit: Commit) -> Person:
    plain = signature(*_name_and_email(commit.author), time_of(commit))
    return Person(plain.name, plain.email)


def caused_by_trailers(causes: Sequence[Commit]) -> list[tuple[str, str]]:
    # of the newest causes, whose newest is first, in time's order
    named = reversed(causes[:_MOST_NAMED])
    return [("Caused-By", f"{commit.id} {author_of(commit)}") for commit in named]


def follow_author(causes: Sequence[Commit], now: datetime) -> pygit2.Signature:
    if not causes:
        return generator_signature(now)
    people = list(dict.fromkeys(author_of(commit) for commit in reversed(causes)))
    names = ", ".join(dict.fromkeys(person.name for person in people))
    # one person's own address, so that `git log --author` finds the follow commit too
    email = people[0].email if len(people) == 1 else GENERATOR_EMAIL
    return signature(names, email, time_of(causes[0]))


def operator(folder: str | None = None) -> Person:
    try:
        login = getpass.getuser()
    except (KeyError, OSError):  # a container's user has no passwd entry
        login = "unknown"

    def configured(variable: str, key: str) -> str:
        ran = child_processes.run_git(None, "config", "--get", key, cwd=folder)
        return os.environ.get(variable) or ran.stdout.strip()

    name = configured("GIT_AUTHOR_NAME", "user.name") or login
    email = configured("GIT_AUTHOR_EMAIL", "user.email") or f"{login}{_NO_ADDRESS}"
    return Person(name, email)


# ---- revisions: points in history as people write them: a branch, a tag, an id, or a time ----
#
# A time means the newest commit along the first parents that was committed at or before this time.
# A date means the end of its day, and a time without seconds the end of its minute. A time without
# a zone is UTC, like all times that the program prints.

# Examples of the times that parse_time accepts.
TIMES = "2026-01-31T14:03, 2026-01-31, 14:03 (all UTC) or 2h (two hours ago)"

_DATE = re.compile(r"\d{4}-\d{2}-\d{2}")
_CLOCK = re.compile(r"\d{1,2}:\d{2}(:\d{2})?")
_DAY, _MINUTE, _SECOND = timedelta(days=1), timedelta(minutes=1), timedelta(seconds=1)
_REVISION = re.compile(r"([^~^]+)((?:\^|~[0-9]{0,9})*)")
_STEP = re.compile(r"[~^]([0-9]*)")
_ID = re.compile(r"[0-9A-Fa-f]{4,40}")
_WHOLE_ID = 40
_SPACES = ("refs/", "refs/tags/", "refs/heads/", "refs/remotes/")
_BRANCHES_AND_TAGS = ("refs/heads/", "refs/tags/", "refs/remotes/")
_LONGEST = 250  # bytes; a file system takes no longer name of a branch


def parse_time(text: str, now: datetime, *, end: bool = False) -> datetime | None:
    """Return the time that a date, a time of day, both, or a duration before ``now`` names.

    A time of day without a date means its last occurrence before ``now``. With ``end``, a date
    means the end of its day, and a time without seconds the end of its minute.
    """
    text = text.strip()
    if (word := text.lower()) in ("today", "yesterday"):
        day = now.astimezone(timezone.utc) - (_DAY if word == "yesterday" else timedelta())
        text = f"{day:%Y-%m-%d}"
    try:
        return now - timedelta(seconds=seconds_of(text.removesuffix("ago").rstrip()))
    except ValueError:
        pass
    has_no_seconds = re.match(r"\d{1,2}:\d{2}(?!:?\d)", re.split(r"[T ]", text)[-1])
    precision = _DAY if _DATE.fullmatch(text) else _MINUTE if has_no_seconds else _SECOND
    clock = _CLOCK.fullmatch(text)
    if clock:
        hours, minutes = text.split(":", 1)
        text = f"{now.astimezone(timezone.utc):%Y-%m-%d}T{hours:0>2}:{minutes}"
    try:
        time = datetime.fromisoformat(re.sub(r"[Zz]$", "+00:00", text))
        zone = time.tzinfo or timezone.utc
        time = time.replace(tzinfo=zone).astimezone(timezone.utc)
    except (ValueError, OverflowError):
        return None
    if clock and time > now:
        time -= _DAY
    return time + (precision - _SECOND) if end else time


def resolve(repo: Repository, tip: Oid, text: str, now: datetime) -> Commit:
    # The text is from outside: a time, the name of a branch or tag, or 4 to 40 digits of an id. A
    # name or id may be followed by ``~N`` or ``^``, along the first parents. ``HEAD`` is ``tip``.
    # libgit2 never parses the text: its own grammar has searches, some of which crash it.
    text = text.strip(" ")
    is_plain = text.isprintable() and len(text.encode(errors="replace")) <= _LONGEST
    match = _REVISION.fullmatch(text) if is_plain else None
    try:
        commit = _commit_named(repo, tip, match[1], match[2], now) if match else None
    except (KeyError, ValueError, pygit2.GitError) as error:
        raise StateRepoError(
            f"{quoted(text)} names no commit that can be read: {error.args[0]}; name another "
            "commit, or check the repository with `git fsck`"
        ) from None
    if commit is None:
        is_whole = re.fullmatch("[0-9a-f]{40}", text) is not None
        raise StateRepoError(
            f"{quoted(text)} is neither a commit of the state repo nor a time; write a branch, a "
            "tag or 4 to 40 digits of an id, with ~N for the Nth commit before it, or a time like "
            f"{TIMES}; `demandops log` lists the commits"
            + ("; if an earlier audit named this id, the history was rewritten since" * is_whole)
        )
    return commit


def _commit_named(
    repo: Repository, tip: Oid, base: str, steps: str, now: datetime
) -> Commit | None:
    names = _names(repo, base)
    # a branch may be named like a time, such as 2026-01-31
    at = None if names or steps else parse_time(base, now, end=True)
    if at is not None:
        latest = int(at.timestamp())
        for commit in first_parents(repo, tip):
            if commit.commit_time <= latest:
                return commit
        raise BeforeTheFirst(
            f"at {time_text(at)} the state repo did not exist yet; its first commit is of "
            f"{time_text(time_of(commit))}",
            str(commit.id),
        )
    commits = {name: repo.references[name].peel(Commit) for name in names}
    if base == "HEAD":
        commits[base] = commit_of(repo, tip)
    elif _ID.fullmatch(base) and base.lower() in repo:
        named = repo[base.lower()]
        # digits that also begin the id of a file do not make a name ambiguous
        if not names or isinstance(named, Commit):
            commits[f"the commit {named.id}"] = named.peel(Commit)
    if len({commit.id for commit in commits.values()}) > 1:
        raise StateRepoError(
            f"{quoted(base)} is ambiguous: it means {' and '.join(commits)}; write the whole id, "
            "or a whole name that begins with refs/"
        )
    back = sum(int(count or 1) for count in _STEP.findall(steps))
    for commit in commits.values():
        walked = first_parents(repo, commit.id)
        if (ancestor := next(islice(walked, back, None), None)) is None:
            raise StateRepoError(
                f"{quoted(base)} has fewer than {back} commits before it; write a smaller ~N"
            )
        return ancestor
    return None


def _names(repo: Repository, base: str) -> list[str]:
    # whoever may push a branch must not change what a whole id or HEAD means
    if base == "HEAD" or (len(base) == _WHOLE_ID and _ID.fullmatch(base)):
        return []
    valid = [
        name
        for name in (base, *(f"{space}{base}" for space in _SPACES))
        if name.startswith(_BRANCHES_AND_TAGS) and pygit2.reference_is_valid_name(name)
    ]
    names = [name for name in valid if name in repo.references]
    tracked = f"refs/remotes/origin/{base}"  # as in a clone, or a checkout of another branch
    return names or [tracked for _ in valid[:1] if tracked in repo.references]
