"""``demandops get``: what there is, as a table or for programs, with filters and ``--watch``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import click

from demandops.base import settings
from demandops.base.errors import InvalidInput, fault, suggestion
from demandops.base.naming import SubjectKind
from demandops.base.quoting import quoted
from demandops.base.runtime import REAL
from demandops.base.settings import MAIN_BRANCH
from demandops.cli import formats
from demandops.cli.formats import Table, list_table
from demandops.cli.output import at_option, errors, warn_of_not_rendered
from demandops.cli.queries.commits import loaded, time_of
from demandops.cli.queries.status import ask_clusters
from demandops.cli.target import name_options, names_of, state_repo_option
from demandops.cluster import clusters_file
from demandops.model.config.base_model import matches, parse_time
from demandops.model.config.repo_settings import Proposals
from demandops.repo import reader
from demandops.repo.forge import ForgeError, forge_for
from demandops.repo.git.repository import RemoteAway
from demandops.repo.reader import Reader
from demandops.repo.write.proposal_branch import pending_proposals
from demandops.views.kinds import KINDS, Kind, past_rows, rows_of
from demandops.views.rows import Filter, Row, exactly, sorted_rows
from demandops.views.source import Source

FILTERS = ("node", "requester", "application", "domain")


# What people mean by other words.
_MEANT = {"app": "applications", "commit": "events", "type": "appdefs", "vehicle": "nodes"}
# The kind whose names a shell completes for another kind.
_SAME_NAMES = {"leases": "demands", "services": "releases"}


def _kind_named(ctx: click.Context, param: click.Parameter, value: str | None) -> str:
    if value is None:
        raise click.UsageError(f"Missing argument 'KIND': one of {', '.join(KINDS)}", ctx)
    word = value.lower().removesuffix("s")
    if (name := _MEANT.get(word, f"{word}s")) in KINDS:
        return name
    raise click.BadParameter(
        f"there is no kind '{value}'{suggestion(value, KINDS)}; the kinds are {', '.join(KINDS)}"
    )


def _item_names(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    kind = ctx.params.get("kind") or ""
    return names_of(_SAME_NAMES.get(kind, kind))(ctx, param, incomplete)


@click.command()
@click.argument(
    "kind",
    required=False,
    callback=_kind_named,
    shell_complete=lambda ctx, param, text: [name for name in KINDS if name.startswith(text)],
    metavar="KIND",
)
@click.argument("names", nargs=-1, metavar="[NAME…]", shell_complete=_item_names)
@state_repo_option
@name_options(
    {
        name: f"List only items of this {name}; * matches any text, ? one character."
        for name in FILTERS
    },
    metavar="NAME",
)
@click.option(
    "-l",
    "--selector",
    "selectors",
    multiple=True,
    metavar="LABEL=VALUE,…",
    help="List only items that have all these labels, such as state=suspended,type=vehicle. The "
    "labels are the keys of -o json, and of lists in the singular.",
)
@click.option("--sort-by", metavar="COLUMN", help="A column, or -COLUMN for the reverse order.")
@click.option("--gone", is_flag=True, help="List what is not there any more, and who ended it.")
@click.option(
    "--since",
    callback=time_of,
    metavar="TIME",
    help="List only events at or after this time, and other items that began then: 2h, 14:03.",
)
@at_option
@click.option(
    "--clusters",
    "access_file",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Ask the clusters of this file for the health (docs/status.md).",
)
@click.option(
    "-w",
    "--watch",
    is_flag=True,
    help="Print the list again when a new commit or proposal changes it.",
)
@formats.output_formats("text", "wide", "name", "json", "yaml", "jsonpath=…")
def get(
    kind: str,
    names: tuple[str, ...],
    state_repo: str,
    at: str | None,
    watch: bool,
    output: str,
    **asked: Any,  # noqa: ANN401 - the other options
) -> None:
    """KIND is demands, applications, releases, services, connections, leases, requesters, nodes,
    domains, appdefs, claims, overrides, proposals or events. A proposal is a branch that a person
    merges to approve its demands, or deletes to refuse them. NAME and the values of filters may be
    patterns with * and ?. If you give several filters, an item must match all of them. The state of
    an override is `in force`, `not rendered yet` (a generator has yet to write the files that the
    override changes), `held back` (another override with hold keeps these files as they are),
    `expired` or `matches nothing`.

    \b
    Examples:
      demandops get demands --requester vehicle00
      demandops get releases -l cluster=edge --sort-by node
      demandops get demands --gone
      demandops get events --since 2h
      demandops get nodes --domain perception -o name
      demandops get releases -o jsonpath='{.items[*].name}'
      demandops get leases --watch
      demandops get overrides --at 2h -o json
    """
    if watch and at:
        raise click.UsageError("--watch follows the newest commit, so leave out --at")
    listed = KINDS[kind]
    if asked["gone"] and (watch or not listed.has_past):
        past = ", ".join(name for name, each in KINDS.items() if each.has_past)
        raise click.UsageError(f"--gone lists {past}, without --watch")
    wanted = _labels_wanted(asked)
    since: datetime | None = asked["since"]
    columns, sort_by = {column.key: column for column in listed.columns}, asked["sort_by"] or ""
    by = sort_by.removeprefix("-").lower()
    if sort_by and by not in columns:
        raise click.UsageError(f"--sort-by: {kind} have the columns {', '.join(columns)}")
    clusters = clusters_file.read(file).clusters if (file := asked["access_file"]) else {}

    def read(repo: Reader, at: str | None) -> Source:
        snapshot = loaded(repo, at)
        source = Source.read(repo, snapshot, is_newest=at is None)
        if at is None:
            warn_of_not_rendered(source.not_rendered)
        if kind == "proposals":
            source = _with_proposals(source, repo)
        return ask_clusters(source, repo, clusters) if clusters else source

    chosen = Filter(" ".join(exactly(label, value) for label, value, _ in wanted))

    def is_chosen(row: Row) -> bool:
        began = row.item.get("time") or row.item.get("since")
        return (
            (not names or any(matches(name, names) for name in row.labels[listed.word]))
            and chosen.matches(row)
            and (since is None or not began or parse_time(began) >= since)
        )

    def choose(rows: list[Row]) -> list[Row]:
        rows = [*filter(is_chosen, rows)]
        return sorted_rows(rows, columns[by], source.now, down=sort_by != by) if sort_by else rows

    with reader.opened(state_repo) as repo:
        source, end = read(repo, at), ""
        rows = rows_of(source, kind)
        if asked["gone"]:
            rows, end = past_rows(source, kind)
        _refuse_unknown(listed, rows, source, names, wanted, gone=asked["gone"])
        rows = choose(rows)
        _print_list(listed, source, rows, output, watch, gone=asked["gone"])
        if end:
            errors.print(f"searched back to commit {end[:10]}; --at {end[:10]} goes on from there")
        while watch:
            # each look at a remote is a fetch
            REAL.sleep(1.0 if repo.repository.always_current else 10.0)
            try:
                is_same = repo.refresh() == source.commit
            except RemoteAway as error:
                errors.print(f"warning: {error}")
                is_same = True
            # a proposal is a branch, and no commit on main; a cluster changes by itself
            if is_same and kind != "proposals" and not clusters:
                continue
            source = read(repo, None)
            before, rows = rows, choose(rows_of(source, kind))
            if [row.item for row in rows] != [row.item for row in before]:
                _print_list(listed, source, rows, output, watch)


def _labels_wanted(asked: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    # each with the option that names it
    wanted = [(name, asked[name], f"--{name}") for name in FILTERS if asked[name] is not None]
    for selector in filter(None, ",".join(asked["selectors"]).split(",")):
        label, equals, value = selector.partition("=")
        if not (label and equals and value.lstrip("=")):
            raise click.UsageError(f"--selector: {quoted(selector)} is not LABEL=VALUE")
        wanted.append((label.strip(), value.lstrip("=").strip(), "--selector"))
    return wanted


def _with_proposals(source: Source, repo: Reader) -> Source:
    """Add the open proposals; without a forge, a token or an answer they have no links."""
    pending = tuple(pending_proposals(repo.repository))
    links, token_file = dict[str, str | None](), settings.forge_token_file()
    if pending and token_file is not None:
        try:
            configured = repo.config().repo_settings.proposals
        except InvalidInput:
            configured = Proposals()
        try:
            forge = forge_for(configured, token_file)
            for proposal in pending:
                request = forge.find(proposal.branch, MAIN_BRANCH) if forge else None
                links[proposal.branch] = request.link if request else None
        except ForgeError as error:
            errors.print(f"warning: {error}")
    return replace(source, proposals=pending, proposal_links=links)


def _refuse_unknown(
    kind: Kind,
    rows: list[Row],
    source: Source,
    names: tuple[str, ...],
    wanted: Sequence[tuple[str, str, str]],
    *,
    gone: bool,
) -> None:
    # what matches nothing is probably misspelled
    # a filter may match no item if it names something that exists, such as a node without demands
    ledger, config = source.state.ledger, source.config
    existing: dict[str, Iterable[str]] = {
        "node": {*config.kinds, *ledger.indexed_names("node")},
        "domain": config.domains,
        "requester": ledger.indexed_names("requester"),
        "application": ledger.subjects(SubjectKind.APPLICATION),
        "cluster": config.clusters,
    }
    labels = {label for row in rows for label in row.labels}
    if wanted and not rows:  # then what some kind of thing has is no mistake
        labels = {label for name in KINDS for row in rows_of(source, name) for label in row.labels}
        labels |= {column.key.removesuffix("s") for column in kind.columns} | {*FILTERS, kind.word}
    asked = [(name, kind.word, "", {row.item["name"] for row in rows}) for name in names]
    for label, pattern, option in wanted:
        if label == "health" and rows and label not in labels:
            raise click.UsageError(
                f"{option}: the health is that of clusters: give --clusters FILE"
            )
        if label not in labels:
            raise click.UsageError(
                f"{option}: {kind.name}{' that are gone' if gone else ''} have no {label}; they "
                f"have {', '.join(sorted(labels))}"
            )
        listed = (text for row in rows for text in row.labels.get(label, ()))
        if rows or label in existing:
            asked.append((pattern, label, option, {*existing.get(label, ()), *listed}))

    def is_in(names: Iterable[str], pattern: str) -> bool:
        return any(matches(name.casefold(), (pattern.casefold(),)) for name in names)

    faults = []
    for pattern, label, option, candidates in asked:
        if is_in(candidates, pattern) or (label == "node" and config.has_node(pattern)):
            continue
        of = KINDS.get(f"{label}s")
        past = past_rows(source, of.name)[0] if of and of.has_past else []
        if not is_in([row.item["name"] for row in past], pattern):
            # a vehicle is a node too, but claims are asked for by requester
            filters = sorted(FILTERS, key="requester".__ne__)
            other = next((word for word in filters if is_in(existing[word], pattern)), "")
            hint = suggestion(pattern, candidates)
            if other and not option:
                hint = f"; to list those of the {other}: --{other} {quoted(pattern)}"
            faults.append(fault(option, f"nothing is called {quoted(pattern)}{hint}"))
        elif of and not gone:
            way = "add --gone" if kind.has_past else f"demandops get {of.name} --gone"
            faults.append(fault(option, f"{quoted(pattern)} is gone; to see it: {way}"))
    if faults:
        raise InvalidInput(faults)


def _print_list(
    kind: Kind, source: Source, rows: list[Row], output: str, watch: bool, *, gone: bool = False
) -> None:
    items = [row.item for row in rows]
    data = {"kind": kind.name, "commit": source.commit, "items": items}
    if watch and output == "json":
        click.echo(formats.json_text(data))
        return
    if watch and output == "yaml":
        click.echo("---")
    shown: list[str | Table] = [item["name"] for item in items]
    if output in ("text", "wide"):
        table = list_table(kind, rows, source.now, wide=output == "wide")
        more = "; --gone lists what was" if kind.has_past and not gone else ""
        shown = [replace(table, empty=table.empty + more)]
        shown += [f"{source.now:%H:%M:%S} UTC, at {source.commit[:10]}"] if watch else []
    formats.show(output, data, shown)
