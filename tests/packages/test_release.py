"""`make release` builds a wheel that works, of one version and with a changelog that tells all."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import demandops
import pytest
import yaml

ROOT = Path(__file__).parents[2]
NAME = f"demandops-{demandops.__version__}"


def release(script: Path, *args: str) -> subprocess.CompletedProcess[str]:
    env = os.environ | {"PYTHON": sys.executable}
    return subprocess.run([script, *args], env=env, capture_output=True, text=True, check=False)


def test_everything_has_the_same_version() -> None:
    chart = yaml.safe_load(ROOT.joinpath("deploy/chart/Chart.yaml").read_text())
    assert chart["version"] == chart["appVersion"] == demandops.__version__
    for path, line in {
        "ros_bridge/ros_package/package.xml": "<version>{}</version>",
        "ros_bridge/interfaces/demandops_interfaces/package.xml": "<version>{}</version>",
        "pyproject.toml": '\nversion = "{}"\n',
    }.items():
        assert line.format(demandops.__version__) in ROOT.joinpath(path).read_text(), path


def test_each_change_that_no_release_has_told_has_a_group() -> None:
    groups = "demand|applications|placement|policy|overrides|audit|page|operations|gone"
    readme = ROOT.joinpath("changelog.d/README.md").read_text()
    assert all(f"`{group}`" in readme for group in groups.split("|"))
    for path in ROOT.joinpath("changelog.d").iterdir():
        if path.name != "README.md":
            assert re.fullmatch(rf"[a-z0-9-]+\.({groups})\.md", path.name), path.name
            assert len(path.read_text().splitlines()) == 1, path.name


@pytest.mark.parametrize(
    ("section", "told"),
    [
        ("## 0.0.1 (2026-11-21)", f"no section '## {demandops.__version__}'"),
        (f"## {demandops.__version__} (2026-12-01)", "odd-names.audit.md"),
    ],
)
def test_no_release_leaves_a_change_untold(tmp_path: Path, section: str, told: str) -> None:
    for folder in ("deploy", "changelog.d"):
        (tmp_path / folder).mkdir()
    script = shutil.copy(ROOT / "deploy" / "release", tmp_path / "deploy")
    (tmp_path / "CHANGELOG.md").write_text(f"# Changelog\n\n{section}\n")
    (tmp_path / "changelog.d" / "odd-names.audit.md").write_text("Odd names are refused.\n")
    done = release(script)
    assert (done.returncode, done.stdout) == (1, ""), done
    assert told in done.stderr


@pytest.mark.slow
@pytest.mark.limit(600)
def test_a_release_is_built_and_tried_in_an_empty_environment(tmp_path: Path) -> None:
    done = release(ROOT / "deploy" / "release", str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert "release: a state repo, a check of it, a demand\nrelease: ready: " in done.stdout
    assert zipfile.is_zipfile(tmp_path / f"{NAME}-py3-none-any.whl")
    with tarfile.open(tmp_path / f"{NAME}.tar.gz") as sdist:
        assert f"{NAME}/pyproject.toml" in sdist.getnames()
    with tarfile.open(tmp_path / f"{NAME}-docs.tar.gz") as docs:
        pages = {f"{NAME}-docs/{page}.html" for page in ("index", "generated/commands")}
        assert pages <= {*docs.getnames()}
    subprocess.run(["sha256sum", "--check", "--quiet", f"{NAME}.sha256"], cwd=tmp_path, check=True)
