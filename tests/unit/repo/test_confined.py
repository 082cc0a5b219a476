"""A confined program, such as Helm, reaches no network, knows no secrets, and ends."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest
from demandops.decide.state import trial_releases
from demandops.repo.merge_check import confined_process
from demandops.repo.merge_check import rendered_charts as helm_runs
from demandops.repo.merge_check.rendered_charts import (
    HELM_BIN,
    Helm,
    Report,
    kinds_refused,
    parsed_error,
    parsed_kinds,
    parsed_lint,
)

from tests.kit import plain_yaml
from tests.kit.config import edited
from tests.kit.http import serving
from tests.kit.memory import MemoryRepo


def confine(*command: str, seconds: int = 60) -> subprocess.CompletedProcess[str]:
    confined = [sys.executable, "-IS", confined_process.__file__, str(seconds), *command]
    return subprocess.run(confined, capture_output=True, text=True, check=False)


PYTHON = (sys.executable, "-c")
SAID = plain_yaml.beside(__file__, "helm-says")
Ran = Callable[[str], Report]
FETCH = "import sys, urllib.request; urllib.request.urlopen(sys.argv[1], timeout=60)"


def test_it_reaches_no_network_where_the_kernel_lets_us_say_so() -> None:
    unshare = "import ctypes; raise SystemExit(ctypes.CDLL(None).unshare(0x50000000) and 9)"
    if subprocess.run([*PYTHON, unshare], check=False).returncode == 9:
        pytest.skip("this kernel lets nobody make a network namespace")
    with serving() as server:
        assert confine(*PYTHON, FETCH, server.url).returncode == 1
        assert server.calls == []
        subprocess.run([*PYTHON, FETCH, server.url], check=True)


@pytest.mark.parametrize(
    "code", ["while True: pass", "x = b'x' * (8 << 30)", "open('big', 'wb').truncate(1 << 40)"]
)
def test_it_has_only_so_much(code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert confine(*PYTHON, code, seconds=1).returncode != 0


def test_a_program_that_cannot_run_is_told() -> None:
    told = "Error: /nowhere/helm cannot be run: No such file or directory\n"
    assert confine("/nowhere/helm", seconds=1).stderr == told


@pytest.fixture
def ran(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Ran:
    """Return a function that runs a program in place of helm and returns the report."""

    def run(code: str) -> Report:
        program = tmp_path / "program"
        program.write_text(f"#!{sys.executable} -IS\nimport os, sys\n{textwrap.dedent(code)}\n")
        program.chmod(0o755)
        monkeypatch.setenv(HELM_BIN, str(program))
        helm = Helm.find()
        assert helm
        return helm.template(tmp_path / "chart", tmp_path / "values", tmp_path / "home", "r", "n")

    return run


def test_helm_knows_nothing_of_the_environment(
    ran: Ran, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("TOKEN", "HELM_PLUGINS", "HELM_REGISTRY_CONFIG", "XDG_CONFIG_HOME", "LD_PRELOAD_"):
        monkeypatch.setenv(name, "hunter2")
    report = ran("for name in os.environ: print('---\\nkind:', name, os.environ[name])")
    known = {kind for _, kind in report.kinds} - {"LC_CTYPE", "_DEMANDOPS_PROCESS"}
    assert known == {"PATH", "HOME", "TMPDIR", "KUBECONFIG", "HELM_PLUGINS"}
    assert report.ended
    assert [*tmp_path.joinpath("home").iterdir()]  # what it writes lands there


def test_output_without_end_is_a_fault(ran: Ran) -> None:
    report = ran("while True: print('a' * 1000000)")
    assert not report.ended
    assert [fault.file for fault in report.faults] == ["chart"]


def test_a_program_that_loops_is_a_fault(ran: Ran, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(helm_runs, "_HELM_CPU_S", 1)
    report = ran("while True: pass")
    assert not report.ended
    assert report.faults


def test_a_message_of_any_length_is_parsed_soon(ran: Ran) -> None:
    report = ran("sys.exit('Error: ' + 'templates/' * 5_000_000)")
    assert report.ended
    assert len(report.faults[0].message) < 1_000


@pytest.mark.parametrize(("err", "file", "line"), SAID["errors"])
def test_an_error_names_template_and_line(err: str, file: str, line: int | None) -> None:
    err = err.replace("LONG", "9" * 5000)
    fault = parsed_error(f"level=WARN msg=x\nError: {err}\n\nUse --debug flag\n", "camera")
    assert (fault.file, fault.line) == (file, line)
    assert fault.message.startswith(f"helm says '{err[:40]}")
    assert "--debug" not in fault.message


def test_the_kinds_of_objects_are_read() -> None:
    assert [*parsed_kinds(SAID["template"])] == [("apps", "Deployment"), ("", "ConfigMap")]


def test_lint_gives_errors_and_warnings_and_no_advice() -> None:
    found = parsed_lint(SAID["lint"], "camera")
    (warning,), (error,) = found.warnings, found.faults
    assert warning.file == "camera/templates/hpa.yaml"
    assert "'/replicas': got string, want integer - at '/image': missing prop" in error.message


@pytest.mark.parametrize(("field", "kind", "remedy"), SAID["kinds refused"])
def test_what_to_do_about_a_kind(field: str, kind: str, remedy: str) -> None:
    state = MemoryRepo(
        edited("policy/access-domains.yaml", 'nodes: ["*"]', f'nodes: ["*"]\n    {field}')
    ).state
    release = next(one for found in trial_releases(state.config).values() for one in found)
    group, _, name = kind.partition("/")
    (fault,) = kinds_refused(Report(((group, name),)), release, state.config)
    assert f"renders a {name}, which is not among the kinds of access domain 'perc" in fault.message
    assert remedy in fault.message
