"""The parts of the rig that need no cluster: program builds, process control, the Git server."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.e2e.rig import githttp, gobuild, kwok, net, settings, tools
from tests.e2e.rig.clone import Clone
from tests.e2e.rig.errors import RigError
from tests.e2e.rig.processes import Component, Processes
from tests.e2e.rig.workdir import Workdir

FAKE_GO = """\
#!/bin/sh
# A fake Go toolchain: `build` writes its target slowly and records its run.
case "$1" in
env) printf 'go%s\\nlinux\\namd64\\n' "${FAKE_GO_VERSION:-1.26.8}" ;;
mod) mkdir fetched ;;
list) if [ "$3" = -m ]; then echo "$FAKE_GO_MODULE"; else printf 'one\\ntwo\\n'; fi ;;
build)
    echo run >> "$FAKE_GO_RUNS"
    printf 'one\\ntwo\\n' >&2
    [ -z "$FAKE_GO_FAULT" ] || { echo "$FAKE_GO_FAULT" >&2; exit 2; }
    while [ "$1" != -o ]; do shift; done
    printf half > "$2"
    for _ in $(seq "${FAKE_GO_SECONDS:-0}"); do sleep 1; done
    printf whole > "$2" ;;
esac
"""


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Put a fake Go on PATH and use an empty cache; return the file where the fake lists builds."""
    program = tmp_path / "bin" / "go"
    program.parent.mkdir()
    program.write_text(FAKE_GO)
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


def quiet(_: str) -> None:
    """Ignore a line of progress; tests pass this function as the `report` of `ensure`."""


def test_a_program_is_built_once_with_its_crds(runs: Path) -> None:
    first = tools.ensure(["source-controller"], quiet)
    assert first["source-controller"].read_text() == "whole"
    assert [path.name for path in tools.crd_files(first)] == ["a.yaml"]
    assert tools.ensure(["source-controller"], quiet) == first
    assert runs.read_text().split() == ["run"]


def test_another_go_version_is_another_program(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = tools.ensure(["etcd"], quiet)
    monkeypatch.setenv("FAKE_GO_VERSION", "1.27.0")
    assert tools.ensure(["etcd"], quiet) != first
    assert len(runs.read_text().split()) == 2


def test_two_runs_at_once_build_once(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAKE_GO_SECONDS", "1")
    said: list[str] = []
    with ThreadPoolExecutor() as pool:
        both = list(pool.map(lambda _: tools.ensure(["etcd"], said.append), range(2)))
    assert both[0] == both[1]
    assert runs.read_text().split() == ["run"]
    assert any("another run is building" in text for text in said)


def test_a_killed_build_leaves_nothing_that_looks_done(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FAKE_GO_SECONDS", "30")
    program = "from tests.e2e.rig import tools; tools.ensure(['etcd'])"
    root = Path(__file__).resolve().parents[2]
    run = subprocess.Popen([sys.executable, "-c", program], cwd=root)
    try:
        deadline = time.monotonic() + 60
        while not list(tools.cache_root().glob(".building-*/etcd")):
            assert time.monotonic() < deadline
            time.sleep(0.05)
    finally:
        run.kill()
        run.wait()
    assert list(tools.cache_root().glob("etcd-*")) == []
    monkeypatch.setenv("FAKE_GO_SECONDS", "0")
    assert tools.ensure(["etcd"], quiet)["etcd"].read_text() == "whole"
    assert list(tools.cache_root().glob(".building-*")) == []


def test_a_failed_build_shows_the_compilers_message(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FAKE_GO_FAULT", "main.go:1: syntax error")
    with pytest.raises(RigError) as caught:
        tools.ensure(["etcd"], quiet)
    assert str(caught.value).endswith(" failed with 2:\n  main.go:1: syntax error")
    assert list(tools.cache_root().glob("*etcd-*")) == []


def test_an_old_go_is_named_with_what_to_install(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FAKE_GO_VERSION", "1.19.8")
    with pytest.raises(RigError, match=r"is go1\.19\.8, too old for .*/etcd/go\.mod: install Go "):
        tools.ensure(["etcd"], quiet)


def test_a_missing_go_is_named_with_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(RigError) as caught:
        tools.ensure(["etcd"], quiet)
    expected = "tests/e2e/tools: `go` is not on PATH: " + gobuild.REMEDY.format(needed="1.26")
    assert str(caught.value) == expected


def test_every_wrapper_is_pinned_and_used() -> None:
    folders = {path.name for path in tools.WRAPPERS.iterdir() if path.is_dir()}
    assert folders == {tool.wrapper for tool in tools.TOOLS.values()}
    for folder in folders:
        assert (tools.WRAPPERS / folder / "go.sum").stat().st_size > 0


def test_an_unknown_tool_is_refused() -> None:
    with pytest.raises(RigError, match=r"^no such tool: kubelet; there are etcd, "):
        tools.ensure(["kubelet"], quiet)


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    started = Processes(tmp_path / "logs", {"PATH": os.environ["PATH"]})
    yield started
    started.stop_all()


def shell(
    name: str, script: str, probe: net.Probe = lambda: None, seconds: float = 60
) -> Component:
    return Component(name, ("/bin/sh", "-c", script), probe, {}, seconds, stop_seconds=1)


def test_a_start_that_fails_shows_reason_and_log(processes: Processes) -> None:
    with pytest.raises(RigError) as caught:
        processes.start_together([shell("x", "echo cannot bind; exit 3", lambda: "no answer")])
    assert str(caught.value).startswith("x: ended with 3 after ")
    assert str(caught.value).endswith("\n  cannot bind\n")


def test_a_start_that_takes_too_long_shows_reason_and_log(processes: Processes) -> None:
    component = shell("x", "echo waiting; sleep 60", lambda: "503 etcd not ready", seconds=3)
    with pytest.raises(RigError) as caught:
        processes.start_together([component])
    assert str(caught.value).startswith("x: not ready after 3 s: 503 etcd not ready\n")
    assert str(caught.value).endswith("\n  waiting\n")


def test_a_process_that_ignores_sigterm_is_killed_with_its_children(
    processes: Processes, tmp_path: Path
) -> None:
    note = tmp_path / "child"
    script = f"trap '' TERM; sleep 60 & echo $! > {note}; while :; do sleep 1; done"
    processes.start_together([shell("deaf", script, lambda: None if note.exists() else "not yet")])
    pid = processes.pids()["deaf"]
    time.sleep(0.2)
    child = int(note.read_text())
    processes.stop_all()
    assert processes.pids() == {}
    assert not Path(f"/proc/{pid}").exists()
    assert not Path(f"/proc/{child}").exists()


def test_a_process_outlives_the_thread_that_started_it(
    processes: Processes, tmp_path: Path
) -> None:
    note = tmp_path / "note"  # once this file exists, the process is bound to its parent
    component = shell(
        "long", f"touch {note}; sleep 60", lambda: None if note.exists() else "not yet"
    )
    thread = threading.Thread(target=processes.start_together, args=([component],))
    thread.start()
    thread.join()
    time.sleep(0.3)
    processes.check()


@pytest.fixture
def git_port(tmp_path: Path) -> Iterator[int]:
    server = githttp.GitServer(tmp_path / "served", net.LOOPBACK, net.free_port(), githttp.Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    yield server.server_address[1]
    server.shutdown()
    thread.join()
    server.server_close()


def test_a_large_push_and_a_partial_clone(git_port: int, tmp_path: Path) -> None:
    """Git sends a pack above one megabyte in chunks, and a fetch can leave out blobs."""
    address = f"{net.url(git_port)}/a/state.git"
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


def test_of_two_pushes_from_one_commit_the_second_is_refused(git_port: int, tmp_path: Path) -> None:
    address = f"{net.url(git_port)}/state.git"
    Clone(address, tmp_path / "one").push({"a": "1"})
    with pytest.raises(AssertionError, match=r"\[rejected\]"):
        Clone(address, tmp_path / "two").push({"b": "1"})


def test_reading_a_missing_repository_creates_nothing(git_port: int, tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="not found"):
        Clone(f"{net.url(git_port)}/none.git", tmp_path / "one").git("fetch", "origin")
    assert list((tmp_path / "served").glob("*")) == []


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


def test_node_names_keep_different_ids_apart() -> None:
    names = {kwok.node_name(node_id) for node_id in ("vehicle00", "vehicle_00", "Vehicle00", "v")}
    assert len(names) == 4
    assert kwok.node_name("vehicle00") == "vehicle00"
    with pytest.raises(RigError, match="not a label value"):
        kwok.manifest("vehicle/00")


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
