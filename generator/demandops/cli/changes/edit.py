"""``demandops drain``, ``undrain`` and ``revert``: a person's edits of files, each one commit."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import replace

import click

from demandops.base import strict_yaml
from demandops.base.errors import InvalidInput, StateRepoError, suggestion
from demandops.base.settings import GENERATED_ROOTS
from demandops.base.strict_yaml import faults_in
from demandops.cli.changes import person_change
from demandops.cli.changes.person_change import Options, changing, propose_option, writable
from demandops.cli.target import names_of
from demandops.decide.booking import Drain
from demandops.decide.placement import relocation
from demandops.decide.state import State
from demandops.model.config.config import NODES_FILE
from demandops.model.ledger.claim import LEDGER_ROOT
from demandops.views.vocabulary import Json

# ---- ``demandops drain`` and ``undrain``: the field `drained` of a node in the inventory ----


def _set_drained(node: str, drained: bool, options: Options) -> None:
    with writable(options) as repo:
        config = repo.snapshot().state.config
        if node not in config.nodes:
            message = f"there is no node '{node}'{suggestion(node, config.nodes)}"
            raise InvalidInput.at("NODE", message)
        host, verb = config.host_of(node), "Drain" if drained else "Undrain"
        if config.nodes[host].drained is drained:
            raise StateRepoError(f"'{host}' is {'drained already' if drained else 'not drained'}")
        path = config.file_of(NODES_FILE, host)
        text = repo.file_reader()(path) or ""
        try:
            changed = strict_yaml.set_flag(text, "nodes", host, "drained", drained)
        except InvalidInput as error:
            raise InvalidInput(faults_in(error, path)) from None

        def moves(before: State, after: State) -> tuple[Json, Iterator[str]]:
            # the generator moves what it placed there, in commits of its own
            plan = Drain(id=host)
            if drained:
                plan = relocation.with_moves(plan, after, after.usage(), after.names())
            lines = [*(f"moves: {text}" for text in plan.moved), *plan.stays]
            data = {"node": host, "moved": [*plan.moved], "stays": [*plan.stays]}
            return data, (f"  {line}" for line in lines or ["moves nothing"])

        summary, branch = f"{verb} {host}", f"{verb.lower()}/{host}"
        person_change.commit(repo, {path: changed}, summary, branch, options, moves)


_node = click.argument("node", metavar="NODE", shell_complete=names_of("nodes"))


@click.command()
@_node
@changing(propose_option)
def drain(node: str, options: Options) -> None:
    """Take a node out of use: nothing new is placed there.

    The command sets `drained: true` in the inventory. The generator then moves away what it placed
    on the node. What a demand itself put on the node stays; `demandops release` or `demandops
    decommission` ends that.

    \b
    Examples:
      demandops drain edge --dry-run
      demandops drain edge -m "Maintenance"
    """
    _set_drained(node, True, options)


@click.command()
@_node
@changing(propose_option)
def undrain(node: str, options: Options) -> None:
    """Use a drained node again.

    The command sets `drained: false` in the inventory. What was moved away stays where it is.

    \b
    Examples:
      demandops undrain edge
    """
    _set_drained(node, False, options)


# ---- ``demandops revert``: the files of a person's commit as they were before ----


@click.command()
@click.argument("commit", metavar="COMMIT")
@changing(propose_option)
def revert(commit: str, options: Options) -> None:
    """Undo a person's commit, by a new commit.

    The files that COMMIT changed become what they were before it. If a file has changed since, the
    command changes nothing. A generator's commit is undone by `demandops release` or `demandops
    rollback`, because later demands may build on it.

    \b
    Examples:
      demandops revert 5d41402a --dry-run
      demandops revert main -m "It was the wrong node"
    """
    with writable(options) as repo:
        id = repo.commit(commit)
        entry = next(repo.log(id))
        demands = entry.trailers.get("Demand-Id", ())
        paths = repo.files_changed_by(id)
        booked = [
            path for path in paths if path.split("/", 1)[0] in (LEDGER_ROOT, *GENERATED_ROOTS)
        ]
        if entry.by_generator or booked:
            who = "a generator made it" if entry.by_generator else f"it changes {booked[0]}"
            ways = [f"demandops release {shlex.quote(demand)}" for demand in demands]
            if follows := entry.first("Follows"):  # it carries out what a person committed
                ways.append(f"demandops revert {follows[:10]}")
            ways.append(f"demandops rollback {id[:10]}~1 -m REASON")
            message = (
                f"{id[:10]} is not undone by a revert, because {who}; run: {' or '.join(ways)}"
            )
            raise StateRepoError(message)
        before, after, now = (repo.file_reader(each) for each in (f"{id}~1", id, None))
        if changed := [path for path in paths if now(path) != after(path)]:
            message = f"has changed since commit {id[:10]}; revert it with git, and push"
            raise InvalidInput.at("", message, file=changed[0])
        files = {path: before(path) for path in paths}
        summary = f'Revert "{entry.summary}"'
        reason = f"This reverts commit {id}. {options.reason}".rstrip()
        branch = f"revert/{id[:10]}"
        more = {"reverts": id}
        person_change.commit(
            repo, files, summary, branch, replace(options, reason=reason), lambda *_: (more, ())
        )
