"""``demandops``: the commands, and the one place where errors become exit codes.

0 done, 1 the user's to mend, 2 wrong usage, 3 a fault of the program. Commands that stand above
the generator (``serve``) are found by the entry points of the group ``demandops.commands``.
"""

from __future__ import annotations

import logging
import sys
from importlib.metadata import EntryPoint, entry_points

import click

from demandops import __version__
from demandops.cli.actions import decommission, request, rollback
from demandops.cli.output import errors
from demandops.cli.repo import check, init, schema, upgrade, verify
from demandops.cli.views import bookkeeping, diff, log, overrides, proposals, status, why
from demandops.errors import DemandOpsError, InvalidInput

_EXIT_USER, _EXIT_USAGE, _EXIT_FAULT, _EXIT_INTERRUPTED = 1, 2, 3, 130


class _Commands(click.Group):
    """The group of commands, with those of other packages loaded when they are called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands."""
        return [*super().list_commands(ctx), *sorted(_elsewhere())]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a command; one of another package is imported now."""
        own = super().get_command(ctx, cmd_name)
        if own is not None or cmd_name not in _elsewhere():
            return own
        try:
            command = _elsewhere()[cmd_name].load()
        except ModuleNotFoundError as error:
            missing = str(error.name)

            @click.command(cmd_name, context_settings={"ignore_unknown_options": True})
            @click.argument("args", nargs=-1)
            def unavailable(args: tuple[str, ...]) -> None:
                raise click.ClickException(
                    f"{cmd_name} needs {missing}, which is not installed; see README.md, "
                    "'With ROS 2'"
                )

            unavailable.short_help = f"(needs {missing}, which is not installed)"
            return unavailable
        assert isinstance(command, click.Command)  # noqa: S101 - the entry point's contract
        return command


def _elsewhere() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group="demandops.commands")}


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="demandops")
@click.option("-v", "--verbose", is_flag=True, help="Say what is being done.")
def cli(verbose: bool) -> None:
    """Turn demands for applications into desired state in Git.

    Start with `demandops init DIR --bare`, then `demandops serve --state-repo DIR` for demands over
    ROS 2, or `demandops request FILE --state-repo DIR` for demands from files.
    """
    level = logging.INFO if verbose else logging.WARNING
    logging.basicConfig(level=level, format="%(levelname)s: %(message)s", stream=sys.stderr)


cli.add_command(init.init)
cli.add_command(request.request)
cli.add_command(decommission.decommission)
cli.add_command(bookkeeping.bookkeeping)
cli.add_command(why.why)
cli.add_command(log.log)
cli.add_command(diff.diff)
cli.add_command(overrides.overrides)
cli.add_command(rollback.rollback)
cli.add_command(check.check)
cli.add_command(verify.verify)
cli.add_command(upgrade.upgrade)
cli.add_command(schema.schema)
cli.add_command(status.status)
cli.add_command(proposals.proposals)


def main(args: list[str] | None = None) -> None:
    """Run the command line and exit with its code."""
    sys.exit(run(args))


def run(args: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    try:
        code = cli.main(args=args, prog_name="demandops", standalone_mode=False)
        return code if isinstance(code, int) else 0
    except click.UsageError as error:
        error.show()
        return _EXIT_USAGE
    except click.Abort:
        errors.print("interrupted")
        return _EXIT_INTERRUPTED
    except click.ClickException as error:
        errors.print(f"error: {error.format_message()}")
        return _EXIT_USER
    except InvalidInput as error:
        for found in error.faults:
            errors.print(f"error: {found}")
        return _EXIT_USER
    except DemandOpsError as error:
        errors.print(f"error: {error}")
        return _EXIT_USER
    except BrokenPipeError:  # `demandops log | head`
        sys.stderr.close()
        return 0
    except Exception as error:
        logging.getLogger("demandops").debug("a fault of the program", exc_info=True)
        errors.print(
            f"error: a fault of demandops itself: {type(error).__name__}: {error}\n"
            "please report it with the output of the same command after `demandops -v`"
        )
        if logging.getLogger().isEnabledFor(logging.INFO):
            logging.exception("traceback")
        return _EXIT_FAULT


if __name__ == "__main__":
    main()
