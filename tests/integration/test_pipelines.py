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
import zipfile
from pathlib import Path
from typing import Any

import check_jsonschema
import pytest
import yaml
from click.testing import CliRunner
from demandops.cli.authoring.check import MARK

from tests.kit.cli import Run
from tests.kit.config import skeleton
from tests.kit.repo import git

GITHUB, GITLAB = ".github/workflows/demandops.yml", ".gitlab-ci.yml"
COMMENT = ".github/workflows/demandops-comment.yml"
IMAGES = Path(__file__).parents[2] / "templates" / "scaffold" / "image"
BASH = shutil.which("bash") or "bash"


Pipeline = dict[str, Any]


def pipeline(path: str) -> Pipeline:
    data: Pipeline = yaml.safe_load(skeleton()[path])
    return data


@pytest.fixture
def github() -> Pipeline:
    return pipeline(GITHUB)


@pytest.fixture
def comment() -> Pipeline:
    return pipeline(COMMENT)


@pytest.fixture
def gitlab() -> Pipeline:
    return pipeline(GITLAB)


def bash(script: str, **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [BASH, "-e", "-c", script], capture_output=True, text=True, check=False, **options
    )


@pytest.fixture
def package(tmp_path: Path, demandops: Run) -> Path:
    """A folder with what `demandops new image` writes."""
    folder = tmp_path / "package"
    folder.mkdir()
    where = ("--state-repo", "git@github.example:example/fleet.git", "-C", folder)
    ran = demandops("new", "image", "tracking", "--repository", "ghcr.io/example/tracking", *where)
    assert (ran.code, ran.err) == (0, "")
    return folder


def test_a_pipeline_is_valid_by_its_schema(checkout: Path, package: Path) -> None:
    forge = ["--builtin-schema", "vendor.github-workflows"]
    lab = ["--builtin-schema", "vendor.gitlab-ci", "--data-transform", "gitlab-ci"]
    for file, options in (
        (checkout / GITHUB, forge),
        (checkout / COMMENT, forge),
        (checkout / GITLAB, lab),
        (package / ".github/workflows/image.yml", forge),
        (package / ".gitlab-ci.yml", lab),
    ):
        ran = CliRunner().invoke(check_jsonschema.main, [*options, str(file)])
        assert ran.exit_code == 0, ran.output


def test_what_pipelines_run_is_named_by_its_digest() -> None:
    """Also in the pipelines of `demandops new image`. A tag may be moved; a digest may not."""
    texts = [skeleton()[path] for path in (GITHUB, COMMENT, GITLAB)]
    texts += [path.read_text() for path in IMAGES.glob("*.yml")]
    lines = [line for text in texts for line in text.splitlines()]
    uses = [line for line in lines if re.search(r"\buses:", line)]
    images = [line for line in lines if re.search(r"\b(image|name): [\w./-]+[:@]", line)]
    assert len(uses) == 11
    assert len(images) == 4
    action = re.compile(r" uses: [\w-]+/[\w-]+@[0-9a-f]{40}  # v\d+\.\d+\.\d+$")
    assert not [line for line in uses if not action.search(line)]
    image = re.compile(r": \w+:[\d.]+-[a-z]+@sha256:[0-9a-f]{64}$")
    assert not [line for line in images if not image.search(line)]
    assert not [line for line in lines if "latest" in line]


def test_no_token_is_where_a_branch_may_change_the_pipeline(
    github: Pipeline, comment: Pipeline, gitlab: Pipeline
) -> None:
    # a branch may change these two for its own pull request
    assert github["permissions"] == {"contents": "read"}
    assert not [job for job in github["jobs"].values() if "permissions" in job]
    assert "secrets" not in json.dumps(github)
    assert "github.token" not in json.dumps(github)
    assert "TOKEN" not in json.dumps(gitlab)
    # GitHub runs this one as main has it
    assert comment[True] == {"workflow_run": {"workflows": ["demandops"], "types": ["completed"]}}
    assert comment["permissions"] == {}
    (job,) = comment["jobs"].values()
    assert job["permissions"] == {"actions": "read", "pull-requests": "write"}
    assert "head_repository.full_name == github.repository" in job["if"]
    # it runs no action and nothing of the pull request
    assert not [step for step in job["steps"] if "uses" in step]


def test_the_token_for_the_state_repo_is_only_where_a_protected_tag_runs() -> None:
    workflow = yaml.safe_load(
        re.sub("@[A-Z_]+@", "x", (IMAGES / "github-workflow.yml").read_text())
    )
    with_token = [job for job in workflow["jobs"].values() if "secrets." in json.dumps(job)]
    assert [job.get("environment") for job in with_token] == ["state-repo"]
    propose = yaml.safe_load((IMAGES / "gitlab-ci.yml").read_text().replace("@", "x"))["propose"]
    assert [rule["if"] for rule in propose["rules"]] == [
        '$CI_COMMIT_TAG && $CI_COMMIT_REF_PROTECTED == "true"'
    ]


def test_no_text_of_a_pull_request_reaches_a_shell(
    github: Pipeline, comment: Pipeline, package: Path
) -> None:
    checkout = github["jobs"]["check"]["steps"][0]["with"]
    assert (checkout["persist-credentials"], checkout["fetch-depth"]) == (False, 0)
    image = yaml.safe_load((package / ".github/workflows/image.yml").read_text())
    assert image["permissions"] == {"contents": "read"}
    jobs = [job for workflow in (github, comment, image) for job in workflow["jobs"].values()]
    scripts = [step["run"] for job in jobs for step in job["steps"] if "run" in step]
    assert len(scripts) > 4
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
    pipeline: Pipeline = request.getfixturevalue(request.param)
    if request.param == "github":
        (script,) = [one["run"] for one in pipeline["jobs"]["check"]["steps"] if "pip" in str(one)]
    else:
        (script,) = [line for line in pipeline["demandops"]["script"] if "pip" in line]
        script = script.replace("/tmp/demandops", "$RUNNER_TEMP/demandops")
    pip, python = tmp_path / "demandops" / "bin" / "pip", tmp_path / "path" / "python"
    for program, text in ((pip, 'echo "pip $*"'), (python, 'echo "python $1 $2 $3"')):
        program.parent.mkdir(parents=True)
        program.write_text(f"#!{BASH}\n{text}\n")
        program.chmod(0o755)
    return script, {"RUNNER_TEMP": str(tmp_path), "PATH": f"{python.parent}:{os.environ['PATH']}"}


def test_a_pipeline_installs_what_the_variable_names(
    installing: tuple[str, dict[str, str]],
) -> None:
    script, environ = installing
    package = "git+https://git.example.org/demandops.git@v1.0.0"
    done = bash(script, env={**environ, "DEMANDOPS_PACKAGE": package})
    constraints = f"{environ['RUNNER_TEMP']}/demandops/share/demandops/constraints.txt"
    assert done.stdout.splitlines() == [
        "python -I -m venv",
        f"pip install --quiet --no-deps {package}",
        f"pip install --quiet --constraint {constraints} demandops",
    ]
    done = bash(script, env={**environ, "DEMANDOPS_PACKAGE": ""})
    assert (done.returncode != 0, done.stdout) == (True, "")
    assert "DEMANDOPS_PACKAGE: is not set; set this variable of the " in done.stderr


SOUND_OR_NOT = pytest.mark.parametrize(
    "sound", [pytest.param(True, marks=pytest.mark.nightly), False], ids=["sound", "faulty"]
)


def reports(done: subprocess.CompletedProcess[str], report: str, sound: bool) -> None:
    assert done.returncode == (0 if sound else 1), done.stderr
    assert report.startswith(f"{MARK}\n## DemandOps: {'valid' if sound else '1 error'}")


@SOUND_OR_NOT
def test_github_checks_and_reports(
    checkout: Path, tmp_path: Path, github: Pipeline, sound: bool
) -> None:
    git(checkout, "update-ref", "refs/remotes/origin/main", "HEAD")
    if not sound:
        (checkout / "inventory" / "brokers.yaml").write_text("kind: [\n")
    put_demandops(tmp_path / "demandops" / "bin" / "demandops")
    (step,) = [one for one in github["jobs"]["check"]["steps"] if one.get("name") == "Check"]
    summary = tmp_path / "summary.md"
    more = {"RUNNER_TEMP": str(tmp_path), "GITHUB_STEP_SUMMARY": str(summary), **helm(tmp_path)}
    done = bash(step["run"], cwd=checkout, env=environment(tmp_path, BASE="origin/main", **more))
    reports(done, (tmp_path / "report.md").read_text(), sound)
    assert summary.read_text() == (tmp_path / "report.md").read_text()


@SOUND_OR_NOT
def test_gitlab_checks_and_reports(
    checkout: Path, tmp_path: Path, gitlab: Pipeline, sound: bool
) -> None:
    git(tmp_path, "clone", "--quiet", "--bare", str(checkout), "remote.git")
    git(checkout, "remote", "add", "origin", (tmp_path / "remote.git").as_uri())
    if not sound:
        (checkout / "inventory" / "brokers.yaml").write_text("kind: [\n")
    program = tmp_path / "venv" / "bin" / "demandops"
    put_demandops(program)
    lines = gitlab["demandops"]["script"]
    script = "\n".join(lines[next(n for n, line in enumerate(lines) if "git fetch" in line) :])
    script = script.replace("/tmp/demandops/bin/demandops", str(program))
    more = {"CI_MERGE_REQUEST_TARGET_BRANCH_NAME": "main", **helm(tmp_path)}
    done = bash(script, cwd=checkout, env=environment(tmp_path, **more))
    report = (checkout / "report.md").read_text()
    reports(done, report, sound)
    assert report in done.stdout


@pytest.mark.parametrize("sound", [True, False], ids=["sound", "altered"])
@pytest.mark.parametrize("forge", ["github", "gitlab"])
def test_helm_is_brought_as_its_digest_says(
    request: pytest.FixtureRequest, tmp_path: Path, forge: str, sound: bool
) -> None:
    pipeline = request.getfixturevalue(forge)
    if forge == "github":
        scripts = [step.get("run", "") for step in pipeline["jobs"]["check"]["steps"]]
    else:
        scripts = pipeline["demandops"]["script"]
    (script,) = [each for each in scripts if "curl" in each]
    name = re.findall(rf"{os.uname().machine}\) name=(\S+)", script)[0]
    program = tmp_path / "linux" / "helm"
    program.parent.mkdir()
    program.write_text("a program")
    packed = tmp_path / name
    subprocess.run(["tar", "-czf", str(packed), "-C", str(tmp_path), "linux/helm"], check=True)
    digest = hashlib.sha256(packed.read_bytes() + b"!" * (not sound)).hexdigest()
    assert len(re.findall(r"digest=[0-9a-f]{64} ", script)) == 2
    script = re.sub("digest=[0-9a-f]+", f"digest={digest}", script)
    more = {"RUNNER_TEMP": str(tmp_path / "brought"), "HELM_SOURCE": tmp_path.as_uri()}
    script = script.replace("/tmp/helm", str(tmp_path / "brought" / "helm"))
    done = bash(script, env=environment(tmp_path, CI_PROJECT_DIR=str(tmp_path), **more))
    assert (done.returncode == 0) == sound, done.stderr
    assert (tmp_path / "brought" / "helm" / "helm").exists() == sound


GH = """
import json, subprocess, sys
from pathlib import Path
here, (_, path, *options) = Path(sys.argv[0]).parent, [a for a in sys.argv[1:] if a != "--paginate"]
if path.endswith("/zip"):
    sys.stdout.buffer.write((here / "artifact.zip").read_bytes())
elif options[0] == "--jq":
    name = "artifacts.json" if "artifacts" in path else "comments.json"
    subprocess.run(["jq", "-r", options[1], str(here / name)], check=True)
else:
    with (here / "written").open("a") as written:
        print(path, *options, file=written)
"""
PULL_REQUESTS = """
- {number: 1, head: {sha: newest}, base: {ref: other, repo: {id: 1}}}
- {number: 2, head: {sha: newest}, base: {ref: main, repo: {id: 2}}}
- {number: 3, head: {sha: newest}, base: {ref: main, repo: {id: 1}}}
"""
RUN = {"head_sha": "newest", "pull_requests": yaml.safe_load(PULL_REQUESTS)}
EVENT = {"repository": {"id": 1}, "workflow_run": RUN}
ROBOT, PERSON = {"type": "Bot"}, {"type": "User"}


class Commenting:
    """The script of the job that comments, with a stand-in for GitHub's program `gh`."""

    def __init__(self, folder: Path, script: str) -> None:
        self._folder, self._script = folder, script
        (folder / "gh").write_text(f"#!{sys.executable}\n{GH}")
        (folder / "gh").chmod(0o755)
        self.size = 1000
        self.event: dict[str, Any] = EVENT
        self.comments: list[dict[str, Any]] = []

    def run(self, entries: dict[str | zipfile.ZipInfo, str]) -> tuple[int, str]:
        """Run it with an artifact of these files; return the exit code and what it wrote."""
        with zipfile.ZipFile(self._folder / "artifact.zip", "w") as packed:
            for name, text in entries.items():
                packed.writestr(name, text)
        artifacts = [{"id": 5, "size_in_bytes": self.size}]
        for name, data in (
            ("event.json", self.event),
            ("artifacts.json", {"artifacts": artifacts}),
            ("comments.json", self.comments),
        ):
            (self._folder / name).write_text(json.dumps(data))
        more = {
            "PATH": f"{self._folder}:{os.environ['PATH']}",
            "GITHUB_EVENT_PATH": str(self._folder / "event.json"),
            "REPO": "its/fleet",
            "RUN": "7",
        }
        work = self._folder / "work"
        work.mkdir()
        done = bash(self._script, cwd=work, env=environment(self._folder, **more))
        written = self._folder / "written"
        assert {path.name for path in work.iterdir()} <= {"report.md", "report.zip"}
        return done.returncode, written.read_text() if written.exists() else ""


@pytest.fixture
def commenting(tmp_path: Path, comment: Pipeline) -> Commenting:
    return Commenting(tmp_path, comment["jobs"]["comment"]["steps"][0]["run"])


REPORT = f"{MARK}\n## DemandOps: valid\n"


def test_the_report_becomes_a_comment_of_the_pull_request(commenting: Commenting) -> None:
    commenting.comments = [{"id": 1, "user": PERSON, "body": REPORT}]
    written = "--silent repos/its/fleet/issues/3/comments -F body=@report.md\n"
    assert commenting.run({"report.md": REPORT}) == (0, written)


def test_an_earlier_comment_is_changed(commenting: Commenting) -> None:
    commenting.comments = [
        {"id": 1, "user": PERSON, "body": REPORT},
        {"id": 2, "user": ROBOT, "body": "something else"},
        {"id": 3, "user": ROBOT, "body": REPORT},
    ]
    code, written = commenting.run({"report.md": REPORT})
    assert (code, "PATCH repos/its/fleet/issues/comments/3 " in written) == (0, True)


@pytest.mark.parametrize("why", ["of older commits", "too large"])
def test_a_report_that_is_old_or_large_is_not_shown(commenting: Commenting, why: str) -> None:
    if why == "too large":
        commenting.size = 10**9
    else:
        commenting.event = {**EVENT, "workflow_run": RUN | {"head_sha": "older"}}
    assert commenting.run({"report.md": REPORT}) == (0, "")


def _link() -> zipfile.ZipInfo:
    link = zipfile.ZipInfo("report.md")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    return link


@pytest.mark.parametrize(
    "entries",
    [
        {"report.md": "something else"},
        {"report.md": REPORT + 300_000 * "x"},
        {"../report.md": REPORT},
        {"/report.md": REPORT},
        {"a/report.md": REPORT},
        {_link(): "/etc/passwd"},
        {},
    ],
    ids=["other text", "long", "above", "absolute", "in a folder", "link", "empty"],
)
def test_an_artifact_that_is_no_report_is_refused(
    commenting: Commenting, entries: dict[str | zipfile.ZipInfo, str]
) -> None:
    assert commenting.run(entries) == (1, "")


# ---- what `demandops new image` writes ----

DIGEST = f"sha256:{64 * 'a'}"


def propose(package: Path, remote: Path, tag: str, digest: str) -> subprocess.CompletedProcess[str]:
    script = f'"{package}/ci/propose-image" "$TAG" "$DIGEST"'
    words = {"STATE_REPO": remote.as_uri(), "TAG": tag, "DIGEST": digest}
    return bash(f"{BASH} {script}", env={**os.environ, **words})


def test_the_proposed_image_passes_check(
    package: Path, checkout: Path, demandops: Run, tmp_path: Path
) -> None:
    texts = [path.read_text() for path in package.rglob("*") if path.is_file()]
    assert not [text for text in texts if "@NAME@" in text or "@STATE_REPO@" in text]
    remote = tmp_path / "remote.git"
    git(tmp_path, "clone", "--quiet", "--bare", str(checkout), str(remote))
    ran = propose(package, remote, "1.2.0", DIGEST)
    assert (ran.returncode, ran.stdout) == (0, "image/tracking-1.2.0\n"), ran.stderr
    git(checkout, "fetch", "--quiet", str(remote), "image/tracking-1.2.0")
    git(checkout, "checkout", "--quiet", "FETCH_HEAD")
    assert git(checkout, "log", "-1", "--format=%s") == "Run tracking 1.2.0"
    entry = yaml.safe_load((checkout / "registry/images/tracking.yaml").read_text())
    pinned = {"repository": "ghcr.io/example/tracking", "tag": "1.2.0", "digest": DIGEST}
    assert entry["images"]["tracking"] == pinned
    assert demandops("check", checkout).code == 0
    git(remote, "branch", "--force", "main", "image/tracking-1.2.0")
    again = propose(package, remote, "1.2.0", DIGEST)
    assert (again.returncode, again.stdout) == (0, "")


@pytest.mark.parametrize(
    ("tag", "digest", "wrong"),
    [("1; reboot", DIGEST, "1; reboot"), ("1.0", "latest", "latest"), ("$(x)", DIGEST, "$(x)")],
)
def test_an_invalid_tag_or_digest_is_refused(
    package: Path, tmp_path: Path, tag: str, digest: str, wrong: str
) -> None:
    ran = propose(package, tmp_path / "unused.git", tag, digest)
    assert ran.returncode == 1
    assert ran.stderr.startswith(f"'{wrong}' is not a ")
