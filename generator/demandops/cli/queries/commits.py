"""What commits say: ``demandops log``, ``bookkeeping`` at one, and ``diff`` between two."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from datetime import datetime
from itertools import islice
from typing import Any, get_args

import click

from demandops.base.errors import BeforeTheFirst, InvalidInput, StateRepoError, fault, suggestion
from demandops.base.quoting import quoted
from demandops.base.runtime import REAL
from demandops.cli.formats import Table, list_table, output_formats, output_option, show
from demandops.cli.output import SIGNS, at_option, busy, errors
from demandops.cli.target import name_options, state_repo_option
from demandops.decide.bookkeeping import EntryChange, as_data, bookkeeping_changes
from demandops.decide.bookkeeping import bookkeeping as derive
from demandops.decide.state import MergePreview, ReleaseChange, planned_releases, preview
from demandops.model.demand.demand import Operation
from demandops.render.gitops import CLUSTERS_ROOT
from demandops.repo import reader
from demandops.repo.history import commit_log
from demandops.repo.history.commit_log import LogEntry
from demandops.repo.load import snapshot as snapshots
from demandops.repo.load.snapshot import Snapshot
from demandops.repo.reader import Reader
from demandops.views.kinds import KINDS, event, rows_of
from demandops.views.source import Source
from demandops.views.vocabulary import commit_data

# ---- ``demandops bookkeeping`` ----


@click.command()
@state_repo_option
@at_option
@output_formats("text", "wide", "json")
def bookkeeping(state_repo: str, at: str | None, output: str) -> None:
    """What one of them holds: demandops get demands --requester NAME, and demandops get requesters.

    \b
    Examples:
      demandops bookkeeping
      demandops bookkeeping --at 14:03 -o json
    """
    with reader.opened(state_repo) as repo:
        source = Source.read(repo, loaded(repo, at))
    data = as_data(derive(source.state), source.commit)
    suspended = [row for row in rows_of(source, "claims") if row.item["suspended_by"]]
    waiting = [row for row in rows_of(source, "demands") if row.item["state"] == "waiting"]
    text: list[str | Table] = []
    for title, name, rows in (
        ("Services", "services", rows_of(source, "services")),
        ("Connections", "connections", rows_of(source, "connections")),
        *([("Suspended", "claims", suspended)] if suspended else []),
        *([("Waiting for room", "demands", waiting)] if waiting else []),
    ):
        table = list_table(KINDS[name], rows, source.now, wide=True)
        text += [replace(table, title=title, empty="(nothing)", whole=output == "wide"), ""]
    for node, resources in data.get("nodes", {}).items():
        text += [
            f"{node}: {amounts['requested']} of {amounts['capacity']} {name} requested"
            for name, amounts in resources.items()
        ]
    show(output, data, [*text, f"at {source.commit}"])


# ---- ``demandops diff`` ----


@click.command()
@click.argument("before", metavar="A")
@click.argument("after", metavar="[B]", default="", required=False)
@state_repo_option
@output_option
def diff(before: str, after: str, state_repo: str, output: str) -> None:
    """The command compares the bookkeeping, the releases and other files below clusters/. A and B
    are commits, or times like 2026-01-31T14:03, 2026-01-31, 14:03 (all UTC) or 2h (two hours ago).
    Without B, it shows what has changed since A.

    \b
    Examples:
      demandops diff 1h
      demandops diff 14:03
      demandops diff main~1 main
    """
    if not before.strip():  # as of a variable that is not set
        raise InvalidInput.at("A", "is empty; name a commit or a time")
    with reader.opened(state_repo) as repo:
        try:
            entries, changes = differences(repo, before, after)
        except BeforeTheFirst as error:
            errors.print(f"{error}, which is compared with")
            entries, changes = differences(repo, error.first, after)
    data = {
        "bookkeeping": [asdict(entry) for entry in entries],
        "releases": [asdict(release) for release in changes.releases],
        "other_files": list(changes.other_files),
    }
    bookkeeping_lines = list(entry_lines(entries)) or ["no difference in bookkeeping"]
    lines = [
        *release_lines(changes.releases, "release "),
        *(f"~ file {path}" for path in changes.other_files),
    ]
    show(output, data, [*bookkeeping_lines, *(lines or ["no difference in releases"])])


def differences(
    repo: Reader, before: str, after: str
) -> tuple[tuple[EntryChange, ...], MergePreview]:
    old, new = (loaded(repo, revision) for revision in (before, after))
    commits = str(old.commit), str(new.commit)
    differing = repo.changed_files(*commits, (CLUSTERS_ROOT,))
    texts = (
        {path: text for path in differing if (text := read(path)) is not None}
        for read in map(repo.file_reader, commits)
    )
    entries = bookkeeping_changes(derive(old.state), derive(new.state))
    planned = planned_releases(old.state), planned_releases(new.state)
    return entries, preview(*planned, *texts)


def resolved(repo: Reader, revision: str | None) -> str:
    """Return the id of a commit; if a time names it, say which commit that is."""
    commit, text = repo.commit(revision), revision or ""
    time = commit_log.parse_time(text, REAL.now(), end=True)
    if time is not None and not commit.startswith(text.lower()):
        entry = next(repo.log(commit))
        errors.print(
            f"{text} is {time:%Y-%m-%d %H:%M:%S} UTC: commit {commit[:10]} of "
            f"{entry.time:%Y-%m-%d %H:%M:%S} UTC, {entry.summary}"
        )
    return commit


def loaded(repo: Reader, revision: str | None) -> Snapshot:
    commit = resolved(repo, revision)
    with busy("reading the ledger") as report:
        snapshot = repo.snapshot(commit, report)
    for problem in snapshots.problems_of(repo.objects, snapshot):
        errors.print(f"warning: not in effect: {problem}")
    if snapshot.faults:
        errors.print(f"warning: {in_effect(repo, snapshot)}")
    return snapshot


def in_effect(repo: Reader, snapshot: Snapshot) -> str:
    """Tell which configuration is in effect instead of the newest, and how to change that."""
    return (
        f"the configuration of commit {str(snapshot.configuration)[:10]} stays in effect until a "
        f"commit is valid; {snapshots.how_to_mend(repo.objects, snapshot)}"
    )


def release_lines(releases: Iterable[ReleaseChange], word: str = "") -> Iterator[str]:
    for release in releases:
        yield f"{SIGNS[release.change]} {word}{release.title}"
        yield from (f"    {detail}" for detail in release.details)


def entry_lines(entries: Iterable[EntryChange]) -> Iterator[str]:
    for entry in entries:
        who = "" if entry.change == "changed" else f" for {', '.join(entry.requesters)}"
        yield f"{SIGNS[entry.change]} {entry.kind} {entry.name}{who}"
        yield from (f"    - {fact}" for fact in entry.lost)
        yield from (f"    + {fact}" for fact in entry.gained)


# ---- ``demandops log`` ----

# The operations that `--operation` accepts. `by-hand` selects the commits by people.
OPERATIONS = (
    *get_args(Operation),
    *("follow", "discover", "expire-override", "reject", "upgrade", "init", "by-hand"),
)

# The filters by what the trailers of a commit name.
_NAMED = ("requester", "application", "connection", "demand")


def _named(entry: LogEntry, kind: str) -> Sequence[str]:
    return entry.trailers.get(KINDS[f"{kind}s"].trailer, ())


def time_of(ctx: click.Context, param: click.Parameter, text: str | None) -> datetime | None:
    if text is None:
        return None
    time = commit_log.parse_time(text, REAL.now(), end=param.name == "until")
    if time is None:
        raise click.BadParameter(f"'{text}' is not a time; write it like {commit_log.TIMES}")
    return time


@click.command()
@click.argument("commit_range", required=False, metavar="[REV|A..B]")
@state_repo_option
@name_options(
    {
        "requester": "List only commits about claims or waiting demands of this requester.",
        "application": "List only commits about this application.",
        "connection": "List only commits about this connection.",
        "node": "List only commits that change a release on this node or a claim that names this "
        "node.",
    },
    metavar="ID",
)
@name_options(
    {"release": "List only commits that changed the file of this release."}, metavar="NAME"
)
@name_options({"demand": "List only commits about this demand."}, metavar="ID")
@click.option(
    "--operation",
    type=click.Choice(OPERATIONS),
    metavar="WORD",
    help=f"List only commits of this operation: {', '.join(OPERATIONS[:-1])}. {OPERATIONS[-1]} "
    "means commits by people.",
)
@click.option(
    "--since",
    callback=time_of,
    metavar="TIME",
    help=f"List only commits at or after this time: {commit_log.TIMES}.",
)
@click.option(
    "--until", callback=time_of, metavar="TIME", help="List only commits at or before this time."
)
@click.option(
    "-n",
    "--max-count",
    type=click.IntRange(1),
    default=None,
    help="List at most this many commits.",
)
@output_formats("text", "wide", "json")
def log(
    commit_range: str | None,
    state_repo: str,
    max_count: int | None,
    output: str,
    **given: Any,  # noqa: ANN401 - the filters
) -> None:
    """If you give several filters, a commit must match all of them. REV, A and B are commits, or
    times written as for --since. -o wide adds the absolute times, operations, authors and request
    ids.

    \b
    Examples:
      demandops log -n 10
      demandops log --requester vehicle00 --since 2h
      demandops log --node edge --operation shutdown
      demandops log main~20..main -o wide
    """
    with reader.opened(state_repo) as repo:
        for side in filter(None, (commit_range or "").split("..")):
            try:
                resolved(repo, side)
            except BeforeTheFirst as error:
                errors.print(str(error))
        release, path = given.pop("release"), None
        if release is not None:
            tip = repo.commit((commit_range or "").rpartition("..")[2])
            is_path = "/" in release
            path = release if is_path else commit_log.release_path(repo.objects, tip, release)
            if path is None:
                raise StateRepoError(
                    f"up to commit {tip[:10]}, there was no release {quoted(release)}; "
                    "`demandops status` lists the current ones"
                )
        commits = repo.log(commit_range, path) if path else repo.log(commit_range)
        wanted = [(name, given[name]) for name in (*_NAMED, "node") if given[name] is not None]

        def is_about(entry: LogEntry, kind: str, name: str) -> bool:
            # the trees of a commit are read last
            return name in _named(entry, kind) or (
                (kind == "node" and repo.changes_node(entry.commit, name))
                or (kind != "demand" and repo.edits(entry, kind, name))
            )

        def matches(entry: LogEntry) -> bool:
            return (
                given["operation"] in (None, entry.first("Operation") or "by-hand")
                and (given["since"] is None or entry.time >= given["since"])
                and (given["until"] is None or entry.time <= given["until"])
                and all(is_about(entry, *each) for each in wanted)
            )

        with busy("looking through the commits"):
            if not (entries := list(islice(filter(matches, commits), max_count))):
                _refuse_unknown(repo, given)
    table = log_table(entries, REAL.now(), wide=output == "wide")
    rows = [*map(commit_data, entries)]
    show(output, rows, [table if entries else "no commit matches"])


def _refuse_unknown(repo: Reader, given: dict[str, Any]) -> None:
    # a name that no commit is about is probably misspelled
    names: dict[str, set[str]] = {name: set() for name in _NAMED if given[name] is not None}
    for entry in repo.log() if names else ():
        for name, values in names.items():
            values.update(_named(entry, name))
    faults = []
    for name, values in names.items():
        if (wanted := given[name]) not in values:
            message = f"no commit is about {quoted(wanted)}{suggestion(wanted, values)}"
            faults.append(fault(f"--{name}", message))
    if (node := given["node"]) is not None:
        # no commit needs to have changed a node that the inventory has
        config = repo.snapshot().state.config
        commits = (entry.commit for entry in repo.log())
        if not config.has_node(node) and not any(repo.changes_node(id, node) for id in commits):
            faults.append(fault("--node", f"{quoted(node)} {config.why_no_node(node)}"))
    if faults:
        raise InvalidInput(faults)


def log_table(entries: Iterable[LogEntry], now: datetime, *, wide: bool = False) -> Table:
    kind = KINDS["events"]
    return list_table(kind, [kind.row(event(entry)) for entry in entries], now, wide=wide)
