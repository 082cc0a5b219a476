"""The state repo that a command works on: from its options, a context, or the folder around it."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Iterator
from functools import partial, reduce
from pathlib import Path
from typing import Annotated, Any, Literal

import click
from click.core import ParameterSource
from pydantic import Field, StringConstraints, model_validator

from demandops.base import settings, strict_yaml
from demandops.base.errors import InvalidInput, StateRepoError, suggestion
from demandops.base.naming import SubjectKind
from demandops.base.quoting import count, quoted, some
from demandops.base.strict_yaml import located_in
from demandops.cli.output import errors
from demandops.decide.planning.planner import all_keys, plan
from demandops.model.config.base_model import CamelModel, DnsLabel, FileModel, parse_file
from demandops.model.config.config import CONFIG_ROOTS
from demandops.repo import reader
from demandops.repo.git.remote_repository import (
    changed_in,
    checkout_around,
    commits_behind,
    is_url,
    origin_of,
)
from demandops.repo.reader import Reader
from demandops.repo.write.proposal_branch import pending_proposals

# ---- contexts: the fleets that a person works with ----
#
# A context replaces options that a person would repeat: the state repo, the access to the clusters,
# the signing key. docs/commands.md describes the file.

Filled = Annotated[str, StringConstraints(min_length=1)]


class Context(CamelModel):
    """The values that a context gives to a command; :mod:`.target` says when."""

    state_repo: Filled
    clusters: Filled | None = None
    signing_key: Filled | None = None


class ContextsFile(FileModel):
    """``~/.config/demandops/contexts.yaml``: contexts by name, and the one in use."""

    kind: Literal["Contexts"]
    current: DnsLabel | None = None
    contexts: dict[DnsLabel, Context] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _known(self) -> ContextsFile:
        if self.current is not None and self.current not in self.contexts:
            raise ValueError(
                f"current: there is no context '{self.current}'"
                f"{suggestion(self.current, self.contexts)}"
            )
        return self


def contexts_file() -> Path:
    return settings.folder_of_user("XDG_CONFIG_HOME", ".config") / "demandops" / "contexts.yaml"


def read_contexts() -> ContextsFile:
    try:
        text = contexts_file().read_text(encoding="utf-8")
    except (FileNotFoundError, StateRepoError):  # there is no such file, or no home folder
        return ContextsFile(apiVersion=settings.API_VERSION, kind="Contexts")
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInput.at(
            "", f"cannot be read: {error}; replace the file", file=str(contexts_file())
        ) from None
    with located_in(text):
        return parse_file(ContextsFile, text, str(contexts_file()))


def write_contexts(content: ContextsFile) -> None:
    file = contexts_file()
    file.parent.mkdir(parents=True, exist_ok=True)
    data = content.model_dump(by_alias=True, exclude_none=True)
    # written beside the file and then renamed, so that no other command reads half a file
    new = file.with_name(f".{file.name}.new")
    new.write_text(strict_yaml.dump(data), encoding="utf-8")
    new.chmod(0o600)
    new.replace(file)


def context_named(name: str, field: str = "") -> Context:
    # a fault names `field` as the place of the name
    contexts = read_contexts().contexts
    if name not in contexts:
        message = f"there is no context '{name}'{suggestion(name, contexts)}"
        raise InvalidInput.at(field, message, file=str(contexts_file()))
    return contexts[name]


# ---- which state repo a command works on, and with which access ----
#
# The first of these that is given decides:
#
# 1. ``--state-repo``
# 2. ``--context``
# 3. the environment variable. If it names a relative folder that does not exist, it is ignored
#    inside a checkout, and is an error outside.
# 4. the checkout around the current folder. A command that writes uses the checkout's remote.
# 5. the current context
#
# The default signing key and clusters come from the same context as the state repo. In a checkout,
# they come from the first context whose state repo is this checkout or its remote. If
# ``--state-repo`` or the environment variable decides, there are no such defaults.

Command = Callable[..., Any]
Decorator = Callable[[Command], Command]

_VARIABLE = "DEMANDOPS_STATE_REPO"
_NAME = "demandops.context-name"
_CONTEXT = "demandops.context"
_BEHIND = "demandops.checkout-behind"
NO_STATE_REPO = (
    "Which state repo? Give --state-repo, run the command in a checkout, or name a state repo "
    "once: demandops config set NAME --state-repo URL_OR_DIR"
)


def with_options(*options: Decorator) -> Decorator:
    return lambda command: reduce(lambda made, option: option(made), reversed(options), command)


def _checkout() -> Path | None:
    # `--context` goes before the checkout around the current folder
    named = _NAME in click.get_current_context().meta
    return None if named else checkout_around(Path.cwd())


def _default_repo(*, writes: bool = False) -> str | None:
    ctx, around, content = click.get_current_context(), _checkout(), read_contexts()
    if ctx.params.get("via") == "ros" or ctx.params.get("hold"):
        return None  # a demand that is sent over ROS needs no state repo
    # clusters and signing key of a context apply only to its own state repo
    context: Context | None = None
    if _NAME in ctx.meta:
        context = context_named(ctx.meta[_NAME], "--context")
    elif around is not None:
        places = {str(around), origin_of(around)}
        same = (context for context in content.contexts.values() if context.state_repo in places)
        context = next(same, None)
    elif content.current:
        context = content.contexts[content.current]
    ctx.meta[_CONTEXT] = context
    if around is None:
        return context.state_repo if context else None
    origin = origin_of(around) if writes else None
    if origin is not None:
        ctx.meta[_BEHIND] = True
    # a generator never writes to a checkout; a dry run needs no place to write to
    elif writes and not ctx.params.get("dry_run"):
        raise click.UsageError(
            f"the checkout {around} has no remote 'origin' to write to; give --state-repo"
        )
    return str(around) if origin is None else origin


def hint_to_pull() -> list[str]:
    # the new commit is not in the checkout yet, and commands that only read use the checkout
    behind = click.get_current_context().meta.get(_BEHIND)
    return ["to see the new commit in this checkout: git pull"] if behind else []


def hint_to_push() -> list[str]:
    # what a person has just written in the checkout counts only once it is on main
    around = _checkout()
    changed = changed_in(around) if around else ()
    files = [path for path in changed if path.split("/")[0] in CONFIG_ROOTS]
    told = f"note: only in this checkout, not on main: {some(files, 3)}"
    return [f"{told}; commit and push to demand with them"] if files else []


def _from_context(field: str) -> str | None:
    context = click.get_current_context().meta.get(_CONTEXT)
    return getattr(context, field) if context else None


def context_names(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    return [name for name in read_contexts().contexts if name.startswith(incomplete)]


_context_option = click.option(
    "--context",
    metavar="NAME",
    expose_value=False,
    is_eager=True,
    callback=lambda ctx, param, value: ctx.meta.update({_NAME: value} if value is not None else {}),
    shell_complete=context_names,
    help="The context to use, instead of the current one (docs/commands.md).",
)


def _state_repo(*, writes: bool = True, required: bool = True) -> Decorator:
    default = partial(_default_repo, writes=writes)
    where = f"{'the remote of ' if writes else ''}the checkout that you are in"

    def address(ctx: click.Context, param: click.Parameter, value: str | None) -> str:
        from_environment = ctx.get_parameter_source("state_repo") is ParameterSource.ENVIRONMENT
        path = Path(value or "")
        # A relative path in the environment may fit another folder than the current one.
        if from_environment and (
            _NAME in ctx.meta
            or not (is_url(value or "") or path.is_absolute() or path.expanduser().exists())
        ):
            if _NAME not in ctx.meta and _checkout() is None:
                raise click.UsageError(
                    f"{_VARIABLE} is {quoted(value or '')}, a relative folder that does not exist "
                    f"in {Path.cwd()}; set it to an absolute path, or give --state-repo",
                    ctx,
                )
            value = default()
        if value is None and required:
            raise click.UsageError(NO_STATE_REPO, ctx)
        if value and not writes and (behind := commits_behind(Path(value))):
            errors.print(f"note: this checkout is {count(behind, 'commit')} behind main: git pull")
        return value or ""

    option = click.option(
        "--state-repo",
        envvar=_VARIABLE,
        metavar="URL_OR_DIR",
        default=default,
        is_eager=True,  # the defaults of other options depend on it
        callback=address,
        help=f"The state repo: a bare repository's folder, or a URL that git can clone. Default: "
        f"{where}, otherwise the state repo of the context [env: {_VARIABLE}].",
    )
    return with_options(option, _context_option)


# The option `--state-repo` of a command that only reads; it may name a checkout.
state_repo_option = _state_repo(writes=False)

# The option `--state-repo` of a command that writes.
# If the checkout has no remote, the default with `--dry-run` is the checkout itself.
writable_repo_option = _state_repo()

# The same of a command that can also do without: then it is empty.
optional_repo_option = _state_repo(required=False)

dry_run_option = click.option(
    "--dry-run",
    is_flag=True,
    is_eager=True,  # the default state repo depends on it
    help="Show the consequences and change nothing.",
)

signing_option = click.option(
    "--signing-key",
    envvar="DEMANDOPS_SIGNING_KEY",
    type=click.Path(path_type=Path),
    metavar="FILE",
    default=partial(_from_context, "signing_key"),
    help="Sign the commits with this SSH key: a private key without a passphrase, or a public key "
    "whose private key is in an SSH agent; see docs/audit.md [env: DEMANDOPS_SIGNING_KEY].",
)

clusters_option = click.option(
    "--clusters",
    "access_file",
    envvar="DEMANDOPS_CLUSTERS",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    default=partial(_from_context, "clusters"),
    help="A file that says how to reach the clusters; see docs/status.md [env: "
    "DEMANDOPS_CLUSTERS].",
)


# ---- names from the state repo, for a shell's completion ----


def names_of(*kinds: str) -> Callable[[click.Context, click.Parameter, str], list[str]]:
    def complete(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
        try:
            with ctx.scope(cleanup=False):
                address = ctx.params.get("state_repo") or _default_repo()
            if not address:
                return []
            # offline, because a shell waits for the names while a person types
            with reader.opened_offline(address) as repo:
                names = {name for kind in kinds if repo for name in all_names(repo, kind)}
            return sorted(name for name in names if name.startswith(incomplete))
        except Exception:  # an error must not disturb a person who is typing
            return []

    return complete


def name_options(helps: dict[str, str], **more: Any) -> Decorator:  # noqa: ANN401
    """Add an option for each name, which a shell completes; one for several is named in plural."""

    def option(name: str, text: str) -> Decorator:
        key, names = f"{name}s" if more.get("multiple") else name, names_of(f"{name}s")
        return click.option(f"--{name}", key, shell_complete=names, help=text, **more)

    return with_options(*(option(*each) for each in helps.items()))


def options_for(repo: Reader, name: str, kinds: Iterable[str]) -> str:
    """Return a hint for a name that was given without the option that says what it is."""
    fitting = (kind for kind in kinds if name in all_names(repo, f"{kind}s"))
    meant = " or ".join(f"--{kind} {shlex.quote(name)}" for kind in fitting)
    return f"; did you mean: {meant}" if meant else ""


def all_names(repo: Reader, kind: str) -> Iterator[str]:
    if kind == "proposals":
        yield from (proposal.branch for proposal in pending_proposals(repo.repository))
        return
    world = repo.snapshot().state
    if kind == "releases":
        running = (plan(world, key) for key in all_keys(world))
        yield from (release.name for release in running if release)
    elif kind in ("requesters", "demands"):
        yield from world.ledger.indexed_names(kind[:-1])
    elif kind in ("applications", "connections"):
        yield from world.ledger.subjects(SubjectKind(kind))
    else:
        yield from {
            "nodes": (*world.config.nodes, *world.config.node_patterns),
            "domains": world.config.domains,
            "overrides": world.config.overrides,
            "appdefs": world.config.appdefs,
            "services": {name: 0 for own in world.config.services.values() for name in own},
        }[kind]
