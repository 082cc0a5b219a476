"""The parts of the rig that need no cluster: program builds, process control, the Git server."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.e2e.rig import RigError, githttp, net, settings, tools
from tests.e2e.rig.kube import Kube
from tests.e2e.rig.processes import Component, Processes
from tests.kit.http import kubeconfig, running
from tests.kit.repo import git
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


def test_a_program_is_built_once_with_its_crds(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    second_waits = runs.with_name("second-waits")
    monkeypatch.setenv("FAKE_GO_UNTIL", str(second_waits))

    def report(text: str) -> None:
        if "another run is building" in text:
            second_waits.touch()

    with ThreadPoolExecutor() as pool:  # two runs at once
        first, second = pool.map(lambda _: tools.ensure(["source-controller"], report), range(2))
    assert first == second == tools.ensure(["source-controller"])
    assert first["source-controller"].read_text() == "whole"
    assert [path.name for path in tools.crd_files(first)] == ["a.yaml"]
    assert runs.read_text().split() == ["run"]
    monkeypatch.setenv("FAKE_GO_VERSION", "1.27.0")  # another Go makes another program
    assert tools.ensure(["source-controller"]) != first


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
    monkeypatch.setenv("FAKE_GO_UNTIL", "/never")
    with killed("from tests.e2e.rig import tools; tools.ensure(['etcd'])"):
        wait_until(lambda: [*tools.cache_root().glob(".building-*/etcd/etcd")], "a build")
    assert list(tools.cache_root().glob("etcd-*")) == []
    monkeypatch.delenv("FAKE_GO_UNTIL")
    assert tools.ensure(["etcd"])["etcd"].read_text() == "whole"
    assert list(tools.cache_root().glob(".building-*")) == []


@pytest.mark.parametrize(
    ("variable", "value", "told"),
    [
        ("FAKE_GO_FAULT", "main.go:1: syntax error", " failed with 2:\n  main.go:1: syntax error$"),
        ("PATH", "/nowhere", "not on PATH: `make go` installs it"),
    ],
    ids=["a failed build", "a missing Go"],
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


def shell(script: str, probe: net.Probe = lambda: None, seconds: float = 60) -> Component:
    return Component("x", ("/bin/sh", "-c", script), probe, {}, seconds, stop_seconds=1)


def test_a_start_that_fails_shows_reason_and_log(processes: Processes) -> None:
    def probe() -> str:
        wait_until(lambda: "waiting\n" in processes.log("x").read_text(), "the output")
        return "503 etcd"

    for component, begins, ends in (
        (shell("echo cannot bind; exit 3", lambda: "no"), "ended with 3\n", "cannot bind"),
        (shell("echo waiting; sleep 60", probe, seconds=0), "not ready after 0 s: 503", "waiting"),
    ):
        with pytest.raises(RigError) as caught:
            processes.start_together([component])
        assert str(caught.value).startswith(f"x: {begins}")
        assert str(caught.value).endswith(f"\n  {ends}\n")


def test_a_part_that_dies_is_named_while_a_test_waits_for_the_cluster(
    processes: Processes, tmp_path: Path
) -> None:
    end = tmp_path / "end"
    processes.start_together([shell(f"echo a fault; until [ -e {end} ]; do sleep 0.1; done")])
    kube = Kube(kubeconfig(tmp_path, "http://127.0.0.1:9"), tmp_path, processes.check)
    with pytest.raises(RigError, match=r"^x: ended with 0\n.*\n(.*\n)?  a fault\n$"):
        kube.wait("an event that never happens", end.touch)
    kube.close()


def test_a_process_that_ignores_sigterm_is_killed_with_its_children(
    processes: Processes, tmp_path: Path
) -> None:
    note = tmp_path / "child"
    script = f"trap '' TERM; sleep 600 & echo $! > {note}; while :; do sleep 1; done"
    processes.start_together([shell(script)])
    pid = processes.pids()["x"]
    wait_until(lambda: note.exists() and bool(note.read_text()), "the child's pid")
    child = Path("/proc", note.read_text().strip())
    processes.stop_all()
    assert processes.pids() == {}
    assert not Path(f"/proc/{pid}").exists()
    wait_until(lambda: not child.exists(), "the end of the child")


def test_nothing_outlives_a_killed_test_run(tmp_path: Path) -> None:
    program = "import json, time; from tests.e2e.test_rig_parts import *\n"
    program += f"p = Processes(Path({str(tmp_path)!r}), {{}}); p.start_together([shell("
    program += "'sleep 600')]); print(json.dumps(p.pids()), flush=True); time.sleep(600)"
    with killed(program) as run:
        assert run.stdout is not None
        pids = json.loads(run.stdout.readline())
    wait_until(lambda: not Path(f"/proc/{pids['x']}").exists(), "the end of the part")


@pytest.fixture
def git_url(tmp_path: Path) -> Iterator[str]:
    with running(githttp.GitServer(tmp_path / "served", net.LOOPBACK, 0, githttp.Handler)) as url:
        yield url


def test_the_git_server_takes_large_pushes_and_partial_clones_and_no_forced_push(
    git_url: str, tmp_path: Path
) -> None:
    """Git sends a pack above one megabyte in chunks, and a fetch can leave out blobs."""
    address, noise = f"{git_url}/a/state.git", os.urandom(3_000_000).hex()

    def push(folder: Path, **files: str) -> str:
        git(tmp_path, "init", "--quiet", str(folder))
        for name, text in files.items():
            (folder / name).write_text(text)
        git(folder, "add", "--all")
        git(folder, "commit", "--quiet", "--message=change")
        git(folder, "push", "--quiet", address, "HEAD:main")
        return git(folder, "rev-parse", "HEAD")

    commit = push(tmp_path / "one", big=noise, small="s")
    with pytest.raises(AssertionError, match=r"\[rejected\]"):
        push(tmp_path / "two", other="1")
    other = tmp_path / "three"
    git(tmp_path, "clone", "--quiet", "--no-checkout", "--filter=blob:none", address, str(other))
    assert git(other, "rev-parse", "HEAD") == commit
    objects = git(other, "rev-list", "--objects", "--missing=print", "HEAD").split()
    left_out = [name for name in objects if name.startswith("?")]
    assert len(left_out) == 2, "the fetch must leave out both blobs"
    git(other, "checkout", "--quiet", "HEAD")
    assert (other / "big").read_text() == noise

    with pytest.raises(AssertionError, match="not found"):
        git(other, "fetch", f"{git_url}/none.git")
    assert [path.name for path in (tmp_path / "served").iterdir()] == ["a"]


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
