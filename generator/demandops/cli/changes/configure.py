"""What a person configures, each in one commit: overrides, drained nodes, and reverts.

The commands ``override``, ``suspend``, ``resume``, ``drain``, ``undrain`` and ``revert``.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from datetime import timedelta
from typing import Any

import click

from demandops.base import naming, strict_yaml
from demandops.base.errors import InvalidInput, StateRepoError, fault, suggestion
from demandops.base.naming import id_problem
from demandops.base.placeholders import example_of, is_pattern
from demandops.base.quoting import quoted
from demandops.base.runtime import REAL
from demandops.base.settings import GENERATED_ROOTS, MAIN_BRANCH
from demandops.base.strict_yaml import faults_in, read_input
from demandops.cli import target
from demandops.cli.changes import person_change
from demandops.cli.changes.person_change import Options, changing, propose_option, writable
from demandops.cli.output import read_by
from demandops.cli.queries.commits import in_effect
from demandops.cli.target import all_names, names_of
from demandops.decide.booking import Drain
from demandops.decide.placement import relocation
from demandops.decide.state import State
from demandops.model.config import discovered
from demandops.model.config.base_model import document, matches, parse_file, parse_time, seconds_of
from demandops.model.config.config import NODES_FILE
from demandops.model.config.entry_patterns import may_match
from demandops.model.config.inventory import NODE_LABEL
from demandops.model.config.load import is_override_name
from demandops.model.config.override import (
    OVERRIDES_ROOT,
    SELECTED,
    Override,
    OverrideFile,
    format_time,
)
from demandops.model.ledger.claim import LEDGER_ROOT
from demandops.repo import reader
from demandops.repo.history import commit_log
from demandops.views.vocabulary import Json, override_data

# ---- what the commands share: their options and selection ----

editing = changing(propose_option)

selecting = target.name_options(
    {
        name: f"Select this {name}; * matches any text, ? one character. May be repeated."
        for name in SELECTED
    },
    metavar="NAME",
    multiple=True,
)


def selector(given: Mapping[str, Iterable[str]]) -> dict[str, list[str]]:
    return {name: list(values) for name, values in given.items() if values}


def ends_at(text: str | None) -> str | None:
    if text is None:
        return None
    now = REAL.now()
    try:
        end = (now + timedelta(seconds=seconds_of(text))).replace(microsecond=0)
    except ValueError:
        try:
            # a time of day is the next one
            last = commit_log.parse_time(text, now) if ":" in text and "-" not in text else None
            end = last + timedelta(days=1) if last else parse_time(text)
        except ValueError as error:
            raise ValueError(f"{error}, or a duration like 2h") from None
    if end <= now:
        raise ValueError(f"{quoted(text)} has passed; give a later time, or a duration like 2h")
    return format_time(end)


until_option = click.option(
    "--until",
    "--expires",
    "expires",
    metavar="TIME",
    callback=read_by(ends_at),
    help="When it ends: 2h, 3d, 18:00 (UTC), or a time like 2027-01-31T18:00:00Z.",
)

# ---- ``demandops override``: create or end an override ----


@click.group()
def override() -> None:
    """
    \b
    Examples:
      demandops override create calm --node edge --hold -m "Demonstration"
      demandops override create freeze --node edge --refuse-new --until 2h -m Work
      demandops override end calm
      demandops get overrides
    """


def _new_name(name: str) -> str:
    if is_override_name(name):
        return name
    raise ValueError(
        f"{quoted(name)} is not a valid override name; use at most 63 lower-case letters, "
        "digits and '-', with no '-' at the start or end"
    )


def _image(text: str) -> tuple[str, Json]:
    name, _, pin = text.partition("=")
    if not (name and pin):
        raise ValueError(f"{quoted(text)} is not NAME=TAG or NAME=sha256:DIGEST")
    return name, {"digest" if pin.startswith("sha256:") else "tag": pin}


@override.command()
@click.argument("name", metavar="NAME", callback=read_by(_new_name))
@selecting
@click.option("--hold", is_flag=True, help="Keep the rendered files as they are.")
@click.option("--deny", is_flag=True, help="Refuse demands, and stop what runs.")
@click.option("--keep", is_flag=True, help="Keep services running after their last demand ends.")
@click.option("--replicas", type=click.IntRange(0), metavar="N", help="Set the number of replicas.")
@click.option(
    "--refuse-new",
    "refuseNew",
    is_flag=True,
    help="A freeze: refuse demands for what is new; what runs stays.",
)
@click.option("--on", "node", metavar="NODE", help="Move services to this node.")
@click.option(
    "--use-version", "version", metavar="WORD", help="Pin the chart to a version or channel."
)
@click.option(
    "--image",
    "images",
    metavar="NAME=TAG",
    multiple=True,
    callback=read_by(_image),
    help="Pin an image of registry/images to a tag or digest.",
)
@click.option(
    "--values",
    metavar="FILE",
    help="Patch Helm values with this YAML file; with --connection, the settings of clients.",
)
@click.option(
    "--priority",
    type=int,
    metavar="N",
    help="If several overrides match, the one with the highest priority wins. Default: 0.",
)
@until_option
@click.option("--owner", metavar="NAME", help="Who is responsible. Default: your name in git.")
@editing
def create(name: str, values: str | None, options: Options, **given: Any) -> None:  # noqa: ANN401
    """Create an override.

    The command commits the override to main in your own name, as git knows it. With --propose, it
    commits to a branch instead. The options from --application to --requester select what the
    override applies to. Different options must all match; of a repeated option, one value must
    match (docs/overrides.md).

    \b
    Examples:
      demandops override create calm --node edge --hold -m Demonstration --propose
      demandops override create more --service tracker --replicas 2 -m Load
      demandops override create freeze --node edge --refuse-new --until 2h -m Work
      demandops override create late --node edge --keep -m Tests --until 2d
    """
    patch = None
    if values is not None:
        file, content = read_input(values)
        patch = strict_yaml.load(content, file)
        if not isinstance(patch, dict):
            raise InvalidInput.at("", "must be a mapping of Helm values", file=file)
    selected = selector({f"{name}s": given.pop(f"{name}s") for name in SELECTED})
    given["images"] = dict(given["images"]) or None
    # a flag that is not given is no effect
    more = {field: value for field, value in given.items() if value is not False}
    _create(name, f"Create override {name}", selected, {"values": patch, **more}, options)


@override.command()
@click.argument("name", metavar="NAME", shell_complete=names_of("overrides"))
@editing
def end(name: str, options: Options) -> None:
    """End an override: remove its file.

    The releases that the override changed are rendered again without it.

    \b
    Examples:
      demandops override end calm -m "The demonstration is over"
      demandops override end calm --dry-run
    """
    _end(name, f"End override {name}", {}, options)


def _create(
    name: str,
    summary: str,
    selected: Mapping[str, list[str]],
    fields: Mapping[str, Any],
    options: Options,
) -> None:
    path = _path_of(name)
    with writable(options) as repo:
        options = options.with_reason()
        if not selected:
            raise click.UsageError("select what the override applies to, for example --node edge")
        if repo.file_reader()(path) is not None:
            message = "exists already; end it first, or choose another name"
            raise InvalidInput.at("", message, file=path)
        unknown = []
        for kind, patterns in selected.items():
            # only a freeze can be about what nobody demands yet
            is_open = kind in ("applications", "connections", "requesters")
            names = [*all_names(repo, kind)]
            for pattern in patterns if not (is_open and fields.get("refuseNew")) else ():
                is_template = kind == "nodes" and is_pattern(pattern)
                if is_template or not may_match(pattern, names):
                    what = kind.removesuffix("s")
                    hint = "; only --refuse-new can be about what nobody demands yet"
                    close = suggestion(pattern, names)
                    close = f"; write {quoted(example_of(pattern, '*'))}" if is_template else close
                    message = f"no {what} is called {quoted(pattern)}{close}"
                    unknown.append(fault(f"--{what}", message + (hint if is_open else "")))
        if unknown:
            raise InvalidInput(unknown)
        # a name in git may have characters that an owner may not have
        person = repo.operator()
        owner = person.email if id_problem(person.name) else person.name
        given = {"reason": options.reason, "owner": owner}
        given |= {field: value for field, value in fields.items() if value is not None}
        text = document(path, "override", "Override", {**given, "select": [selected]})
        parsed = Override.from_file(name, parse_file(OverrideFile, text, path))
        note = "  refuses what is new; what runs may be renewed, reduced and released"

        def more(before: State, after: State) -> tuple[Json, list[str]]:
            stays = relocation.following_overrides(after).stays
            lines = [f"  {text}" for of, text in stays if of == path]
            return {"override": override_data(parsed)}, [note] * bool(parsed.refuseNew) + lines

        person_change.commit(repo, {path: text}, summary, f"override/{name}", options, more)


def _path_of(name: str) -> str:
    return f"{OVERRIDES_ROOT}/{name}.yaml"


def _end(name: str, summary: str, selected: Mapping[str, list[str]], options: Options) -> None:
    with writable(options) as repo:
        overrides = repo.snapshot().state.config.overrides
        override = overrides.get(name)
        if override is None and repo.file_reader()(_path_of(name)) is not None:
            message = "is not valid, so nothing is overridden; correct or remove the file with git"
            raise InvalidInput.at("", message, file=_path_of(name))
        if override is None:
            hint = target.options_for(repo, name, SELECTED) or suggestion(name, overrides)
            raise InvalidInput.at("", f"there is no override '{name}'{hint}")
        # a person may have changed what the file selects since it was suspended
        selects = [select.model_dump(exclude_none=True).items() for select in override.select]
        wanted = [{kind: {*values} for kind, values in selected.items()}]
        if selected and [{kind: {*own} for kind, own in select} for select in selects] != wanted:
            message = f"selects something else; to end it, run: demandops resume {name}"
            raise InvalidInput.at("select", message, file=_path_of(name))
        files, more = {override.path: None}, ({"override": override_data(override)}, ())
        person_change.commit(repo, files, summary, f"override/{name}", options, lambda *_: more)


# ---- ``demandops suspend``: an override that denies applications and connections ----


def name_of(selected: Mapping[str, list[str]]) -> str:
    # equal selections get the same name, so that `resume` finds the override
    chosen = sorted((kind, sorted(values)) for kind, values in selected.items())
    words = "-".join(value for _, values in chosen for value in values)
    return "suspend-" + naming.slug_with_hash(words, repr(chosen), 6)


@click.command(context_settings={"allow_extra_args": True})
@selecting
@until_option
@editing
def suspend(expires: str | None, options: Options, **given: tuple[str, ...]) -> None:
    """Nothing runs for these claims, and new demands that match the options are refused. To end the
    suspension, give `demandops resume` the same selection, such as --requester vehicle00. The
    command creates an override with `deny` in your own name.

    \b
    Examples:
      demandops suspend --requester vehicle00 -m "In the workshop"
      demandops suspend --application 'edge/*' --until 2h -m "Service"
      demandops suspend --connection vehicle00/edge -m "Too much data" --propose
    """
    if names := click.get_current_context().args:
        with reader.opened(options.state_repo, only_read=True) as repo:
            hint = target.options_for(repo, names[0], SELECTED)
        raise click.UsageError(f"say by an option what {quoted(names[0])} is{hint}")
    selected, effect = selector(given), {"expires": expires, "deny": True}
    _create(name_of(selected), f"Suspend {described(selected)}", selected, effect, options)


def described(selected: Mapping[str, list[str]]) -> str:
    return ", ".join(
        f"{kind.removesuffix('s')} {value}" for kind, values in selected.items() for value in values
    )


# ---- ``demandops resume``: end an override that ``demandops suspend`` made ----


@click.command()
@click.argument("name", required=False, metavar="[NAME]", shell_complete=names_of("overrides"))
@selecting
@editing
def resume(name: str | None, options: Options, **given: tuple[str, ...]) -> None:
    """Give the same selection as for `demandops suspend`, such as --requester vehicle00, or NAME,
    the override's name. The command ends this override.

    \b
    Examples:
      demandops resume --requester vehicle00
      demandops resume suspend-vehicle00-1c2f3a
    """
    selected = selector(given)
    if bool(name) == bool(selected):
        raise click.UsageError(
            "give either the options of `demandops suspend`, or the override's name"
        )
    _end(name or name_of(selected), f"Resume {name or described(selected)}", selected, options)


# ---- ``demandops drain`` and ``undrain``: the field `drained` of a node in the inventory ----


def _set_drained(node: str, drained: bool, options: Options) -> None:
    with writable(options) as repo:
        config = repo.snapshot().state.config
        if node not in config.nodes:
            message = f"{quoted(node)} {config.why_no_node(node)}"
            if pattern := config.node_patterns.get(node.partition("@")[0]):
                flag = f"write drained: {str(drained).lower()} yourself, in {pattern.where}"
                message = f"is a pattern of many nodes; {flag}"
            raise InvalidInput.at("NODE", message)
        host, verb = config.host_of(node), "Drain" if drained else "Undrain"
        if config.nodes[host].drained is drained:
            raise StateRepoError(f"'{host}' is {'drained already' if drained else 'not drained'}")
        if host not in config.entry_files[NODES_FILE]:
            message = (
                f"'{host}' is not listed: a pattern in {config.file_of(NODES_FILE, host)} gives "
                "it; list it there, with what it shall have of its own"
            )
            raise StateRepoError(message)
        path = config.file_of(NODES_FILE, host)
        text = repo.file_reader()(path) or ""
        if discovered.is_discovered(path):
            cluster, verb = config.nodes[host].cluster, "cordon" if drained else "uncordon"
            way = shlex.join(["kubectl", verb, "-l", f"{NODE_LABEL}={host}"])
            message = f"'{host}' is as cluster '{cluster}' has it; there, run: {way}"
            if host in config.gone_since:
                message = f"'{host}' is drained because cluster '{cluster}' has it no longer"
            raise StateRepoError(message)
        try:
            changed = strict_yaml.set_flag(text, "nodes", host, "drained", drained)
        except InvalidInput as error:
            raise InvalidInput(faults_in(error, path)) from None

        def moves(before: State, after: State) -> tuple[Json, Iterator[str]]:
            # the generator moves what it placed there, in commits of its own
            plan = Drain(id=host)
            if drained:
                plan = relocation.with_moves(plan, after, after.usage, after.names)
            lines = [*(f"moves: {text}" for text in plan.moved), *plan.stays]
            # what an override moved away comes back with its end
            for name, override in () if drained else sorted(after.config.overrides.items()):
                moves_it = override.node not in (None, host) and name not in after.ledger.ended
                if moves_it and any(matches(host, each.nodes or ()) for each in override.select):
                    way = f"to end that: {shlex.join(['demandops', 'override', 'end', name])}"
                    lines.append(f"{override.path} still moves it all to '{override.node}'; {way}")
            data = {"node": host, "moved": [*plan.moved], "stays": [*plan.stays]}
            return data, (f"  {line}" for line in lines or ["moves nothing"])

        summary, branch = f"{verb} {host}", f"{verb.lower()}/{host}"
        person_change.commit(repo, {path: changed}, summary, branch, options, moves)


_node = click.argument("node", metavar="NODE", shell_complete=names_of("nodes"))


@click.command()
@_node
@editing
def drain(node: str, options: Options) -> None:
    """The command sets `drained: true` in the inventory. The generator then moves away what it
    placed on the node, and places nothing there. What a demand names the node for stays, and such
    demands are still accepted; an override with `--on` moves it, and `demandops release` ends it.

    \b
    Examples:
      demandops drain edge --dry-run
      demandops drain edge -m "Maintenance"
      demandops override create off-edge --node edge --on cloud -m "Maintenance"
    """
    _set_drained(node, True, options)


@click.command()
@_node
@editing
def undrain(node: str, options: Options) -> None:
    """The command takes `drained: true` out of the inventory. What was moved away stays where it
    is.

    \b
    Examples:
      demandops undrain edge
    """
    _set_drained(node, False, options)


# ---- ``demandops revert``: the files of a person's commit as they were before ----


@click.command()
@click.argument("commit", metavar="COMMIT")
@editing
def revert(commit: str, options: Options) -> None:
    """The files that COMMIT changed become what they were before it. If a file has changed since,
    the command changes nothing. A generator's commit is undone by `demandops release` or `demandops
    rollback`, because later demands may build on it.

    \b
    Examples:
      demandops revert 5d41402a --dry-run
      demandops revert main -m "It was the wrong node"
    """
    with writable(options) as repo:
        id = repo.commit(commit)
        entry = next(repo.log(id))
        paths = repo.files_changed_by(id)
        generated = (LEDGER_ROOT, *GENERATED_ROOTS)
        booked = [path for path in paths if path.split("/", 1)[0] in generated]
        if entry.by_generator or booked:
            who = "a generator made it" if entry.by_generator else f"it changes {booked[0]}"
            snapshot, demands = repo.snapshot(), entry.trailers.get("Demand-Id", ())
            held = snapshot.state.ledger.indexed_names("demand")
            ways = [f"demandops release {shlex.quote(name)}" for name in demands if name in held]
            # what carries out a person's commit, or says that it is not valid, booked nothing
            follows = entry.first("Follows")
            back = f"revert {follows[:10]}" if follows else f"rollback {id[:10]}~1 -m REASON"
            ways.append(f"demandops {back}")
            message = (
                f"{id[:10]} is not undone by a revert, because {who}; run: {' or '.join(ways)}"
            )
            if snapshot.faults:
                message += f"; {MAIN_BRANCH} is not valid: {in_effect(repo, snapshot)}"
            raise StateRepoError(message)
        before, after, now = (repo.file_reader(each) for each in (f"{id}~1", id, None))
        if changed := [path for path in paths if now(path) != after(path)]:
            message = f"has changed since commit {id[:10]}; revert it with git, and push"
            raise InvalidInput.at("", message, file=changed[0])
        files = {path: before(path) for path in paths}
        summary, branch, more = f'Revert "{entry.summary}"', f"revert/{id[:10]}", {"reverts": id}
        reason = f"This reverts commit {id}. {options.reason}".rstrip()
        options = replace(options, reason=reason)
        person_change.commit(repo, files, summary, branch, options, lambda *_: (more, ()))
