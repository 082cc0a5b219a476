"""Completers for names from the state repo, by which a shell completes a command's arguments."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import click

from demandops.cli.target import readable_repo
from demandops.plan.views import release_causes
from demandops.staterepo import reader
from demandops.staterepo.reader import Reader
from demandops.staterepo.write.proposal_branch import pending_proposals
from demandops.subject import SubjectKind

Complete = Callable[[click.Context, click.Parameter, str], list[str]]


def names_of(*kinds: str) -> Complete:
    """Return a completer for names of these kinds; it offers no names if an error occurs."""

    def complete(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
        try:
            return sorted(name for name in _names(ctx, kinds) if name.startswith(incomplete))
        except Exception:  # an error must not disturb a person who is typing
            return []

    return complete


def _names(ctx: click.Context, kinds: tuple[str, ...]) -> set[str]:
    with ctx.scope(cleanup=False):
        address = ctx.params.get("state_repo") or readable_repo()
    if not address:
        return set()
    with reader.opened_offline(address) as repo:
        return {name for kind in kinds for name in _of(repo, kind)} if repo else set()


def _of(repo: Reader, kind: str) -> Iterator[str]:
    if kind == "proposals":
        yield from (one.branch for one in pending_proposals(repo.repository))
        return
    world = repo.last_valid_snapshot(repo.commit()).state
    if kind == "releases":
        yield from (one.name for one in release_causes.releases(world))
    elif kind in ("requesters", "demands"):
        yield from world.ledger.indexed_names(kind[:-1])
    elif kind in ("applications", "connections"):
        yield from world.ledger.subjects(SubjectKind(kind))
    else:
        yield from {
            "nodes": world.config.nodes,
            "domains": world.config.domains,
            "overrides": world.config.overrides,
            "appdefs": world.config.appdefs,
            "services": {name: 0 for each in world.config.services.values() for name in each},
        }[kind]
