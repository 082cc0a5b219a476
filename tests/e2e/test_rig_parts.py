"""The parts of the rig that need no cluster: program builds, process control, the Git server."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.e2e.rig import githttp, gobuild, net, settings, tools
from tests.e2e.rig.clone import Clone
from tests.e2e.rig.errors import RigError
from tests.e2e.rig.kube import Kube
from tests.e2e.rig.processes import Component, Processes
from tests.e2e.rig.workdir import Workdir
from tests.kit.http import kubeconfig, running
from tests.kit.rig import wait_until

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Put a fake Go on PATH and use an empty cache; return the file where the fake lists builds."""
    program = tmp_path / "bin" / "go"
    program.parent.mkdir()
    shutil.copy(Path(__file__).with_name("fake-go"), program)
    program.chmod(0o755)
    crds = tmp_path / "module" / "config" / "crd" / "bases"
    crds.mkdir(parents=True)
    (crds / "a.yaml").write_text("kind: CustomResourceDefinition\n")
    noted = tmp_path / "runs"
    noted.touch()
    monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("FAKE_GO_RUNS", str(noted))
    monkeypatch.setenv("FAKE_GO_MODULE", str(tmp_path / "module"))
    monkeypatch.setenv(tools.CACHE_VARIABLE, str(tmp_path / "cache"))
    return noted


def test_a_program_is_built_once_with_its_crds(runs: Path) -> None:
    first = tools.ensure(["source-controller"])
    assert first["source-controller"].read_text() == "whole"
    assert [path.name for path in tools.crd_files(first)] == ["a.yaml"]
    assert tools.ensure(["source-controller"]) == first
    assert runs.read_text().split() == ["run"]


def test_another_go_version_is_another_program(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = tools.ensure(["etcd"])
    monkeypatch.setenv("FAKE_GO_VERSION", "1.27.0")
    assert tools.ensure(["etcd"]) != first
    assert len(runs.read_text().split()) == 2


def test_two_runs_at_once_build_once(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAKE_GO_SECONDS", "1")
    said: list[str] = []
    with ThreadPoolExecutor() as pool:
        both = list(pool.map(lambda _: tools.ensure(["etcd"], said.append), range(2)))
    assert both[0] == both[1]
    assert runs.read_text().split() == ["run"]
    assert any("another run is building" in text for text in said)


@contextmanager
def killed(program: str) -> Iterator[subprocess.Popen[str]]:
    argv = [sys.executable, "-c", program]
    run = subprocess.Popen(argv, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    try:
        yield run
    finally:
        run.kill()
        run.communicate()


def test_a_killed_build_leaves_nothing_that_looks_done(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FAKE_GO_SECONDS", "30")
    with killed("from tests.e2e.rig import tools; tools.ensure(['etcd'])"):
        wait_until(lambda: [*tools.cache_root().glob(".building-*/etcd")], "a build")
    assert list(tools.cache_root().glob("etcd-*")) == []
    monkeypatch.setenv("FAKE_GO_SECONDS", "0")
    assert tools.ensure(["etcd"])["etcd"].read_text() == "whole"
    assert list(tools.cache_root().glob(".building-*")) == []


@pytest.mark.parametrize(
    ("variable", "value", "told"),
    [
        ("FAKE_GO_FAULT", "main.go:1: syntax error", " failed with 2:\n  main.go:1: syntax error$"),
        ("FAKE_GO_VERSION", "1.19.8", r"is go1\.19\.8, too old for .*/etcd/go\.mod: install Go "),
        ("PATH", "/nowhere", re.escape("not on PATH: " + gobuild.REMEDY.format(needed="1.26"))),
    ],
    ids=["a failed build", "an old Go", "a missing Go"],
)
def test_a_fault_of_the_build_is_told(
    runs: Path, monkeypatch: pytest.MonkeyPatch, variable: str, value: str, told: str
) -> None:
    monkeypatch.setenv(variable, value)
    with pytest.raises(RigError, match=told):
        tools.ensure(["etcd"])
    assert list(tools.cache_root().glob("*etcd-*")) == []


def test_every_wrapper_is_pinned_and_used() -> None:
    folders = {path.name for path in tools.WRAPPERS.iterdir() if path.is_dir()}
    assert folders == {tool.wrapper for tool in tools.TOOLS.values()}
    for folder in folders:
        assert (tools.WRAPPERS / folder / "go.sum").stat().st_size > 0


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    started = Processes(tmp_path / "logs", {"PATH": os.environ["PATH"]})
    yield started
    started.stop_all()


def shell(
    name: str, script: str, probe: net.Probe = lambda: None, seconds: float = 60
) -> Component:
    return Component(name, ("/bin/sh", "-c", script), probe, {}, seconds, stop_seconds=1)


@pytest.mark.parametrize(
    ("component", "begins", "ends"),
    [
        (
            shell("x", "echo cannot bind; exit 3", lambda: "no"),
            "ended with 3 after ",
            "cannot bind",
        ),
        (
            shell("x", "echo waiting; sleep 60", lambda: "503 etcd", seconds=3),
            "not ready after 3 s: 503 etcd\n",
            "waiting",
        ),
    ],
    ids=["it ends", "it takes too long"],
)
def test_a_start_that_fails_shows_reason_and_log(
    processes: Processes, component: Component, begins: str, ends: str
) -> None:
    with pytest.raises(RigError) as caught:
        processes.start_together([component])
    assert str(caught.value).startswith(f"x: {begins}")
    assert str(caught.value).endswith(f"\n  {ends}\n")


def test_a_part_that_dies_is_named_while_a_test_waits_for_the_cluster(
    processes: Processes, tmp_path: Path
) -> None:
    end = tmp_path / "end"
    script = f"echo a fault; until [ -e {end} ]; do sleep 0.1; done"
    processes.start_together([shell("part", script)])
    kube = Kube(kubeconfig(tmp_path, "http://127.0.0.1:9"), tmp_path, processes.check)
    with pytest.raises(RigError, match=r"^part: ended with 0 after .*\n.*\n(.*\n)?  a fault\n$"):
        kube.wait("an event that never happens", end.touch)
    kube.close()


def test_a_process_that_ignores_sigterm_is_killed_with_its_children(
    processes: Processes, tmp_path: Path
) -> None:
    note = tmp_path / "child"
    script = f"trap '' TERM; sleep 60 & echo $! > {note}; while :; do sleep 1; done"
    processes.start_together([shell("deaf", script, lambda: None if note.exists() else "not yet")])
    pid = processes.pids()["deaf"]
    wait_until(lambda: bool(note.read_text()), "the child's pid")
    child = int(note.read_text())
    processes.stop_all()
    assert processes.pids() == {}
    assert not Path(f"/proc/{pid}").exists()
    assert not Path(f"/proc/{child}").exists()


def test_nothing_outlives_a_killed_test_run(tmp_path: Path) -> None:
    program = "import json, time; from tests.e2e.test_rig_parts import *\n"
    program += f"p = Processes(Path({str(tmp_path)!r}), {{}}); p.start_together([shell('long',"
    program += "'sleep 300')]); print(json.dumps(p.pids()), flush=True); time.sleep(300)"
    with killed(program) as run:
        assert run.stdout is not None
        pids = json.loads(run.stdout.readline())
    wait_until(lambda: not Path(f"/proc/{pids['long']}").exists(), "the end of the part")


@pytest.fixture
def git_url(tmp_path: Path) -> Iterator[str]:
    with running(githttp.GitServer(tmp_path / "served", net.LOOPBACK, 0, githttp.Handler)) as url:
        yield url


def test_a_large_push_and_a_partial_clone(git_url: str, tmp_path: Path) -> None:
    """Git sends a pack above one megabyte in chunks, and a fetch can leave out blobs."""
    address = f"{git_url}/a/state.git"
    noise = os.urandom(3_000_000).hex()
    commit = Clone(address, tmp_path / "one").push({"big": noise, "small": "s"})
    other = Clone(address, tmp_path / "two")
    other.git("fetch", "--quiet", "--depth=1", "--filter=blob:none", "origin", "main")
    assert other.git("rev-parse", "FETCH_HEAD").strip() == commit
    objects = other.git("rev-list", "--objects", "--missing=print", "FETCH_HEAD").split()
    assert len([name for name in objects if name.startswith("?")]) == 2, (
        "the fetch must leave out both blobs"
    )
    other.git("checkout", "--quiet", "FETCH_HEAD")
    assert (other.folder / "big").read_text() == noise


def test_what_the_git_server_refuses(git_url: str, tmp_path: Path) -> None:
    """It refuses the second of two pushes from one commit, and creates nothing for a reader."""
    address = f"{git_url}/state.git"
    Clone(address, tmp_path / "one").push({"a": "1"})
    with pytest.raises(AssertionError, match=r"\[rejected\]"):
        Clone(address, tmp_path / "two").push({"b": "1"})
    with pytest.raises(AssertionError, match="not found"):
        Clone(f"{git_url}/none.git", tmp_path / "three").git("fetch", "origin")
    assert [path.name for path in (tmp_path / "served").iterdir()] == ["state.git"]


def test_half_an_existing_cluster_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for variable in ("E2E_KUBECONFIG", "E2E_GIT_URL", "E2E_GIT_PUSH_URL"):
        monkeypatch.delenv(variable, raising=False)
    assert settings.existing("edge") is None
    config = tmp_path / "config"
    config.touch()
    monkeypatch.setenv("E2E_KUBECONFIG", str(config))
    with pytest.raises(RigError, match=r"^E2E_GIT_URL is not set: "):
        settings.existing("edge")
    monkeypatch.setenv("E2E_GIT_URL", "http://git.example/")
    found = settings.Existing(config, "http://git.example", "http://git.example")
    assert settings.existing("edge") == found


def test_a_dead_runs_folder_is_swept_and_a_living_ones_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    living, dead = Workdir("living"), tmp_path / "demandops-rig-dead"
    dead.mkdir()
    (dead / "lock").touch()
    for folder in (living.path, dead):
        os.utime(folder / "lock", (0, 0))
    new = Workdir("new")
    assert {path.name for path in tmp_path.iterdir()} == {living.path.name, new.path.name}
    living.clear(keep_logs=True)
    assert [path.name for path in living.path.iterdir()] == ["logs"]
    new.clear(keep_logs=False)
    assert not new.path.exists()
