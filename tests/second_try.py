"""In the gate, tests that failed run once more, alone, when all others have ended.

Tests that then pass do not fail the run. Their ids go to the file that ``UNSTEADY`` names.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Generator
from pathlib import Path

import pytest

_MOST = 20  # more failures have one cause, and their second run would take too long


class SecondTry:
    def __init__(self, unsteady: Path) -> None:
        self._unsteady = unsteady
        self._failed: dict[str, None] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self._failed[report.nodeid] = None

    # The outermost wrapper acts last, when the first failures are printed.
    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> Generator[None, object, object]:
        result = yield
        is_few = len(self._failed) <= _MOST
        if session.exitstatus == pytest.ExitCode.TESTS_FAILED and is_few:
            print(f"\n{len(self._failed)} failed, and run once more, alone", flush=True)
            command = [sys.executable, "-m", "pytest", "-x", "-p", "no:cacheprovider"]
            again = subprocess.run(
                [*command, *self._failed],
                env={name: value for name, value in os.environ.items() if name != "UNSTEADY"},
                cwd=session.config.rootpath,
                check=False,
            )
            if again.returncode == 0:
                session.exitstatus = pytest.ExitCode.OK
                with self._unsteady.open("a") as file:
                    file.writelines(f"{test}\n" for test in self._failed)
        return result
