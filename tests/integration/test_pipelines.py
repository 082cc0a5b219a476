"""The pipelines that `init` writes are valid by their schemas, have few rights, and work."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import stat
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import check_jsonschema
import pytest
import yaml
from click.testing import CliRunner
from demandops.cli.repo.pull_request_comment import MARK

from tests.kit.config import skeleton
from tests.kit.http import Answer, Call, serving
from tests.kit.repo import git

GITHUB, GITLAB = ".github/workflows/demandops.yml", ".gitlab-ci.yml"
BASH = shutil.which("bash") or "bash"


@pytest.fixture(scope="module")
def github() -> dict[str, Any]:
    data: dict[str, Any] = yaml.safe_load(skeleton()[GITHUB])
    return data


@pytest.fixture(scope="module")
def gitlab() -> dict[str, Any]:
    data: dict[str, Any] = yaml.safe_load(skeleton()[GITLAB])
    return data


@pytest.mark.parametrize(
    ("path", "options"),
    [
        (GITHUB, ["--builtin-schema", "vendor.github-workflows"]),
        (GITLAB, ["--builtin-schema", "vendor.gitlab-ci", "--data-transform", "gitlab-ci"]),
    ],
    ids=["github", "gitlab"],
)
def test_a_pipeline_is_valid_by_its_schema(checkout: Path, path: str, options: list[str]) -> None:
    ran = CliRunner().invoke(check_jsonschema.main, [*options, str(checkout / path)])
    assert ran.exit_code == 0, ran.output


def test_who_may_write_runs_nothing_of_the_pull_request(github: dict[str, Any]) -> None:
    assert github["permissions"] == {}
    check, comment = github["jobs"]["check"], github["jobs"]["comment"]
    assert check["permissions"] == {"contents": "read"}
    assert comment["permissions"] == {"pull-requests": "write"}
    uses = [step.get("uses", "") for step in comment["steps"]]
    assert not [one for one in uses if one.startswith("actions/checkout")]
    checkout = check["steps"][0]["with"]
    assert (checkout["persist-credentials"], checkout["fetch-depth"]) == (False, 0)
    scripts = [step["run"] for job in (check, comment) for step in job["steps"] if "run" in step]
    # no script contains names from a pull request, like a branch or a title, as text
    assert not [script for script in scripts if "${{" in script]
    for script in scripts:
        subprocess.run([BASH, "-n"], input=script, text=True, check=True)


def environment(tmp_path: Path, **more: str) -> dict[str, str]:
    return {**os.environ, "DEMANDOPS_DATA_HOME": str(tmp_path / "data"), **more}


def helm(tmp_path: Path) -> dict[str, str]:
    """Return the environment for a fake helm that accepts every chart and prints nothing."""
    program = tmp_path / "helm"
    program.write_text(f"#!{BASH}\n")
    program.chmod(0o755)
    return {"HELM_BIN": str(program)}


def put_demandops(at: Path) -> None:
    """Write a script that runs this program, in place of the `demandops` of the pipeline."""
    at.parent.mkdir(parents=True)
    at.write_text(f'#!{BASH}\nexec "{sys.executable}" -m demandops.cli.main "$@"\n')
    at.chmod(at.stat().st_mode | stat.S_IXUSR)


@pytest.fixture(params=["github", "gitlab"])
def installing(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, dict[str, str]]:
    """Return the script that installs the program, and an environment with a fake pip and python.

    The fake programs only print their arguments.
    """
    pipeline: dict[str, Any] = request.getfixturevalue(request.param)
    if request.param == "github":
        (script,) = [one["run"] for one in pipeline["jobs"]["check"]["steps"] if "pip" in str(one)]
    else:
        lines = pipeline["demandops"]["script"]
        until = next(number for number, line in enumerate(lines) if line.startswith("archive="))
        script = "\n".join(lines[:until]).replace("/tmp/demandops", '"$RUNNER_TEMP/demandops"')
    pip, python = tmp_path / "demandops" / "bin" / "pip", tmp_path / "path" / "python"
    for program, text in ((pip, 'echo "pip $*"'), (python, 'echo "python $1 $2"')):
        program.parent.mkdir(parents=True)
        program.write_text(f"#!{BASH}\n{text}\n")
        program.chmod(0o755)
    return script, {"RUNNER_TEMP": str(tmp_path), "PATH": f"{python.parent}:{os.environ['PATH']}"}


def test_a_pipeline_installs_what_the_variable_names(
    installing: tuple[str, dict[str, str]],
) -> None:
    script, environ = installing
    package = "git+https://git.example.org/demandops.git@v1.0.0"
    done = subprocess.run(
        [BASH, "-e", "-c", script],
        env={**environ, "DEMANDOPS_PACKAGE": package},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == f"python -m venv\npip install --quiet {package}\n"


def test_a_pipeline_that_knows_no_package_says_which_variable_to_set(
    installing: tuple[str, dict[str, str]],
) -> None:
    script, environ = installing
    done = subprocess.run(
        [BASH, "-e", "-c", script],
        env={**environ, "DEMANDOPS_PACKAGE": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode != 0, done.stdout) == (True, "")
    message = done.stderr[done.stderr.index("DEMANDOPS_PACKAGE") :]
    assert re.sub("the (repository|project)", "the …", message) == (
        "DEMANDOPS_PACKAGE: is not set; set this variable of the … to what pip installs: the URL "
        "of a wheel, or git+https://… (docs/pull-requests.md of DemandOps)\n"
    )


SOUND_OR_NOT = pytest.mark.parametrize(
    "sound", [pytest.param(True, marks=pytest.mark.nightly), False], ids=["sound", "faulty"]
)


@SOUND_OR_NOT
def test_github_checks_and_reports(
    checkout: Path, tmp_path: Path, github: dict[str, Any], sound: bool
) -> None:
    git(checkout, "update-ref", "refs/remotes/origin/main", "HEAD")
    if not sound:
        (checkout / "inventory" / "brokers.yaml").write_text("kind: [\n")
    put_demandops(tmp_path / "demandops" / "bin" / "demandops")
    (step,) = [one for one in github["jobs"]["check"]["steps"] if one.get("name") == "Check"]
    summary = tmp_path / "summary.md"
    more = {"RUNNER_TEMP": str(tmp_path), "GITHUB_STEP_SUMMARY": str(summary), **helm(tmp_path)}
    done = subprocess.run(
        [BASH, "-e", "-c", step["run"]],
        cwd=checkout,
        env=environment(tmp_path, BASE="origin/main", **more),
        check=False,
    )
    assert done.returncode == (0 if sound else 1)
    report = (tmp_path / "report.md").read_text()
    assert report.startswith(f"{MARK}\n## DemandOps: {'valid' if sound else '1 error'}")
    assert summary.read_text() == report


@SOUND_OR_NOT
def test_gitlab_checks_and_reports(
    checkout: Path, tmp_path: Path, gitlab: dict[str, Any], sound: bool
) -> None:
    remote = tmp_path / "remote.git"
    git(tmp_path, "clone", "--quiet", "--bare", str(checkout), str(remote))
    git(checkout, "remote", "add", "origin", remote.as_uri())
    if not sound:
        (checkout / "inventory" / "brokers.yaml").write_text("kind: [\n")
    program = tmp_path / "venv" / "bin" / "demandops"
    put_demandops(program)
    lines = gitlab["demandops"]["script"]
    script = "\n".join(lines[next(n for n, line in enumerate(lines) if "git fetch" in line) :])
    done = subprocess.run(
        [BASH, "-e", "-c", script.replace("/tmp/demandops/bin/demandops", str(program))],
        cwd=checkout,
        env=environment(tmp_path, CI_MERGE_REQUEST_TARGET_BRANCH_NAME="main", **helm(tmp_path)),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == (0 if sound else 1), done.stderr
    report = (checkout / "report.md").read_text()
    assert report.startswith(f"{MARK}\n## DemandOps: {'valid' if sound else '1 error'}")
    assert report in done.stdout


@pytest.mark.parametrize("sound", [True, False], ids=["sound", "altered"])
def test_gitlab_brings_helm_as_its_digest_says(
    tmp_path: Path, gitlab: dict[str, Any], sound: bool
) -> None:
    (script,) = [line for line in gitlab["demandops"]["script"] if line.startswith("archive=")]
    names = {"amd64": "x86_64", "arm64": "aarch64"}
    archive = f"helm-v4.2.4-linux-{next(k for k, v in names.items() if v == os.uname().machine)}"
    tree = tmp_path / "linux" / "helm"
    tree.parent.mkdir()
    tree.write_text("a program")
    packed = tmp_path / f"{archive}.tar.gz"
    subprocess.run(["tar", "-czf", str(packed), "-C", str(tmp_path), "linux/helm"], check=True)
    digest = hashlib.sha256(packed.read_bytes() + b"!" * (not sound)).hexdigest()
    (tmp_path / f"{packed.name}.sha256sum").write_text(f"{digest}  {packed.name}\n")
    source = {"HELM_VERSION": "v4.2.4", "HELM_SOURCE": tmp_path.as_uri()}
    done = subprocess.run(
        [BASH, "-e", "-c", script.replace("/tmp/demandops", str(tmp_path / "brought"))],
        env=environment(tmp_path, CI_PROJECT_DIR=str(tmp_path), **source),
        capture_output=True,
        check=False,
    )
    assert (done.returncode == 0) == sound, done.stderr
    assert (tmp_path / "brought" / "helm" / "helm").exists() == sound


class Notes:
    """A stand-in for GitLab's API: the caller's own id, and the notes of one merge request."""

    def __init__(self) -> None:
        self.url = ""
        self.notes: list[dict[str, Any]] = [
            {"id": number, "body": f"{MARK}\nby somebody else", "author": {"id": 1}}
            for number in range(120)
        ]

    def answer(self, call: Call) -> Answer:
        assert call.headers["PRIVATE-TOKEN"] == "token"
        if call.method == "POST":
            self.notes.append({"id": 500, "body": call.json()["body"], "author": {"id": 7}})
            return Answer.json(self.notes[-1])
        if call.method == "PUT":
            (note,) = [one for one in self.notes if call.path.endswith(f"/notes/{one['id']}")]
            note["body"] = call.json()["body"]
            return Answer.json(note)
        if call.path == "/api/user":
            return Answer.json({"id": 7})
        assert call.path.startswith("/api/projects/5/merge_requests/3/notes?per_page=100&page=")
        page = int(call.path.rsplit("=", 1)[1])
        more = len(self.notes) > 100 * page
        found = Answer.json(self.notes[100 * (page - 1) : 100 * page])
        found.headers["X-Next-Page"] = str(page + 1) if more else ""
        return found


@pytest.fixture
def notes() -> Iterator[Notes]:
    made = Notes()
    with serving(made.answer) as server:
        made.url = server.url
        yield made


def test_gitlabs_note_is_written_once_and_then_changed(
    tmp_path: Path, gitlab: dict[str, Any], notes: Notes
) -> None:
    script = textwrap.dedent("\n".join(gitlab["demandops-note"]["script"]))
    script = script.replace("python note.py", f"{sys.executable} note.py")
    more = {
        "CI_API_V4_URL": f"{notes.url}/api",
        "CI_PROJECT_ID": "5",
        "CI_MERGE_REQUEST_IID": "3",
        "DEMANDOPS_NOTE_TOKEN": "token",
    }
    for text in ("first", "second"):
        (tmp_path / "report.md").write_text(f"{MARK}\n{text} →\n")
        subprocess.run(
            [BASH, "-e", "-c", script], cwd=tmp_path, env=environment(tmp_path, **more), check=True
        )
        mine = [one["body"] for one in notes.notes if one["author"]["id"] == 7]
        assert mine == [f"{MARK}\n{text} →\n"]
    assert {one["body"] for one in notes.notes if one["author"]["id"] == 1} == {
        f"{MARK}\nby somebody else"
    }


def test_the_token_is_only_where_nothing_of_the_merge_request_runs(gitlab: dict[str, Any]) -> None:
    assert "TOKEN" not in json.dumps(gitlab["demandops"])
    note = gitlab["demandops-note"]
    assert note["variables"] == {"GIT_STRATEGY": "none"}
    assert "DEMANDOPS_NOTE_TOKEN" in note["rules"][0]["if"]
