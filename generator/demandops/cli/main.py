"""The `demandops` command: its table of commands, and the exit codes.

A command's module is imported when the command runs, so that `--version` and `--help` start fast.
"""

from __future__ import annotations

import errno
import logging
import os
import shutil
import signal
import sys
from contextlib import suppress
from enum import IntEnum
from importlib import import_module
from inspect import getdoc
from pathlib import Path
from types import ModuleType

import click

from demandops import __version__
from demandops.base.errors import DemandOpsError, InvalidInput, Unsound, suggestion
from demandops.base.quoting import OneLineFormatter, one_line
from demandops.cli.output import OutputLost, done, errors, open_streams, show_slow
from demandops.repo.git import child_processes

# The short help of each command, which `--help` shows without importing its module, and with which
# the command's own help begins.
COMMANDS = {
    "approve": "Approve a proposal: merge its branch in your own name.",
    "bookkeeping": "Show who requests which service and connection.",
    "check": "Check edits of a state repo and show their consequences.",
    "completion": "Print the completion script for a shell.",
    "config": "List, set and choose contexts: the fleets that you work with.",
    "decommission": "Release all claims of a node or a requester.",
    "demand": "Demand what files ask for: book it, or send it to a node.",
    "detect": "Watch topics, and send the demands that rules ask for.",
    "diff": "Show the differences between two commits.",
    "drain": "Take a node out of use: the generator places nothing there.",
    "get": "List demands, releases, nodes, overrides and so on.",
    "init": "Create a state repo.",
    "journal": "List the accepted demands that are not published.",
    "log": "List the commits of the state repo, newest first.",
    "may": "Say whether a requester may demand an application, and why.",
    "new": "Write a new application or image.",
    "override": "Create and end overrides: deviations that people declare.",
    "parameter-sync": "Keep a ROS node's parameters equal to those in a ConfigMap.",
    "release": "Stop one demand, or an application for all who demand it.",
    "reconcile": "Let Flux or Argo CD fetch now, and not at its next interval.",
    "reject": "Reject a proposal: delete its branch, and record who and why.",
    "resume": "Run suspended applications and connections again.",
    "revert": "Undo a person's commit, by a new commit.",
    "rollback": "Restore the claims of an earlier commit, by a new commit.",
    "schema": "Print the JSON Schema of a kind of file.",
    "serve": "Run the ROS 2 node that accepts demands.",
    "status": "Show the state of each release on its cluster.",
    "suspend": "Stop applications and connections; their claims stay booked.",
    "undrain": "Use a drained node again.",
    "upgrade": "Render everything again, in one commit.",
    "verify": "Render commits again from their ledger and compare the bytes.",
    "version": "Print the versions of the program and of its formats.",
    "watch": "Show releases, demands and the latest commits live.",
    "web": "Show the state repo on a web page.",
    "why": "Explain why something runs or ran, and who decided it.",
}

# The commands of each module, which is below `demandops.cli`, except in `demandops_ros`.
MODULES = {
    "authoring.check": "check",
    "authoring.new": "new",
    "authoring.schema": "schema",
    "changes.configure": "drain override resume revert suspend undrain",
    "changes.demand": "demand",
    "changes.ledger_change": "decommission release rollback",
    "changes.person_change": "approve reject",
    "demandops_ros.detector.detect_command": "detect",
    "demandops_ros.parameter_sync": "parameter-sync",
    "demandops_ros.serve_command": "serve",
    "program": "completion config version",
    "queries.commits": "bookkeeping diff log",
    "queries.get": "get",
    "queries.status": "reconcile status watch web",
    "queries.why": "may why",
    "state_repo": "init journal upgrade verify",
}

# Other names of commands.
ALIASES = {
    "describe": ["why"],
    "events": ["get", "events"],
    "request": ["demand", "--via", "git"],
}

# What is meant by words of other programs.
_LEADS = {
    "check": "lint, plan, template, validate",
    "demand FILE": "apply, create, install",
    "drain NODE": "cordon",
    "get KIND": "list, ls, ps, top",
    "get overrides": "override get, override list, override ls",
    "get releases": "get deployments, get pods, deployments, pods",
    "log": "history",
    "may REQUESTER demand APPLICATION": "auth, can-i",
    "override create NAME": "override add, override new",
    "override create NAME --on NODE": "migrate, move",
    "override create NAME --replicas N": "scale",
    "override create NAME --use-version VERSION, or with --image NAME=TAG": "pin",
    "override create NAME --values FILE": "edit, patch",
    "override create freeze --node '*' --refuse-new --until 1h -m \"why\"": "freeze",
    "override end NAME": "override delete, override remove, override rm, override stop",
    "override end freeze": "thaw, unfreeze",
    "reconcile CLUSTER": "sync",
    "reject PROPOSAL -m REASON": "decline, deny, refuse",
    "release DEMAND|APPLICATION": "cancel, delete, remove, rm, stop, uninstall",
    "revert COMMIT": "undo",
    "rollback TIME": "restore, rollout",
    "status": "health",
    "suspend --application ID": "disable, pause",
    "undrain NODE": "uncordon",
    "verify 2000-01-01..main": "audit, verify --all",
    "why NAME": "explain, logs, show, trace, tree",
}

# These commands run until they are stopped. They log or fill the screen, so they do not show the
# progress of git operations.
_LONG_RUNNING = ("detect", "parameter-sync", "serve", "watch", "web")

_REMEDIES = {
    errno.EMFILE: "raise the limit of open files (ulimit -n), then try again",
    errno.ENOSPC: "make room on the disk, then try again",
}
_REMEDY = "check this path and the current folder, then try again"


class ExitCode(IntEnum):
    DONE = 0
    USER_ERROR = 1
    WRONG_USAGE = 2
    PROGRAM_ERROR = 3
    INTERRUPTED = 130


def load(name: str) -> click.Command:
    module = next(module for module, names in MODULES.items() if name in names.split())
    ros = module.startswith("demandops_ros.")
    found = imported(name, module if ros else f"demandops.cli.{module}")
    command: click.Command = getattr(found, name.replace("-", "_"))
    command.help = f"{COMMANDS[name]}\n\n{getdoc(command.callback)}"
    return command


def imported(name: str, module: str) -> ModuleType:
    """Import a module of the command ``name``; tell what is not installed."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        missing = str(error.name).split(".")[0]
        if missing in ("demandops", "demandops_ros"):
            raise
        is_ros = module.startswith("demandops_ros.")
        remedy = "see README.md, 'With ROS 2'" if is_ros else "install demandops again"
        raise click.ClickException(
            f"{name} needs {missing}, which is not installed; {remedy}"
        ) from None
    except ImportError as error:
        if shutil.which("git"):
            raise click.ClickException(f"{name} does not start: {one_line(str(error))}") from error
        raise click.ClickException(
            f"{name} needs git, which is not installed; install it (Debian: apt-get install git)"
        ) from None


class _LazyGroup(click.Group):
    """A group that lists its commands from ``COMMANDS`` and imports only the command to run."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        args = [*ALIASES.get(args[0], args[:1]), *args[1:]]
        word, both = args[0], " ".join(args[:2])
        is_unknown = word not in COMMANDS and not word.startswith("-")
        told = {both, word} if is_unknown else {both}
        meant = next((lead for lead, words in _LEADS.items() if told & {*words.split(", ")}), "")
        if meant or is_unknown:
            kinds = import_module("demandops.views.kinds").KINDS
            fitting = (f"get {name}" for name in kinds if word in (name, name[:-1]))
            meant = meant or next(fitting, "")
            hint = suggestion(word, [*COMMANDS, *ALIASES]).replace("known:", "the commands are:")
            hint = f"; did you mean: demandops {meant}" if meant else hint
            ctx.fail(f"there is no command '{word if is_unknown else both}'{hint}")
        # `kubectl describe` names the kind first
        if word == "why" and len(args) > 2 and not any(arg.startswith("-") for arg in args[1:3]):
            args[1:3] = [args[2], "--kind", args[1].lower().removesuffix("s")]
        name, command, arguments = super().resolve_command(ctx, args)
        if name and name not in _LONG_RUNNING:
            child_processes.listeners[:] = [show_slow]
        return name, load(name) if name else command, arguments


@click.group(
    cls=_LazyGroup,
    commands=[click.Command(name, short_help=text) for name, text in COMMANDS.items()],
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.version_option(__version__, prog_name="demandops")
@click.option("-v", "--verbose", is_flag=True, help="Log what the program does.")
def cli(verbose: bool) -> None:
    """Turn demands for applications into desired state in Git.

    Start with `demandops init DIR --bare`. Then run `demandops serve --state-repo DIR` to accept
    demands over ROS 2, or `demandops demand FILE --state-repo DIR` to book demands from files.
    """
    level = logging.INFO if verbose else logging.WARNING
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(OneLineFormatter("%(levelname)s: %(message)s"))
    logging.basicConfig(level=level, handlers=[handler])


def main(args: list[str] | None = None) -> None:
    # the only door of all programs: `demandops`, and the nodes that ROS starts
    open_streams()
    code = run(args)
    for number, stream in ((1, sys.stdout), (2, sys.stderr)):
        try:
            stream.flush()
        # it is told already, and Python would tell it again at the exit, by another code
        except (OutputLost, OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)
    sys.exit(code)


def run(args: list[str] | None = None) -> int:
    # SIGTERM and SIGHUP act like Ctrl-C, because all of them must close generators and remove
    # temporary folders; but `nohup` lets a process ignore SIGHUP
    before = {}
    for number in (signal.SIGTERM, signal.SIGHUP):
        with suppress(ValueError):  # only the main thread may set a handler
            if signal.getsignal(number) is not signal.SIG_IGN:
                before[number] = signal.signal(number, signal.default_int_handler)
    done.clear()
    try:
        return _run(sys.argv[1:] if args is None else args)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _run(args: list[str]) -> int:
    try:
        if odd := [arg for arg in args if any("\udc80" <= char <= "\udcff" for char in arg)]:
            raise click.ClickException(
                f"the argument {odd[0]!a} is no text in {sys.getfilesystemencoding()}; write it in "
                "UTF-8, with a locale of UTF-8 such as LANG=C.UTF-8"
            )
        try:
            Path.cwd()
        except OSError:
            message = "the current folder no longer exists; change to one that does"
            raise click.ClickException(message) from None
        code = cli.main(args=args, prog_name="demandops", standalone_mode=False)
        return code if isinstance(code, int) else ExitCode.DONE
    except click.UsageError as error:
        with suppress(OSError):
            error.show()
        return ExitCode.WRONG_USAGE
    except click.Abort:
        # a terminal has shown ^C in this line
        errors.print("\ninterrupted" if sys.stderr.isatty() else "interrupted")
        return ExitCode.INTERRUPTED
    except click.ClickException as error:
        errors.print(f"error: {error.format_message()}")
        return ExitCode.USER_ERROR
    except DemandOpsError as error:
        for fault in error.faults if isinstance(error, InvalidInput) else [error]:
            errors.print(f"error: {fault}")
        return ExitCode.PROGRAM_ERROR if isinstance(error, Unsound) else ExitCode.USER_ERROR
    except OutputLost as error:
        if not done and isinstance(error.__cause__, BrokenPipeError):  # `demandops log | head`
            return ExitCode.DONE
        told = f"; done already: {'; '.join(done)}" if done else ""
        errors.print(f"error: the output cannot be written: {error}{told}")
        return ExitCode.USER_ERROR
    except OSError as error:  # of a file, a folder or the machine's limits
        is_named = isinstance(error.filename, str | bytes)
        place = f"{os.fsdecode(error.filename)}: " if is_named else ""
        remedy = _REMEDIES.get(error.errno or 0, _REMEDY)
        errors.print(f"error: {place}{error.strerror or error}; {remedy}")
        logging.getLogger("demandops").info("traceback", exc_info=True)
        return ExitCode.USER_ERROR
    except Exception as error:
        logging.getLogger("demandops").debug("a fault of the program", exc_info=True)
        errors.print(
            f"error: a fault of demandops itself: {type(error).__name__}: {error}\n"
            "please report this error, and what the same command prints with -v: `demandops -v …`"
        )
        if logging.getLogger().isEnabledFor(logging.INFO):
            logging.exception("traceback")
        return ExitCode.PROGRAM_ERROR


if __name__ == "__main__":
    main()
