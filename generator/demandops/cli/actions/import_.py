"""``demandops import``: book the reference's applications and connections as ordinary demands.

The reference is the application manager of the paper (docs/reference.md).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import click

from demandops import strict_yaml
from demandops.cli.actions.request import Document, book_or_show
from demandops.cli.json_output import output_option, show
from demandops.cli.output import busy, errors
from demandops.cli.target import (
    clusters_option,
    dry_run_option,
    signing_option,
    writable_repo_option,
)
from demandops.cluster import clusters_file
from demandops.cluster.health.release_health import ObjectSelector
from demandops.cluster.object_cache import ObjectCache
from demandops.config.base_model import parse_file
from demandops.errors import InvalidInput, fault
from demandops.field_lines import located_in
from demandops.input_file import read_input
from demandops.migration import imported_goals, reference_files, reference_map
from demandops.migration.remaining_joins import Join
from demandops.staterepo import reader


@click.command("import")
@click.argument("files", nargs=-1, metavar="[FILE…]")
@writable_repo_option
@click.option(
    "--map",
    "map_file",
    required=True,
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="The file that maps the reference's names to applications and connections. If the file "
    "does not exist, the command writes a proposed map to it, even with --dry-run, and books "
    "nothing.",
)
@dry_run_option
@click.option(
    "--cluster",
    metavar="NAME",
    help="Read the custom resources from this cluster. The file of --clusters must list it.",
)
@click.option(
    "--namespace",
    default="default",
    show_default=True,
    metavar="NAME",
    help="The namespace of the custom resources in the cluster.",
)
@clusters_option
@signing_option
@output_option
def import_(  # noqa: PLR0913, PLR0917 - each is an option
    files: tuple[str, ...],
    state_repo: str,
    map_file: Path,
    dry_run: bool,
    cluster: str | None,
    namespace: str,
    access_file: Path | None,
    signing_key: Path | None,
    output: str,
) -> None:
    """Import bookings from the paper's application manager.

    The options and docs call this manager the reference. FILE is a bookkeeping or versioning file
    of one of the reference's operators, or a file with the reference's custom resources as
    `kubectl get -o yaml` prints them. Write - for standard input. docs/migration.md explains each
    step. If you import the same files again, the command books nothing more.

    \b
    Examples:
      demandops import --map map.yaml bookkeeping.yaml --dry-run
      demandops import --map map.yaml --clusters clusters.yaml --cluster c-its
    """
    documents = [(name, data) for file in files for name, data in _documents(file)]
    if cluster:
        documents += _resources(access_file, cluster, namespace)
    if not documents:
        raise click.UsageError("nothing to import: give FILE or --cluster")
    found = reference_files.read(documents)
    joins, warnings = imported_goals.remaining_joins(found)
    for warning in warnings:
        errors.print(f"warning: {warning}")
    if not joins:
        message = (
            "nothing to import: no file or resource names a requester of an application or of a "
            "connection"
        )
        raise InvalidInput([fault("", message)])
    if not map_file.exists():
        _propose(joins, found, map_file, state_repo, output)
        return
    name, text = read_input(map_file)
    with located_in(text):
        mapped = parse_file(reference_map.ReferenceMap, text, name)
    goals = [Document(name, goal) for goal in imported_goals.goals(joins, mapped, name)]
    book_or_show(goals, state_repo, dry_run, False, signing_key, output)


def _documents(file: str) -> Iterator[tuple[str, object]]:
    name, text = read_input(file)
    documents = list(strict_yaml.load_all(text, name))
    yield from ((name, data) for data in documents or [None])


def _resources(access_file: Path | None, name: str, namespace: str) -> list[tuple[str, object]]:
    """Return one pair: a name for messages, and a List of the reference's resources."""
    clusters = clusters_file.read(access_file).clusters if access_file else {}
    reachable = clusters.get(name)
    if reachable is None or not reachable.kubeconfig:
        known = ", ".join(one for one, way in clusters.items() if way.kubeconfig) or "none"
        message = (
            f"'{name}' has no kubeconfig in the file of --clusters; clusters that have one: {known}"
        )
        raise click.UsageError(f"--cluster: {message}")
    cache = ObjectCache(name, reachable, lambda: None)
    wanted = [ObjectSelector(kind, namespace) for kind in reference_files.KINDS]
    with busy(f"asking cluster '{name}'"):
        cache.read_once(wanted)
    if problem := cache.why_unknown(wanted):
        raise InvalidInput([fault("", f"cannot be read: {problem}").within(f"cluster {name}")])
    items = [{"kind": key[0], **item} for key, item in sorted(cache.objects().items())]
    return [(f"cluster {name}", {"kind": "List", "items": items})]


def _propose(
    joins: dict[str, list[Join]],
    found: reference_files.ReferenceFiles,
    map_file: Path,
    state_repo: str,
    output: str,
) -> None:
    with reader.opened(state_repo) as repo:
        config = repo.snapshot().state.config
    data, warnings = reference_map.propose(joins, found, config)
    for warning in warnings:
        errors.print(f"warning: {warning}")
    map_file.write_text(strict_yaml.dump(data))
    rows = [
        f"  {name}: {one['id'] or '?'}"
        for kind in ("applications", "connections")
        for name, one in data[kind].items()
    ]
    text = [f"wrote {map_file}; nothing is booked", *rows]
    text.append(
        "The reference does not record these ids, so compare each with the id that your clients "
        "send. Fill in the empty fields of the map. Then run the same command with --dry-run."
    )
    show(output, {"map": str(map_file), "proposed": data}, text)
