"""What a process with ROS needs: ROS arguments, a log, an executor's thread and stop signals."""

from __future__ import annotations

import atexit
import logging
import os
import signal
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

import click
import rclpy
from demandops.base.quoting import OneLineFormatter, one_line
from demandops.base.runtime import REAL
from demandops.cli.main import ExitCode
from demandops.cli.output import errors
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.logging import LoggingSeverity, set_logger_level
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions


class ExecutorThread:
    """Runs a node's callbacks in a thread, which must end before the node is destroyed."""

    def __init__(self, node: Node, name: str = "executor") -> None:
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._over = REAL.event()

        def spin() -> None:
            while not self._over.is_set() and self._executor.context.ok():
                with suppress(ExternalShutdownException):
                    self._executor.spin_once()

        self._thread = REAL.keep_running(name, spin)
        # If no caller closes it: a thread that waits for ROS while Python exits aborts the process.
        atexit.register(self.close)

    def call(self, callback: Callable[[], object]) -> None:
        self._executor.create_task(callback)

    def close(self) -> None:
        """End the thread, so that the node may be destroyed; wait up to 20 s for a callback."""
        # rclpy's shutdown is not enough, because it does not wait for running callbacks
        atexit.unregister(self.close)
        if not self._over.is_set():
            self._over.set()
            self.call(lambda: None)  # wakes the thread
            self._thread.join(20.0)
            self._executor.shutdown(timeout_sec=0)


class StopSignals:
    """Handles Ctrl-C, SIGTERM and SIGHUP: the first ends the program in order, the second at once.

    A closed terminal sends SIGHUP, unless `nohup` started the program.
    """

    def __init__(self) -> None:
        self.stopping = False
        self._woken = REAL.event()

    def __enter__(self) -> StopSignals:
        numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        self._before = {
            number: signal.signal(number, self._handle)
            for number in numbers
            if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN
        }
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def wait(self, until: Callable[[], bool] = lambda: False) -> None:
        """Wait until a signal comes or ``until()`` is true, which each :meth:`wake` checks."""
        while not (self.stopping or until() or REAL.unsound):
            self._woken.wait(0.2)  # poll, because another thread may get the signal
            self._woken.clear()
        if REAL.unsound is not None:
            errors.print(f"error: {REAL.unsound}")
            os._exit(ExitCode.PROGRAM_ERROR)  # an orderly exit could answer goals

    def wake(self) -> None:
        self._woken.set()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.stopping:
            errors.print("stopped at once")
            os._exit(ExitCode.INTERRUPTED)
        self.stopping = True


class RosLogHandler(logging.Handler):
    def __init__(self, logger: RcutilsLogger) -> None:
        super().__init__()
        self._log = logger
        self.setFormatter(OneLineFormatter())

    def emit(self, record: logging.LogRecord) -> None:
        text = self.format(record)  # in rclpy, a line of code can log at one level only
        if record.levelno >= logging.ERROR:
            self._log.error(text)
        elif record.levelno >= logging.WARNING:
            self._log.warning(text)
        elif record.levelno >= logging.INFO:
            self._log.info(text)
        else:
            self._log.debug(text)


@contextmanager
def started(arguments: Sequence[str]) -> Iterator[list[str]]:
    # without ROS's signal handlers, because each command handles the signals
    ros_args = list(arguments)
    if ros_args and ros_args[0] != "--ros-args":
        raise click.UsageError(
            f"unexpected argument {ros_args[0]}; ROS arguments follow --ros-args"
        )
    home = os.environ.get("ROS_HOME") or os.environ.get("HOME") or ""
    if not (os.environ.get("ROS_LOG_DIR") or os.access(home, os.W_OK)):
        # ROS's log library does not start in a container without a home folder
        os.environ["ROS_LOG_DIR"] = str(Path(tempfile.gettempdir()) / "ros-log")
    try:
        no_signals = SignalHandlerOptions.NO
        rclpy.init(args=["demandops", *ros_args], signal_handler_options=no_signals)
    except Exception as error:  # rclpy raises errors of many kinds
        message = one_line(str(error))
        if not ros_args:
            raise click.ClickException(f"ROS does not start: {message}") from None
        raise click.UsageError(
            f"ROS does not start with the arguments after --ros-args: {message}"
        ) from None
    try:
        yield ros_args
    except Exception as error:
        if not ros_args or type(error).__module__.partition(".")[0] not in ("rclpy", "_rclpy"):
            raise
        raise click.UsageError(
            f"ROS does not take the arguments after --ros-args: {one_line(str(error))}"
        ) from error
    finally:
        rclpy.try_shutdown()


def log_to(logger: RcutilsLogger, level: str) -> None:
    set_logger_level(logger.name, LoggingSeverity[level.upper()])
    library_log = logging.getLogger("demandops")
    library_log.handlers, library_log.propagate = [RosLogHandler(logger)], False
    library_log.setLevel(logging.DEBUG)
