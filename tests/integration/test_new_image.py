"""`demandops new image` writes valid pipelines and a script; the script's branch passes `check`."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import check_jsonschema
import pytest
import yaml
from click.testing import CliRunner

from tests.kit.cli import Run
from tests.kit.repo import git

DIGEST = f"sha256:{64 * 'a'}"
OPTIONS = ["--repository", "ghcr.io/example/tracking"]
BASH = shutil.which("bash") or "bash"


@pytest.fixture
def package(tmp_path: Path, demandops: Run) -> Path:
    folder = tmp_path / "package"
    folder.mkdir()
    url = "git@github.example:example/fleet.git"
    ran = demandops("new", "image", "tracking", *OPTIONS, "--state-repo", url, "-C", folder)
    assert (ran.code, ran.err) == (0, "")
    return folder


GITLAB = ["--builtin-schema", "vendor.gitlab-ci", "--data-transform", "gitlab-ci"]


@pytest.mark.parametrize(
    ("path", "options"),
    [
        (".github/workflows/image.yml", ["--builtin-schema", "vendor.github-workflows"]),
        (".gitlab-ci.yml", GITLAB),
    ],
    ids=["github", "gitlab"],
)
def test_a_pipeline_is_valid_by_its_schema(package: Path, path: str, options: list[str]) -> None:
    ran = CliRunner().invoke(check_jsonschema.main, [*options, str(package / path)])
    assert ran.exit_code == 0, ran.output


def test_no_text_from_outside_reaches_a_shell(package: Path) -> None:
    workflow = yaml.safe_load((package / ".github/workflows/image.yml").read_text())
    for job in workflow["jobs"].values():
        for step in job["steps"]:
            assert "${{" not in step.get("run", "")
            subprocess.run([BASH, "-n"], input=step.get("run", ""), text=True, check=True)
    assert workflow["permissions"] == {"contents": "read"}
    texts = [path.read_text() for path in package.rglob("*") if path.is_file()]
    assert not [text for text in texts if "@NAME@" in text or "@STATE_REPO@" in text]


def propose(package: Path, remote: Path, *args: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [BASH, str(package / "ci" / "propose-image"), *args],
        env={**os.environ, "STATE_REPO": remote.as_uri()},
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_proposed_image_passes_check(
    package: Path, checkout: Path, demandops: Run, tmp_path: Path
) -> None:
    remote = tmp_path / "remote.git"
    git(tmp_path, "clone", "--quiet", "--bare", str(checkout), str(remote))
    ran = propose(package, remote, "1.2.0", DIGEST)
    assert (ran.returncode, ran.stdout) == (0, "image/tracking-1.2.0\n"), ran.stderr
    git(checkout, "fetch", "--quiet", str(remote), "image/tracking-1.2.0")
    git(checkout, "checkout", "--quiet", "FETCH_HEAD")
    assert git(checkout, "log", "-1", "--format=%s") == "Run tracking 1.2.0"
    entry = yaml.safe_load((checkout / "registry/images/tracking.yaml").read_text())
    assert entry["images"]["tracking"] == {
        "repository": "ghcr.io/example/tracking",
        "tag": "1.2.0",
        "digest": DIGEST,
    }
    assert demandops("check", checkout).code == 0
    git(remote, "branch", "--force", "main", "image/tracking-1.2.0")
    again = propose(package, remote, "1.2.0", DIGEST)
    assert (again.returncode, again.stdout) == (0, "")


@pytest.mark.parametrize("args", [("1; reboot", DIGEST), ("1.0", "latest"), ("$(x)", DIGEST)])
def test_an_invalid_tag_or_digest_is_refused(
    package: Path, tmp_path: Path, args: tuple[str, str]
) -> None:
    ran = propose(package, tmp_path / "unused.git", *args)
    assert ran.returncode == 1
    assert ran.stderr.startswith(f"'{args[0] if args[1] == DIGEST else args[1]}' is not a ")


@pytest.mark.parametrize(
    ("name", "repository", "url", "told"),
    [
        ("Big", "ghcr.io/x/y", "https://h/x", "NAME: 'Big' is no valid name"),
        ("x", "ghcr.io/x:1", "https://h/x", "--repository: 'ghcr.io/x:1' is no valid"),
        ("x", "ghcr.io/X/y", "https://h/x", "--repository: 'ghcr.io/X/y' is no valid"),
        ("x", "ghcr.io/x/y", "https://h/$(x)", "--state-repo: 'https://h/$(x)' is no valid URL"),
    ],
)
def test_what_cannot_be_written_is_refused(
    demandops: Run, tmp_path: Path, name: str, repository: str, url: str, told: str
) -> None:
    options = ["--repository", repository, "--state-repo", url, "-C", tmp_path]
    ran = demandops("new", "image", name, *options)
    assert ran.code == 1
    assert ran.err.startswith(f"error: {told}")
    assert not (tmp_path / "Containerfile").exists()
