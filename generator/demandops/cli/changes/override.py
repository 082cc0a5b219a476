"""``demandops override``, ``suspend`` and ``resume``: deviations that a person declares."""

from __future__ import annotations

from datetime import timedelta
from typing import Any

import click

from demandops.base import naming, strict_yaml
from demandops.base.errors import InvalidInput, suggestion
from demandops.base.naming import id_problem
from demandops.base.quoting import quoted
from demandops.base.runtime import REAL
from demandops.base.strict_yaml import read_input
from demandops.cli.authoring.scaffold import document
from demandops.cli.changes import person_change
from demandops.cli.changes.person_change import Edit, EditOptions, selector, writable
from demandops.cli.output import errors
from demandops.cli.target import names_of
from demandops.model.config.base_model import parse_time, seconds_of
from demandops.model.config.load import is_override_name
from demandops.model.config.override import OVERRIDES_ROOT, Override, format_time
from demandops.repo.reader import Reader
from demandops.views.release_causes import Entry

# ---- ``demandops override``: create or end an override ----


@click.group()
def override() -> None:
    """Create and end overrides: deviations that people declare.

    \b
    Examples:
      demandops override create calm --node edge --hold -m "Demonstration"
      demandops override end calm
      demandops get overrides
    """


def _new_name(ctx: click.Context, param: click.Parameter, name: str) -> str:
    if not is_override_name(name):
        raise click.BadParameter(
            f"{quoted(name)} is not a valid override name; use at most 63 lower-case letters, "
            "digits and '-', with no '-' at the start or end"
        )
    return name


@override.command()
@click.argument("name", metavar="NAME", callback=_new_name)
@person_change.selecting
@click.option("--hold", is_flag=True, help="Keep the rendered files as they are.")
@click.option("--deny", is_flag=True, help="Refuse demands, and suspend existing claims.")
@click.option("--keep", is_flag=True, help="Keep services running after their last demand ends.")
@click.option("--replicas", type=click.IntRange(0), metavar="N", help="Set the number of replicas.")
@click.option("--on", "target", metavar="NODE", help="Move services to this node.")
@click.option(
    "--use-version", "version", metavar="WORD", help="Pin the chart to a version or channel."
)
@click.option(
    "--values",
    "values_file",
    metavar="FILE",
    help="Patch Helm values with this YAML file; with --connection, the settings of clients.",
)
@click.option(
    "--priority",
    type=int,
    metavar="N",
    help="If several overrides match, the one with the highest priority wins. Default: 0.",
)
@click.option(
    "--expires",
    metavar="TIME",
    help="When the override ends: 2h, 3d, or a time like 2027-01-31T18:00:00Z.",
)
@click.option("--owner", metavar="NAME", help="Who is responsible. Default: your name in git.")
@person_change.editing
def create(  # noqa: PLR0913, PLR0917 - each is an option
    name: str,
    hold: bool,
    deny: bool,
    keep: bool,
    replicas: int | None,
    target: str | None,
    version: str | None,
    values_file: str | None,
    priority: int | None,
    expires: str | None,
    owner: str | None,
    options: EditOptions,
    **selected: tuple[str, ...],
) -> None:
    """Create an override.

    The command commits the override to main in your own name, as git knows it. With --propose, it
    commits to a branch instead. The options from --application to --requester select what the
    override applies to. Different options must all match; of a repeated option, one value must
    match (docs/overrides.md).

    \b
    Examples:
      demandops override create calm --node edge --hold -m Demonstration --propose
      demandops override create more --service tracker --replicas 2 -m Load
      demandops override create late --node edge --keep -m Tests --expires 2d
    """
    values = None
    if values_file is not None:
        file, content = read_input(values_file)
        values = strict_yaml.load(content, file)
        if not isinstance(values, dict):
            raise InvalidInput.at("", "must be a mapping of Helm values", file=file)
    effects: dict[str, Any] = {
        "values": values,
        "version": version,
        "replicas": replicas,
        "node": target,
        "hold": hold or None,
        "deny": deny or None,
        "keep": keep or None,
    }
    more = {"owner": owner, "priority": priority, "expires": ends_at(expires)}
    create_override(name, f"Create override {name}", selected, {**more, **effects}, options)


@override.command()
@click.argument("name", metavar="NAME", shell_complete=names_of("overrides"))
@person_change.editing
def end(name: str, options: EditOptions) -> None:
    """End an override: remove its file.

    The releases that the override changed are rendered again without it.

    \b
    Examples:
      demandops override end calm -m "The demonstration is over"
      demandops override end calm --dry-run
    """
    with writable(options.state_repo, options.signing_key, dry_run=options.dry_run) as repo:
        end_override(repo, Edit(name, None, f"End override {name}", options.reason), options)


def create_override(
    name: str,
    summary: str,
    selected: dict[str, tuple[str, ...]],
    more: dict[str, Any],
    options: EditOptions,
) -> None:
    with writable(options.state_repo, options.signing_key, dry_run=options.dry_run) as repo:
        if not options.reason:
            raise click.UsageError("give the reason: -m TEXT")
        if not (chosen := selector(selected)):
            raise click.UsageError("select what the override applies to, for example --node edge")
        owner = more.get("owner")
        if not owner:
            # a name in git may have characters that an owner may not have
            person = repo.operator()
            owner = person.email if id_problem(person.name) else person.name
        fields = {"reason": options.reason, **more, "owner": owner, "select": [chosen]}
        text = override_text(name, fields)
        edit = Edit(name, text, summary, options.reason)
        if repo.file_reader()(edit.path) is not None:
            message = "exists already; end it first, or choose another name"
            raise InvalidInput.at("", message, file=edit.path)
        entry = person_change.consequence(repo, edit)
        if entry.state == "matches nothing":
            errors.print(f"warning: {edit.path} has no effect on anything that is demanded now")
        elif entry.state in ("held back", "expired"):
            errors.print(f"warning: {edit.path} is {entry.state}, so it changes nothing now")
        _carry_out(repo, edit, entry, options)


def override_text(name: str, fields: dict[str, Any], note: str = "") -> str:
    given = {key: value for key, value in fields.items() if value is not None}
    return document(f"{OVERRIDES_ROOT}/{name}.yaml", "override", "Override", given, note)


def end_override(repo: Reader, edit: Edit, options: EditOptions) -> None:
    overrides = repo.snapshot().state.config.overrides
    if edit.name not in overrides and repo.file_reader()(edit.path) is not None:
        message = "is not valid, so nothing is overridden; correct or remove the file with git"
        raise InvalidInput.at("", message, file=edit.path)
    if edit.name not in overrides:
        message = f"there is no override '{edit.name}'{suggestion(edit.name, overrides)}"
        raise InvalidInput.at("", message)
    _carry_out(repo, edit, person_change.consequence(repo, edit), options)


def _carry_out(repo: Reader, edit: Edit, entry: Entry, options: EditOptions) -> None:
    if options.output == "text":
        errors.print(f"{edit.summary} ({edit.path})")
        verb = "affects" if edit.text is not None else "no longer affects"
        lines = [f"  {verb} {release.name} ({release.description})" for release in entry.releases]
        lines += [f"  {verb} {claim.subject} of demand {claim.demand}" for claim in entry.claims]
        for line in lines or ["  affects nothing now"]:
            errors.print(line)
    published = None
    if not options.dry_run:
        person_change.confirm("Continue?", options.yes, options.output)
        published = person_change.carry_out(repo, edit, options.propose)
    person_change.print_edit(edit, entry, published, options.output)


def ends_at(text: str | None) -> str | None:
    if text is None:
        return None
    try:
        end = REAL.now() + timedelta(seconds=seconds_of(text))
        return format_time(end.replace(microsecond=0))
    except ValueError:
        pass
    try:
        return format_time(parse_time(text))
    except ValueError as error:
        raise click.BadParameter(
            f"{error}, or a duration like 2h", param_hint="--expires"
        ) from None


# ---- ``demandops suspend``: an override that denies applications and connections ----


def name_of(selected: dict[str, tuple[str, ...]]) -> str:
    # equal selections get the same name, so that `resume` finds the override
    chosen = sorted((kind, sorted(values)) for kind, values in selector(selected).items())
    words = "-".join(value for _, values in chosen for value in values)
    return "suspend-" + naming.slug_with_hash(words, repr(chosen), 6)


def selects(override: Override, selected: dict[str, tuple[str, ...]]) -> bool:
    # another override may have the same name
    selectors = [select.model_dump(exclude_none=True) for select in override.select]
    return [{kind: {*values} for kind, values in select.items()} for select in selectors] == [
        {kind: {*values} for kind, values in selector(selected).items()}
    ]


@click.command()
@person_change.selecting
@click.option(
    "--expires",
    metavar="TIME",
    help="When the suspension ends: 2h, 3d, or a time like 2027-01-31T18:00:00Z.",
)
@person_change.editing
def suspend(expires: str | None, options: EditOptions, **selected: tuple[str, ...]) -> None:
    """Stop applications and connections; their claims stay booked.

    Nothing runs for these claims, and new demands that match the options are refused. To end the
    suspension, give `demandops resume` the same selection, such as --requester vehicle00. The
    command creates an override with `deny` in your own name.

    \b
    Examples:
      demandops suspend --requester vehicle00 -m "In the workshop"
      demandops suspend --application 'edge/*' --expires 2h -m "Service"
      demandops suspend --connection vehicle00/edge -m "Too much data" --propose
    """
    effect = {"expires": ends_at(expires), "deny": True}
    summary = f"Suspend {described(selected)}"
    create_override(name_of(selected), summary, selected, effect, options)


def described(selected: dict[str, tuple[str, ...]]) -> str:
    return ", ".join(
        f"{kind.removesuffix('s')} {value}"
        for kind, values in selector(selected).items()
        for value in values
    )


# ---- ``demandops resume``: end an override that ``demandops suspend`` made ----


@click.command()
@click.argument("name", required=False, metavar="[NAME]", shell_complete=names_of("overrides"))
@person_change.selecting
@person_change.editing
def resume(name: str | None, options: EditOptions, **selected: tuple[str, ...]) -> None:
    """Run suspended applications and connections again.

    Give the same selection as for `demandops suspend`, such as --requester vehicle00, or NAME, the
    override's name. The command ends this override.

    \b
    Examples:
      demandops resume --requester vehicle00
      demandops resume suspend-vehicle00-1c2f3a
    """
    if bool(name) == bool(selector(selected)):
        raise click.UsageError(
            "give either the options of `demandops suspend`, or the override's name"
        )
    summary = f"Resume {name or described(selected)}"
    edit = Edit(name or name_of(selected), None, summary, options.reason)
    with writable(options.state_repo, options.signing_key, dry_run=options.dry_run) as repo:
        overrides = repo.snapshot().state.config.overrides
        override = overrides.get(edit.name)
        # a person may have changed what the file selects since it was suspended
        if override and not name and not selects(override, selected):
            message = f"selects something else; to end it, run: demandops resume {edit.name}"
            raise InvalidInput.at("select", message, file=edit.path)
        end_override(repo, edit, options)
