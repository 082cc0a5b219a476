"""Completers for names from the state repo, by which a shell completes a command's arguments."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import click

from demandops.base.naming import SubjectKind
from demandops.cli.target import readable_repo
from demandops.repo import reader
from demandops.repo.reader import Reader
from demandops.repo.write.proposal_branch import pending_proposals
from demandops.views import release_causes

Complete = Callable[[click.Context, click.Parameter, str], list[str]]


def names_of(*kinds: str) -> Complete:
    """Return a completer for names of these kinds; it offers no names if an error occurs."""

    def complete(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
        try:
            with ctx.scope(cleanup=False):
                address = ctx.params.get("state_repo") or readable_repo()
            if not address:
                return []
            # offline, because a shell waits for the names while a person types
            with reader.opened_offline(address) as repo:
                names = {name for kind in kinds for name in _names(repo, kind)} if repo else set()
            return sorted(name for name in names if name.startswith(incomplete))
        except Exception:  # an error must not disturb a person who is typing
            return []

    return complete


def _names(repo: Reader, kind: str) -> Iterator[str]:
    if kind == "proposals":
        yield from (proposal.branch for proposal in pending_proposals(repo.repository))
        return
    world = repo.last_valid_snapshot(repo.commit()).state
    if kind == "releases":
        yield from (release.name for release in release_causes.releases(world))
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
