"""The pipelines that `init` and `new image` write are valid, have few rights, and work."""

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

from tests.kit import plain_yaml
from tests.kit.cli import Ran, Run, process
from tests.kit.config import skeleton
from tests.kit.repo import git, program

FILES = {
    "github": ".github/workflows/demandops.yml",
    "comment": ".github/workflows/demandops-comment.yml",
    "gitlab": ".gitlab-ci.yml",
}
GITHUB, COMMENT, GITLAB = (yaml.safe_load(skeleton()[path]) for path in FILES.values())
LAB_SCRIPT = GITLAB["demandops"]["script"]
HUB_SCRIPTS = [step.get("run", "") for step in GITHUB["jobs"]["check"]["steps"]]
IMAGES = Path(__file__).parents[2] / "templates" / "scaffold" / "image"
BASH = shutil.which("bash") or "bash"


def bash(script: str, folder: Path, **options: Any) -> Ran:
    """Run a script with the variables of `options`; each `/tmp/` in it is the test's folder."""
    cwd, environ = options.pop("cwd", folder), {"DEMANDOPS_DATA_HOME": str(folder / "data")}
    environ |= {"RUNNER_TEMP": str(folder)} | options
    command = (BASH, "-e", "-c", script.replace("/tmp/", f"{folder}/"))
    return process(*command, cwd=cwd, env=os.environ | environ)


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
        (checkout / FILES["github"], forge),
        (checkout / FILES["comment"], forge),
        (checkout / FILES["gitlab"], lab),
        (package / ".github/workflows/image.yml", forge),
        (package / ".gitlab-ci.yml", lab),
    ):
        ran = CliRunner().invoke(check_jsonschema.main, [*options, str(file)])
        assert ran.exit_code == 0, ran.output


def test_what_pipelines_run_is_named_by_its_digest() -> None:
    """Also in the pipelines of `demandops new image`. A tag may be moved; a digest may not."""
    texts = [skeleton()[path] for path in FILES.values()]
    texts += [path.read_text() for path in IMAGES.glob("*.yml")]
    lines = [line for text in texts for line in text.splitlines()]
    uses = [line for line in lines if re.search(r"\buses:", line)]
    images = [line for line in lines if re.search(r"\b(image|name): [\w./-]+[:@]", line)]
    assert (len(uses), len(images)) == (11, 4)
    action = re.compile(r" uses: [\w-]+/[\w-]+@[0-9a-f]{40}  # v\d+\.\d+\.\d+$")
    image = re.compile(r": \w+:[\d.]+-[a-z]+@sha256:[0-9a-f]{64}$")
    assert not [line for line in uses if not action.search(line)]
    assert not [line for line in images if not image.search(line)]
    assert not [line for line in lines if "latest" in line]


def test_a_token_is_only_where_no_branch_may_change_the_pipeline(package: Path) -> None:
    # a branch may change these two for its own pull request
    assert GITHUB["permissions"] == {"contents": "read"}
    assert not [job for job in GITHUB["jobs"].values() if "permissions" in job]
    assert not re.search("secrets|github.token|TOKEN", json.dumps([GITHUB, GITLAB]))
    checkout = GITHUB["jobs"]["check"]["steps"][0]["with"]
    assert (checkout["persist-credentials"], checkout["fetch-depth"]) == (False, 0)
    # GitHub runs this one as main has it; it runs no action and nothing of the pull request
    assert COMMENT[True] == {"workflow_run": {"workflows": ["demandops"], "types": ["completed"]}}
    (job,) = COMMENT["jobs"].values()
    assert COMMENT["permissions"] == {}
    assert job["permissions"] == {"actions": "read", "pull-requests": "write"}
    assert "head_repository.full_name == github.repository" in job["if"]
    assert not [step for step in job["steps"] if "uses" in step]
    # and these have the token for the state repo only where a protected tag runs
    image = yaml.safe_load((package / ".github/workflows/image.yml").read_text())
    assert image["permissions"] == {"contents": "read"}
    with_token = [job for job in image["jobs"].values() if "secrets." in json.dumps(job)]
    assert [job.get("environment") for job in with_token] == ["state-repo"]
    propose = yaml.safe_load((package / ".gitlab-ci.yml").read_text())["propose"]
    assert [rule["if"] for rule in propose["rules"]] == [
        '$CI_COMMIT_TAG && $CI_COMMIT_REF_PROTECTED == "true"'
    ]


def test_no_text_of_a_pull_request_reaches_a_shell(package: Path) -> None:
    image = yaml.safe_load((package / ".github/workflows/image.yml").read_text())
    jobs = [job for workflow in (GITHUB, COMMENT, image) for job in workflow["jobs"].values()]
    scripts = [step["run"] for job in jobs for step in job["steps"] if "run" in step]
    assert len(scripts) > 4
    # no script contains names from a pull request, like a branch or a title, as text
    assert not [script for script in scripts if "${{" in script]
    for script in scripts:
        subprocess.run([BASH, "-n"], input=script, text=True, check=True)


both = pytest.mark.parametrize("scripts", [HUB_SCRIPTS, LAB_SCRIPT], ids=["github", "gitlab"])


@both
def test_a_pipeline_installs_what_the_variable_names(scripts: list[str], tmp_path: Path) -> None:
    (script,) = [each for each in scripts if "pip" in each]
    program(tmp_path / "demandops" / "bin" / "pip", 'echo "pip $*"')
    python = program(tmp_path / "path" / "python", 'echo "python $1 $2 $3"')
    path = f"{python.parent}:{os.environ['PATH']}"
    package = "git+https://git.example.org/demandops.git@v1.0.0"
    done = bash(script, tmp_path, PATH=path, DEMANDOPS_PACKAGE=package)
    constraints = tmp_path / "demandops/share/demandops/constraints.txt"
    assert done.out.splitlines() == [
        "python -I -m venv",
        f"pip install --quiet --no-deps {package}",
        f"pip install --quiet --constraint {constraints} demandops",
    ]
    done = bash(script, tmp_path, PATH=path, DEMANDOPS_PACKAGE="")
    assert (done.code != 0, done.out) == (True, "")
    assert "DEMANDOPS_PACKAGE: is not set; set this variable of the " in done.err


@both
def test_a_pipeline_checks_and_reports(scripts: list[str], checkout: Path, tmp_path: Path) -> None:
    git(tmp_path, "clone", "--quiet", "--bare", str(checkout), "remote.git")
    git(checkout, "remote", "add", "origin", (tmp_path / "remote.git").as_uri())
    git(checkout, "fetch", "--quiet", "origin")
    (checkout / "inventory" / "brokers.yaml").write_text("kind: [\n")
    of_user = f'exec "{sys.executable}" -m demandops.cli.main "$@"'
    program(tmp_path / "demandops" / "bin" / "demandops", of_user)
    wanted = [script for script in scripts if not re.search("pip |curl|HELM_BIN=", script)]
    names = {"CI_MERGE_REQUEST_TARGET_BRANCH_NAME": "main", "BASE": "origin/main"}
    summary = tmp_path / "summary.md"
    names |= {"GITHUB_STEP_SUMMARY": str(summary), "HELM_BIN": str(program(tmp_path / "helm", ""))}
    done = bash("\n".join(wanted), tmp_path, cwd=checkout, **names)
    assert done.code == 1, done.err
    report = next(path for path in (tmp_path, checkout) if (path / "report.md").exists())
    told = (report / "report.md").read_text()
    assert told.startswith(f"{MARK}\n## DemandOps: 1 error")
    assert told == (summary.read_text() if summary.exists() else done.out)
    git(checkout, "checkout", "--quiet", ".")
    assert bash("\n".join(wanted), tmp_path, cwd=checkout, **names).code == 0


@both
def test_helm_is_brought_as_its_digest_says(scripts: list[str], tmp_path: Path) -> None:
    (script,) = [each for each in scripts if "curl" in each]
    assert len(re.findall(r"digest=[0-9a-f]{64} ", script)) == 2
    packed = tmp_path / re.findall(rf"{os.uname().machine}\) name=(\S+)", script)[0]
    program(tmp_path / "linux" / "helm", "a program")
    subprocess.run(["tar", "-czf", str(packed), "-C", str(tmp_path), "linux/helm"], check=True)
    for other, brought in ((b"!", False), (b"", True)):
        digest = hashlib.sha256(packed.read_bytes() + other).hexdigest()
        given = re.sub("digest=[0-9a-f]+", f"digest={digest}", script)
        more = {"CI_PROJECT_DIR": str(tmp_path), "HELM_SOURCE": tmp_path.as_uri()}
        done = bash(given, tmp_path, **more)
        assert (done.code == 0) == brought, done.err
        assert (tmp_path / "helm" / "helm").exists() == brought


GH = Path(__file__).with_name("gh-stand-in.txt").read_text()
PULL_REQUESTS = plain_yaml.beside(__file__, "pipelines")["pull requests"]
ROBOT, PERSON = {"type": "Bot"}, {"type": "User"}
REPORT = f"{MARK}\n## DemandOps: valid\n"
CREATED = "--silent repos/its/fleet/issues/3/comments -F body=@report.md\n"
LINK = zipfile.ZipInfo("report.md")
LINK.external_attr = (stat.S_IFLNK | 0o777) << 16
Entries = dict[str | zipfile.ZipInfo, str]


def commented(
    folder: Path, entries: Entries, *comments: object, size: int = 1000, newest: str = "newest"
) -> tuple[int, str]:
    """Run the script that comments; return its exit code and what it wrote.

    A stand-in for GitHub's program `gh` gives it an artifact with `entries`, and the pull request's
    comments.
    """
    shutil.rmtree(folder / "its", ignore_errors=True)
    gh = program(folder / "its" / "gh", GH, sys.executable)
    with zipfile.ZipFile(gh.with_name("artifact.zip"), "w") as packed:
        for name, text in entries.items():
            packed.writestr(name, text)
    run = {"head_sha": newest, "pull_requests": PULL_REQUESTS}
    for name, data in {
        "event": {"repository": {"id": 1}, "workflow_run": run},
        "artifacts": {"artifacts": [{"id": 5, "size_in_bytes": size}]},
        "comments": comments,
    }.items():
        gh.with_name(f"{name}.json").write_text(json.dumps(data))
    names = {"GITHUB_EVENT_PATH": str(gh.with_name("event.json")), "REPO": "its/fleet", "RUN": "7"}
    (work := gh.with_name("work")).mkdir()
    script = COMMENT["jobs"]["comment"]["steps"][0]["run"]
    done = bash(script, folder, cwd=work, PATH=f"{gh.parent}:{os.environ['PATH']}", **names)
    written = gh.with_name("written")
    assert {path.name for path in work.iterdir()} <= {"report.md", "report.zip"}
    return done.code, written.read_text() if written.exists() else ""


def test_the_report_becomes_a_comment_and_a_newer_one_changes_it(tmp_path: Path) -> None:
    report: Entries = {"report.md": REPORT}
    by_person = {"id": 1, "user": PERSON, "body": REPORT}
    other = {"id": 2, "user": ROBOT, "body": "something else"}
    assert commented(tmp_path, report, by_person, other) == (0, CREATED)
    earlier = {"id": 3, "user": ROBOT, "body": REPORT}
    code, written = commented(tmp_path, report, by_person, other, earlier)
    assert (code, "PATCH repos/its/fleet/issues/comments/3 " in written) == (0, True)
    assert commented(tmp_path, report, size=10**9) == (0, "")
    assert commented(tmp_path, report, newest="older") == (0, "")


@pytest.mark.parametrize(
    "entries",
    [
        {"report.md": "something else"},
        {"report.md": REPORT + 300_000 * "x"},
        {"../report.md": REPORT},
        {"/report.md": REPORT},
        {"a/report.md": REPORT},
        {LINK: "/etc/passwd"},
        {},
    ],
    ids=["other text", "long", "above", "absolute", "in a folder", "link", "empty"],
)
def test_an_artifact_that_is_no_report_is_refused(tmp_path: Path, entries: Entries) -> None:
    assert commented(tmp_path, entries) == (1, "")


# ---- what `demandops new image` writes ----


def test_the_proposed_image_passes_check(
    package: Path, checkout: Path, demandops: Run, tmp_path: Path
) -> None:
    texts = [path.read_text() for path in package.rglob("*") if path.is_file()]
    assert not [text for text in texts if "@NAME@" in text or "@STATE_REPO@" in text]
    git(tmp_path, "clone", "--quiet", "--bare", str(checkout), "remote.git")
    remote, digest = tmp_path / "remote.git", f"sha256:{64 * 'a'}"

    def propose(tag: str, digest: str) -> tuple[int, str, str]:
        script = f'{BASH} "{package}/ci/propose-image" "$TAG" "$DIGEST"'
        done = bash(script, tmp_path, STATE_REPO=remote.as_uri(), TAG=tag, DIGEST=digest)
        return done.code, done.out, done.err

    for tag, given, wrong in (("1; reboot", digest, 0), ("$(x)", digest, 0), ("1.0", "latest", 1)):
        code, _, told = propose(tag, given)
        assert (code, told.startswith(f"'{(tag, given)[wrong]}' is not a ")) == (1, True)
    code, branch, told = propose("1.2.0", digest)
    assert (code, branch) == (0, "image/tracking-1.2.0\n"), told
    git(checkout, "fetch", "--quiet", str(remote), "image/tracking-1.2.0")
    git(checkout, "checkout", "--quiet", "FETCH_HEAD")
    assert git(checkout, "log", "-1", "--format=%s") == "Run tracking 1.2.0"
    entry = yaml.safe_load((checkout / "registry/images/tracking.yaml").read_text())
    pinned = {"repository": "ghcr.io/example/tracking", "tag": "1.2.0", "digest": digest}
    assert entry["images"]["tracking"] == pinned
    assert demandops("check", checkout).code == 0
    git(remote, "branch", "--force", "main", "image/tracking-1.2.0")
    assert propose("1.2.0", digest)[:2] == (0, "")
