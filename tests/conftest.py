"""Fixtures that all tests share.

No test touches the data folder or the Git configuration of the user who runs it.
"""

from __future__ import annotations

import faulthandler
import gc
import os
import random
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

import pytest
from demandops.base import naming
from demandops.connections import ros
from demandops.repo.merge_check.rendered_charts import HELM_BIN
from demandops.serve.generator import Generator
from hypothesis import HealthCheck, settings

from tests.kit import repo
from tests.kit.cli import Run, runner
from tests.kit.limits import LONGEST_TEST_S, PATIENCE_S
from tests.kit.processes import Drivers
from tests.kit.repo import GitRepo, Person
from tests.kit.rig import running
from tests.second_try import SecondTry

_MEMORY = Path("/dev/shm")
_ROOM_IN_MEMORY = 2 << 30


def pytest_configure(config: pytest.Config) -> None:
    for marker in (
        f"limit(seconds): fail the test when it takes longer (default {LONGEST_TEST_S:.0f})",
        "synced: flush files to the disk, as the program does",
        "nightly: waits for wall-clock time, compares times or takes long; not in the gate",
    ):
        config.addinivalue_line("markers", marker)
    if (unsteady := os.environ.get("UNSTEADY")) and not hasattr(config, "workerinput"):
        config.pluginmanager.register(SecondTry(Path(unsteady)))
    # By default an example that takes 200 ms fails, and so do slow strategies. Any example may take
    # that long on a busy machine.
    settings.register_profile("steady", deadline=None, suppress_health_check=[HealthCheck.too_slow])
    settings.load_profile("steady")
    repo.force_writes(False)
    gc.disable()  # until everything is imported and collected
    named = {"TMPDIR", "PYTEST_DEBUG_TEMPROOT"} & os.environ.keys()
    if not named and _MEMORY.is_dir() and shutil.disk_usage(_MEMORY).free >= _ROOM_IN_MEMORY:
        os.environ["PYTEST_DEBUG_TEMPROOT"] = str(_MEMORY)  # for a third of a million files
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in a background job of a shell
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Start with the tests of ROS, which mostly wait, so that others run meanwhile.

    With SHUFFLE=<seed> the others come in an order of chance: modules, and tests within a module.
    """
    if seed := os.environ.get("SHUFFLE"):
        random.Random(seed).shuffle(items)
        module_of = {item: item.nodeid.partition("::")[0] for item in items}
        items.sort(key=lambda item: random.Random(f"{seed} {module_of[item]}").random())
    items.sort(key=lambda item: "tests/ros/" not in item.nodeid)


def pytest_collection_finish() -> None:
    """Exempt all present objects from garbage collection; this saves a seventh of the run time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)
    gc.enable()


def pytest_xdist_auto_num_workers() -> int:
    """Return three workers for every two processors, because tests often wait for processes."""
    return (os.cpu_count() or 1) * 3 // 2


@pytest.fixture(scope="session", autouse=True)
def _isolated(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DEMANDOPS_DATA_HOME", str(tmp_path_factory.mktemp("home")))
        patch.setenv("XDG_CONFIG_HOME", str(tmp_path_factory.mktemp("config")))
        patch.delenv("DEMANDOPS_STATE_REPO", raising=False)
        patch.setenv("no_proxy", "127.0.0.1,localhost")
        # no slow machine leaves a thread behind
        patch.setattr("demandops.serve.generator._GRACE_S", PATIENCE_S)
        patch.setenv(HELM_BIN, "/nowhere/helm")  # so `check` never finds Helm
        for name, value in repo.TEST_GIT_CONFIG.items():
            patch.setenv(name, value)
        yield


@pytest.fixture(autouse=True)
def data_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    home = tmp_path / "home"
    monkeypatch.setenv("DEMANDOPS_DATA_HOME", str(home))
    return home


@pytest.fixture(autouse=True)
def synced(request: pytest.FixtureRequest) -> bool:
    """Let only tests marked `synced` flush files to the disk; return whether this one is marked."""
    on = request.node.get_closest_marker("synced") is not None
    repo.force_writes(on)
    return on


@pytest.fixture
def git_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in repo.GIT_ENVIRONMENT.items():
        monkeypatch.setenv(name, value)


@pytest.fixture
def short_digests(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    caches = (naming.topic_part, ros._number)
    monkeypatch.setattr(naming, "MOST_DIGITS", 1)
    for cached in caches:
        cached.cache_clear()
    yield
    for cached in caches:
        cached.cache_clear()


@pytest.fixture(autouse=True)
def limited(request: pytest.FixtureRequest) -> Iterator[None]:
    marker = request.node.get_closest_marker("limit")
    seconds = float(marker.args[0]) if marker else LONGEST_TEST_S

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


# ---- state repos ----


@pytest.fixture(scope="session")
def bare_template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bare state repo as ``demandops init`` makes it; copy it, never write to it."""
    made = repo.init(tmp_path_factory.mktemp("template") / "state.git")
    repo.git(made, "repack", "-adq")  # few files to copy
    return made


@pytest.fixture
def new_repo(bare_template: Path, tmp_path: Path, synced: bool) -> Callable[[str], Path]:
    def make(name: str) -> Path:
        made = Path(shutil.copytree(bare_template, tmp_path / name))
        repo.force_writes_in(made, synced)
        return made

    return make


@pytest.fixture
def bare(new_repo: Callable[[str], Path]) -> Path:
    return new_repo("state.git")


@pytest.fixture
def state(bare: Path) -> GitRepo:
    return GitRepo(bare)


@pytest.fixture(params=["embedded", "file-url"])
def address(request: pytest.FixtureRequest, bare: Path) -> str:
    """The address of the state repo `bare`; a test runs once with its path, once with its URL."""
    return str(bare) if request.param == "embedded" else bare.as_uri()


@pytest.fixture
def url(bare: Path) -> str:
    return bare.as_uri()


@pytest.fixture
def person(bare: Path, tmp_path: Path) -> Person:
    return Person(bare, tmp_path / "person")


@pytest.fixture(scope="session")
def _checkout_template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return repo.init(tmp_path_factory.mktemp("template") / "state-repo", bare=False)


@pytest.fixture
def checkout(_checkout_template: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(_checkout_template, tmp_path / "state-repo"))


@pytest.fixture(scope="session")
def ros_domain() -> Iterator[int]:
    """A ROS domain for nodes that serve only one test at a time; no other node answers in it."""
    from tests.kit.ros import reserved  # only tests of ROS need rclpy

    with reserved() as domain:
        yield domain


# ---- the program ----


@pytest.fixture
def generator(bare: Path) -> Iterator[Generator]:
    """A generator that works in the state repo `bare` itself, without a clone."""
    with running(bare) as started:
        yield started


@pytest.fixture
def demandops(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    return runner(capsys, monkeypatch)


@pytest.fixture
def drivers(git_environment: None, synced: bool) -> Iterator[Drivers]:
    started = Drivers(synced)
    yield started
    started.close()
