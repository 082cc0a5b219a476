"""``demandops override``, ``suspend`` and ``resume``: deviations that a person declares."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from datetime import timedelta
from functools import wraps
from pathlib import Path
from typing import Any

import click

from demandops.base import naming, settings, strict_yaml
from demandops.base.errors import InvalidInput, suggestion
from demandops.base.naming import id_problem
from demandops.base.quoting import harmless, one_line, quoted
from demandops.base.runtime import REAL
from demandops.base.settings import MAIN_BRANCH
from demandops.base.strict_yaml import read_input
from demandops.cli import json_output, target
from demandops.cli.changes import person_change
from demandops.cli.changes.person_change import writable
from demandops.cli.output import done, errors, progress
from demandops.cli.target import names_of
from demandops.decide.override_report import override_report
from demandops.model.config.base_model import document, parse_file, parse_time, seconds_of
from demandops.model.config.load import is_override_name
from demandops.model.config.override import OVERRIDES_ROOT, Override, OverrideFile, format_time
from demandops.model.ledger.ledger import World
from demandops.repo.forge import ForgeError, forge_for
from demandops.repo.reader import Reader
from demandops.repo.write import person_commit
from demandops.repo.write.person_commit import CommitDetails, Published
from demandops.serve.approvals.proposal import merge_request
from demandops.views import vocabulary
from demandops.views.vocabulary import Json

# ---- what the commands share: their options and selection ----


@dataclass(frozen=True, slots=True)
class EditOptions:
    state_repo: str
    signing_key: Path | None
    reason: str
    propose: bool
    dry_run: bool
    yes: bool
    output: str


def editing(command: target.Command) -> target.Command:
    # the command gets the values of these options as `options`

    @wraps(command)
    def run(**given: Any) -> Any:  # noqa: ANN401
        options = EditOptions(
            **{field.name: given.pop(field.name) for field in fields(EditOptions)}
        )
        return command(options=options, **given)

    return target.with_options(
        person_change.reason_option,
        click.option(
            "--propose",
            is_flag=True,
            help="Push a branch instead of committing to main. If demandops.yaml names a forge, "
            "also open a merge request.",
        ),
        target.dry_run_option,
        person_change.yes_option,
        target.writable_repo_option,
        target.signing_option,
        json_output.output_option,
    )(run)


selecting = target.name_options(
    {
        name: f"Select this {name}; * matches any text, ? one character. May be repeated."
        for name in ("application", "appdef", "service", "connection", "node", "requester")
    },
    metavar="NAME",
    multiple=True,
)


def selector(given: Mapping[str, Iterable[str]]) -> dict[str, list[str]]:
    return {name: list(values) for name, values in given.items() if values}


effect_options = target.with_options(
    click.option("--hold", is_flag=True, help="Keep the rendered files as they are."),
    click.option("--deny", is_flag=True, help="Refuse demands, and suspend existing claims."),
    click.option(
        "--keep", is_flag=True, help="Keep services running after their last demand ends."
    ),
    click.option(
        "--replicas", type=click.IntRange(0), metavar="N", help="Set the number of replicas."
    ),
)

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
@selecting
@effect_options
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
@editing
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
@editing
def end(name: str, options: EditOptions) -> None:
    """End an override: remove its file.

    The releases that the override changed are rendered again without it.

    \b
    Examples:
      demandops override end calm -m "The demonstration is over"
      demandops override end calm --dry-run
    """
    with writable(options.state_repo, options.signing_key, dry_run=options.dry_run) as repo:
        end_override(repo, name, f"End override {name}", options)


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
        if repo.file_reader()(_path_of(name)) is not None:
            message = "exists already; end it first, or choose another name"
            raise InvalidInput.at("", message, file=_path_of(name))
        _carry_out(repo, name, override_text(name, fields), summary, options)


def _path_of(name: str) -> str:
    return f"{OVERRIDES_ROOT}/{name}.yaml"


def override_text(name: str, fields: dict[str, Any], note: str = "") -> str:
    given = {key: value for key, value in fields.items() if value is not None}
    return document(_path_of(name), "override", "Override", given, note)


def end_override(repo: Reader, name: str, summary: str, options: EditOptions) -> None:
    overrides = repo.snapshot().state.config.overrides
    if name not in overrides and repo.file_reader()(_path_of(name)) is not None:
        message = "is not valid, so nothing is overridden; correct or remove the file with git"
        raise InvalidInput.at("", message, file=_path_of(name))
    if name not in overrides:
        message = f"there is no override '{name}'{suggestion(name, overrides)}"
        raise InvalidInput.at("", message)
    _carry_out(repo, name, None, summary, options)


def _carry_out(
    repo: Reader, name: str, text: str | None, summary: str, options: EditOptions
) -> None:
    # without a text, the override's file is removed
    with progress("reading the ledger") as report:
        state = repo.snapshot(progress=report).state
    overrides, path = dict(state.config.overrides), _path_of(name)
    if text is not None:
        overrides[name] = Override.from_file(name, parse_file(OverrideFile, text, path))
    # as if a new override were on main, and while one that ends still is
    world = World(replace(state.config, overrides=overrides), state.ledger)
    report_now = override_report(world, REAL.now())
    entry = next(entry for entry in report_now if entry.override.name == name)
    if text is not None and entry.state == "matches nothing":
        errors.print(f"warning: {path} has no effect on anything that is demanded now")
    elif text is not None and entry.state in ("held back", "expired"):
        errors.print(f"warning: {path} is {entry.state}, so it changes nothing now")
    if options.output == "text":
        errors.print(f"{summary} ({path})")
        verb = "affects" if text is not None else "no longer affects"
        lines = [f"  {verb} {release.name} ({release.description})" for release in entry.releases]
        lines += [f"  {verb} {claim.subject} of demand {claim.demand}" for claim in entry.claims]
        for line in lines or ["  affects nothing now"]:
            errors.print(line)
    data: Json = {
        "outcome": "would-change",
        "commit": None,
        "branch": None,
        "link": None,
        "text": text,
        "override": vocabulary.override_data(entry.override),
        "state": entry.state,
        "releases": [vocabulary.release_data(release) for release in entry.releases],
        "claims": [vocabulary.claim_data(claim) for claim in entry.claims],
    }
    lines = [f"{summary}: nothing was changed"]
    lines += [f"    {line}" for line in (text or "").splitlines()]
    if not options.dry_run:
        person_change.confirm("Continue?", options.yes, options.output)
        published = _published(repo, name, {path: text}, summary, options)
        data |= {
            "outcome": "proposed" if options.propose else "committed",
            "commit": published.commit,
            "branch": published.branch,
            "link": published.link or None,
        }
        lines = [
            f"{summary}: commit {published.commit} on {MAIN_BRANCH}",
            "a running generator carries out this commit, or else the next generator that starts",
            *target.hint_to_pull(),
        ]
        if options.propose:
            lines = [f"{summary}: merge {published.branch} {published.link}".rstrip()]
    json_output.show(options.output, data, lines)


def _published(
    repo: Reader, name: str, files: dict[str, str | None], summary: str, options: EditOptions
) -> Published:
    who, reason = person_change.warned_if_unnamed(repo.operator()), one_line(options.reason)
    details = CommitDetails(who, REAL.now(), summary, reason)
    if not options.propose:
        committed = person_commit.commit_to_main(repo.repository, files, details)
        done.append(f"commit {committed.commit} on {MAIN_BRANCH}")
        return committed
    branch, title = f"override/{name}", harmless(one_line(summary))
    proposals = repo.snapshot().state.config.repo_settings.proposals
    # only GitLab opens a merge request for a push
    push_options = merge_request(title, reason) if proposals.forge == "gitlab" else []
    pushed = person_commit.commit_to_branch(repo.repository, files, details, branch, push_options)
    done.append(f"commit {pushed.commit} on {branch}")
    link = pushed.link
    try:
        if not link and (forge := forge_for(proposals, settings.forge_token_file())):
            link = forge.open(branch, MAIN_BRANCH, title, reason).link
    except ForgeError as error:  # the branch is there, so a person can open the merge request
        errors.print(f"warning: no merge request was opened: {error}; open one for {branch}")
    return Published(pushed.commit, branch, link)


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
@selecting
@click.option(
    "--expires",
    metavar="TIME",
    help="When the suspension ends: 2h, 3d, or a time like 2027-01-31T18:00:00Z.",
)
@editing
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
@selecting
@editing
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
    own = name or name_of(selected)
    with writable(options.state_repo, options.signing_key, dry_run=options.dry_run) as repo:
        overrides = repo.snapshot().state.config.overrides
        override = overrides.get(own)
        # a person may have changed what the file selects since it was suspended
        if override and not name and not selects(override, selected):
            message = f"selects something else; to end it, run: demandops resume {own}"
            raise InvalidInput.at("select", message, file=_path_of(own))
        end_override(repo, own, summary, options)
