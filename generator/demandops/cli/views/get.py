"""``demandops get``: lists of demands, of running services and of people's configuration."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import click

from demandops.base import strict_yaml
from demandops.base.errors import InvalidInput, fault, suggestion
from demandops.base.naming import SubjectKind
from demandops.base.quoting import json_escaped, quoted
from demandops.base.runtime import REAL
from demandops.cli.json_output import Json, output_formats, print_json, show
from demandops.cli.name_completion import names_of
from demandops.cli.output import at_option, errors, painted, progress, warn_of, warn_of_not_rendered
from demandops.cli.target import state_repo_option
from demandops.cli.views.kinds import KINDS, Kind, Source
from demandops.model.config.policy import matches
from demandops.model.ledger.ledger import World
from demandops.repo import reader
from demandops.repo.git.repository import RemoteAway
from demandops.repo.reader import Reader

FILTERS = ("node", "requester", "application", "domain")
_POLL_S = 1.0
_POLL_REMOTE_S = 10.0  # each look is a fetch
_COLORS = {
    "drained": "yellow",
    "expired": "yellow",
    "held": "green",
    "in force": "green",
    "held back": "yellow",
    "matches nothing": "yellow",
    "not in the inventory": "red",
    "not rendered yet": "yellow",
    "overdue": "yellow",
    "partly suspended": "yellow",
    "suspended": "yellow",
    "waiting": "yellow",
}


def _kind_named(ctx: click.Context, param: click.Parameter, value: str | None) -> str:
    if value is None:
        raise click.UsageError(f"Missing argument 'KIND': one of {', '.join(KINDS)}", ctx)
    for name in (value, f"{value}s"):
        if name in KINDS:
            return name
    raise click.BadParameter(f"there is no kind '{value}'{suggestion(value, KINDS)}")


def _item_names(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    kind = ctx.params.get("kind") or ""
    same = ("connections", "demands", "nodes", "overrides", "proposals")
    kinds = {"leases": "demands", "services": "releases"} | {name: name for name in same}
    return names_of(kinds[kind])(ctx, param, incomplete) if kind in kinds else []


def _filters(command: Callable[..., Any]) -> Callable[..., Any]:
    for name in reversed(FILTERS):
        command = click.option(
            f"--{name}",
            metavar="NAME",
            shell_complete=names_of(f"{name}s"),
            help=f"List only items of this {name}; * matches any text, ? one character.",
        )(command)
    return command


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
@_filters
@at_option
@click.option(
    "-w",
    "--watch",
    is_flag=True,
    help="Print the list again when a new commit or proposal changes it.",
)
@output_formats("text", "wide", "name", "json", "yaml")
def get(
    kind: str,
    names: tuple[str, ...],
    state_repo: str,
    at: str | None,
    watch: bool,
    output: str,
    **filters: str | None,
) -> None:
    """List demands, nodes, services, overrides and so on.

    KIND is demands, leases, nodes, services, connections, claims, proposals or overrides. A
    proposal is a branch that a person merges to approve its demands, or deletes to refuse them.
    NAME and the filters may be patterns with * and ?. If you give several filters, an item must
    match all of them. The state of an override is `in force`, `not rendered yet` (a generator has
    yet to write the files that the override changes), `held back` (another override with hold keeps
    these files as they are), `expired` or `matches nothing`.

    \b
    Examples:
      demandops get demands --requester vehicle00
      demandops get services -o wide
      demandops get nodes --domain perception -o name
      demandops get leases --watch
      demandops get overrides --at 2h -o json
    """
    if watch and at:
        raise click.UsageError("--watch follows the newest commit, so leave out --at")
    shown = KINDS[kind]
    wanted = {name: value for name, value in filters.items() if value is not None}
    for name in wanted.keys() - shown.filters.keys():
        can = ", ".join(f"--{each}" for each in FILTERS if each in shown.filters)
        raise click.UsageError(f"{kind} have no --{name}; they can be filtered by {can}")
    with reader.opened(state_repo) as repo:
        source = _read_source(repo, at)
        items = shown.items(source)
        _refuse_unknown(shown, items, source.snapshot.state, names, wanted)
        items = _matching(shown, items, names, wanted)
        _print_list(kind, source, items, output, watch)
        while watch:
            REAL.sleep(_POLL_S if repo.repository.always_current else _POLL_REMOTE_S)
            try:
                is_same = repo.refresh() == str(source.snapshot.commit)
            except RemoteAway as error:
                errors.print(f"warning: {error}")
                is_same = True
            if is_same and kind != "proposals":  # a proposal is a branch, and no commit on main
                continue
            source = _read_source(repo, None)
            before, items = items, _matching(shown, shown.items(source), names, wanted)
            if items != before:
                _print_list(kind, source, items, output, watch)


def _read_source(repo: Reader, at: str | None) -> Source:
    with progress("reading the ledger") as report:
        snapshot = repo.snapshot(at, report)
    warn_of(repo.problems() if at is None else ())
    not_rendered = repo.not_rendered(snapshot) if at is None else frozenset()
    warn_of_not_rendered(not_rendered)
    return Source(repo, snapshot, REAL.now(), not_rendered)


def _matching(
    kind: Kind, items: Iterable[Json], names: tuple[str, ...], wanted: dict[str, str]
) -> list[Json]:
    return [
        item
        for item in items
        if (not names or matches(item["name"], names))
        and all(
            any(matches(value, (pattern,)) for value in kind.filters[name](item))
            for name, pattern in wanted.items()
        )
    ]


def _refuse_unknown(
    kind: Kind, items: list[Json], world: World, names: tuple[str, ...], wanted: dict[str, str]
) -> None:
    """Refuse names and filters that match nothing: they are probably misspelled."""
    # a filter may match no item if it names something that exists, such as a node without demands
    existing: dict[str, Iterable[str]] = {
        "node": {*world.config.nodes, *world.ledger.indexed_names("node")},
        "domain": world.config.domains,
        "requester": world.ledger.indexed_names("requester"),
        "application": world.ledger.subjects(SubjectKind.APPLICATION),
    }
    asked = [(name, "", {item["name"] for item in items}) for name in names]
    for name, pattern in wanted.items():
        listed = (value for item in items for value in kind.filters[name](item))
        asked.append((pattern, f"--{name}", {*existing[name], *listed}))
    faults = [
        fault(option, f"nothing is called {quoted(pattern)}{suggestion(pattern, candidates)}")
        for pattern, option, candidates in asked
        if not any(matches(name, (pattern,)) for name in candidates)
    ]
    if faults:
        raise InvalidInput(faults)


def _print_list(kind: str, source: Source, items: list[Json], output: str, watch: bool) -> None:
    commit, shown = str(source.snapshot.commit), KINDS[kind]
    data = {"kind": kind, "commit": commit, "items": items}
    plain = json.loads(json.dumps(data))
    if output == "json" and watch:
        click.echo(json_escaped(json.dumps(plain, ensure_ascii=False)))
    elif output == "json":
        print_json(plain)
    elif output == "yaml":
        click.echo(("---\n" if watch else "") + strict_yaml.dump(plain), nl=False)
    elif output == "name":
        show(output, None, [item["name"] for item in items])
    else:
        table = shown.table(items, source.now, wide=output == "wide")
        table = replace(table, empty=f"no {kind}", styles=_COLORS)
        when = f"{source.now:%H:%M:%S} UTC, " if watch else ""
        note = painted(f"{when}at {commit[:10]}", "dim")
        show(output, None, [table, *([note] if watch else [])])
