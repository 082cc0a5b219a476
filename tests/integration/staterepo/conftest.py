"""Every test here has its own data folder, its own Git set-up, and a limit of its own."""

from __future__ import annotations

import faulthandler
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

import pytest
import staterepo_rig as rig

_LIMIT_S = 30.0


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line(
        "markers", f"limit(seconds): fail the test when it takes longer (default {_LIMIT_S:.0f})"
    )


@pytest.fixture(autouse=True)
def _limited(request: pytest.FixtureRequest) -> Iterator[None]:
    """Turn a deadlock into a failure, with every thread's stack."""
    marker = request.node.get_closest_marker("limit")
    seconds = float(marker.args[0]) if marker else _LIMIT_S

    def stop(number: int, frame: FrameType | None) -> None:
        faulthandler.dump_traceback(file=2)
        raise TimeoutError(f"the test has not ended after {seconds:.0f} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@pytest.fixture(autouse=True)
def data_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the generators of a test keep their outboxes and clones."""
    home = tmp_path / "data"
    monkeypatch.setenv("DEMANDOPS_DATA_HOME", str(home))
    for name, value in rig.GIT_ENVIRONMENT.items():
        monkeypatch.setenv(name, value)
    return home


@pytest.fixture(scope="session")
def _all_drivers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[rig.Drivers]:
    drivers = rig.Drivers(tmp_path_factory.mktemp("drivers"))
    yield drivers
    drivers.close()


@pytest.fixture
def drivers(_all_drivers: rig.Drivers, data_home: Path) -> Iterator[rig.Drivers]:
    """Starts generators in processes of their own, and kills what is left of them."""
    yield _all_drivers
    _all_drivers.kill_runs()


@pytest.fixture(scope="session")
def _template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rig.init(tmp_path_factory.mktemp("template") / "state.git")


@pytest.fixture
def new_repo(_template: Path, tmp_path: Path) -> Callable[[str], Path]:
    """Make further bare state repos, as `demandops init --bare` does."""

    def make(name: str) -> Path:
        return Path(shutil.copytree(_template, tmp_path / name))

    return make


@pytest.fixture
def bare(new_repo: Callable[[str], Path]) -> Path:
    """A bare state repo, fresh from `demandops init`."""
    return new_repo("state.git")


@pytest.fixture(params=["embedded", "file-url"])
def address(request: pytest.FixtureRequest, bare: Path) -> str:
    """The same state repo, used in place and as a remote."""
    return str(bare) if request.param == "embedded" else bare.as_uri()


@pytest.fixture
def url(bare: Path) -> str:
    """The state repo as a remote that is cloned, fetched and pushed to."""
    return bare.as_uri()
