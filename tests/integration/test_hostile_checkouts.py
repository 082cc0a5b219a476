"""`demandops check` on checkouts whose author is hostile.

It writes nothing outside its own temporary folder, fetches nothing, runs nothing of the author's,
and ends with a verdict. The helm of these tests is a stand-in that is greedier than any helm; the
real one is used too if the rig of the end-to-end tests has built it.
"""

from __future__ import annotations

import io
import json
import os
import shutil
import stat
import sys
import tarfile
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pygit2
import pytest
from demandops.cli.main import run
from demandops.repo.merge_check.rendered_charts import HELM_BIN
from hypothesis import given
from hypothesis import strategies as st

from tests.e2e.rig import tools
from tests.integration import greedy_helm
from tests.kit import plain_yaml
from tests.kit.chance import examples
from tests.kit.cli import Ran
from tests.kit.http import Server, serving
from tests.kit.repo import git, program

CHARTS = "appdefs/object-detection-fusion/charts"
CHART = f"{CHARTS}/object-fusion"
LIBRARY = "appdefs/charts/ros-service"
LISTED = plain_yaml.beside(__file__)
FILES, FOLDERS = LISTED["files"], LISTED["folders"]
Picture = dict[str, tuple[object, ...]]
Told = Callable[[Callable[["Lab"], object]], list[str]]


class Lab:
    """A folder with a checkout, a temporary folder, a home folder, and files to protect."""

    def __init__(self, top: Path, url: str, capture: pytest.CaptureFixture[str]) -> None:
        self.top, self.url, self.capture = top, url, capture
        self.checkout, self.scratch = top / "checkout", top / "scratch"

    def check(self) -> Ran:
        """Check the checkout, and assert that everything else is as it was."""
        before = self._picture()
        self.capture.readouterr()
        code = run(["check", str(self.checkout), "--require-helm"])
        ran = Ran(code, *self.capture.readouterr())
        assert ran.code in (0, 1), ran
        assert "demandops itself" not in ran.err
        assert "Traceback" not in ran.out + ran.err
        assert "GREEDY" not in ran.out + ran.err
        assert "hunter2" not in ran.out + ran.err
        assert self._picture() == before
        assert [*self.scratch.iterdir()] == []
        return ran

    def _picture(self) -> Picture:
        found: Picture = {}
        for folder, folders, names in os.walk(self.top):
            for path in (Path(folder, name) for name in (*folders, *names)):
                status = path.lstat()
                readable = stat.S_ISREG(status.st_mode) and status.st_size < 1 << 20
                content = path.read_bytes() if readable else b""
                # git notes the time on an object that it would write again
                timed = path != self.scratch and ".git" not in path.parts
                changed = status.st_mtime_ns if timed else 0
                found[str(path)] = (status.st_mode, status.st_nlink, changed, content)
        return found


@pytest.fixture(scope="session")
def server() -> Iterator[Server]:
    with serving() as started:
        yield started


@pytest.fixture
def lab(
    request: pytest.FixtureRequest,
    _checkout_template: Path,
    tmp_path: Path,
    server: Server,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> Callable[[], Lab]:
    """Return a function that sets a lab up anew."""
    helm = tmp_path / "helm"
    if getattr(request, "param", "greedy") == "real":
        built = [*tools.cache_root().glob("helm-*/helm")]
        if not built:
            pytest.skip("the rig of the end-to-end tests has not built helm")
        helm = built[0]
    else:
        program(helm, Path(greedy_helm.__file__).read_text(), f"{sys.executable} -IS")
    monkeypatch.setenv(HELM_BIN, str(helm))
    monkeypatch.setenv("A_SECRET", "hunter2")

    def made() -> Lab:
        top = tmp_path / "top"
        shutil.rmtree(top, ignore_errors=True)
        lab = Lab(top, server.url, capsys)
        shutil.copytree(_checkout_template, lab.checkout)
        for folder in (lab.scratch, top / "home", top / "sentinel"):
            folder.mkdir()
        (top / "sentinel" / "secret").write_text("hunter2\n")
        (top / "sentinel" / "Chart.yaml").write_text("name: hunter2\nversion: 1.0.0\n")
        monkeypatch.setenv("HOME", str(top / "home"))
        monkeypatch.setattr(tempfile, "tempdir", str(lab.scratch))
        return lab

    return made


def put(lab: Lab, path: str, text: str | bytes, mode: int = 0o644) -> None:
    """Write a file of the checkout, unless a link or file is in the way to it."""
    file = lab.checkout / path
    if any(each.is_symlink() for each in file.parents):
        return
    with suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.unlink(missing_ok=True)
        file.write_bytes(text.encode() if isinstance(text, str) else text)
        file.chmod(mode)


def chart(lab: Lab, folder: str, **metadata: object) -> None:
    data = {"apiVersion": "v2", "name": folder.rpartition("/")[2], "version": "0.1.0", **metadata}
    put(lab, f"{folder}/Chart.yaml", json.dumps(data))


def put_other(lab: Lab, path: str, make: Callable[[Path], object]) -> None:
    """Replace a file or folder of the checkout, unless a link is in the way to it."""
    at = lab.checkout / path
    if any(each.is_symlink() for each in at.parents) or not at.parent.is_dir():
        return
    if at.is_dir() and not at.is_symlink():
        shutil.rmtree(at)
    at.unlink(missing_ok=True)
    make(at)


# ---- what a hostile author does; each step takes a lab and a word ----


def names_a_library(lab: Lab, word: str) -> None:
    local = "file://../../../charts/ros-service"
    for entry in (
        {"name": word, "version": "1.0.0", "repository": local},
        {"name": "ros-service", "repository": local, "alias": word, "import-values": [word]},
        {"name": "ros-service", "repository": word},
        {"name": "ros-service", "repository": f"file://{word}"},
    )[len(word) % 4 :]:
        chart(lab, CHART, name="object-fusion" if word else word, dependencies=[entry])


def links(lab: Lab, word: str) -> None:
    for path in FOLDERS[len(word) % len(FOLDERS) :][:2]:
        put_other(lab, path, lambda at: at.symlink_to(word.replace("\0", "") or ".."))


def links_files(lab: Lab, word: str) -> None:
    target = word * 9 if word.startswith("x") else lab.top / "sentinel" / "secret"
    put_other(lab, FILES[len(word) % len(FILES)], lambda at: at.symlink_to(target))
    hard = lab.top / "sentinel" / "Chart.yaml"
    put_other(lab, f"{CHART}/hard", lambda at: at.hardlink_to(hard))


def leaves_a_pipe(lab: Lab, word: str) -> None:
    put_other(lab, FILES[len(word) % len(FILES)], os.mkfifo)


def packs_an_archive(lab: Lab, word: str) -> None:
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w:gz") as archive:
        for name in ("part/Chart.yaml", "part/values.schema.json", word, f"../../../{word}"):
            text = json.dumps({"name": "part", "version": "0.1.0", "$ref": f"{lab.url}/x"}).encode()
            entry = tarfile.TarInfo(name.replace("\0", "") or "x")
            entry.size, entry.mode = len(text), 0o755
            archive.addfile(entry, io.BytesIO(text))
    for folder in (f"{CHART}/charts", f"{LIBRARY}/charts", f"{CHART}/charts/part/charts"):
        put(lab, f"{folder}/part-0.1.0.tgz", packed.getvalue())


def refers_elsewhere(lab: Lab, word: str) -> None:
    targets = [f"{lab.url}/schema", f"file://{lab.top}/sentinel/secret", word]
    schema = {"$ref": targets[len(word) % 3], "$schema": targets[(len(word) + 1) % 3]}
    text = json.dumps({"$id": f"{lab.url}/id/", **schema, "allOf": [{"$ref": "other"}]})
    for folder in (CHART, LIBRARY, f"{CHART}/charts/part"):
        put(lab, f"{folder}/values.schema.json", text)
    chart(lab, f"{CHART}/charts/part")


def doubles(lab: Lab, word: str) -> None:
    for number in range(30):
        repository = f"file://../l{number + 1}"
        twice = [{"name": name, "repository": repository} for name in ("x", "y")]
        chart(lab, f"{CHARTS}/l{number}", dependencies=twice if number < 29 else [])
    chart(lab, CHART, dependencies=[{"name": "l0", "repository": "file://../l0"}])


def nests_git(lab: Lab, word: str) -> None:
    touch = f"touch {lab.top}/ran"
    put(lab, ".gitattributes", "* filter=x diff=x textconv=x\n")
    put(lab, ".gitmodules", f'[submodule "x"]\n\tpath = {word}\n\turl = {lab.url}\n')
    for folder in (CHART, "overrides", "ledger"):
        put(lab, f"{folder}/.git/config", f"[core]\n\tfsmonitor = {touch}\n\thooksPath = ../x\n")
        put(lab, f"{folder}/.gitattributes", "* filter=x\n")
    put(lab, f"{CHART}/.helmignore", f"{word}\n!**\n")
    put(lab, f"{CHART}/templates/run.sh", f"#!/bin/sh\n{touch}\n", 0o755)


def digs(lab: Lab, word: str) -> None:
    put(lab, f"{CHART}/{'d/' * 300}x", word)
    put(lab, f"{CHART}/charts/{'charts/a/' * 20}Chart.yaml", "name: a")
    for name in (b"\xff" * 250, b"a\nb", b"a\\b", b"\xe2\x80\xae.yaml", b"~", b"x" * 255):
        put(lab, f"{CHART}/templates/{os.fsdecode(name)}", word)
    with suppress(OSError), (lab.checkout / CHART / "huge").open("wb") as file:
        file.truncate(1 << 25)


def writes_hostile_templates(lab: Lab, word: str) -> None:
    text = (
        f'{{{{ .Files.Get "../../../../../../sentinel/secret" }}}}{{{{ getHostByName "{word}" }}}}'
        '{{ lookup "v1" "Secret" "" "" }}{{ (.Files.Glob "/**").AsSecrets }}'
        '{{ fail "templates/x:9" }}'
    )
    put(lab, f"{CHART}/templates/{len(word)}.yaml", text)
    put(lab, f"{CHART}/crds/{len(word)}.yaml", word)


STEPS = [
    names_a_library, links, links_files,
    leaves_a_pipe, packs_an_archive, refers_elsewhere, doubles, nests_git, digs,
    writes_hostile_templates,
]  # fmt: skip
WORDS = st.sampled_from(LISTED["words"])


@pytest.mark.parametrize(
    "lab", ["greedy", pytest.param("real", marks=pytest.mark.nightly)], indirect=True
)
@examples(25)
@given(st.lists(st.tuples(st.sampled_from(STEPS), WORDS), min_size=1, max_size=4))
def test_check_leaves_everything_around_it_alone_and_ends(
    lab: Callable[[], Lab], server: Server, steps: list[tuple[Callable[[Lab, str], None], str]]
) -> None:
    made = lab()
    for step, word in steps:
        step(made, word)
    made.check()
    assert server.calls == []


# ---- what was found ----


@pytest.fixture
def told(lab: Callable[[], Lab]) -> Told:
    """Return a function that does something in a new lab and returns the errors of the check."""

    def check(step: Callable[[Lab], object]) -> list[str]:
        made = lab()
        step(made)
        lines = made.check().err.splitlines()
        return [line.removeprefix("error: ") for line in lines if "is still 0.1.0" not in line]

    return check


def test_copies_of_libraries_are_bounded(told: Told) -> None:
    (line,) = told(lambda lab: doubles(lab, ""))
    assert line.startswith(f"{CHART}/Chart.yaml:1: dependencies: ")


def test_a_file_that_is_too_large_is_refused(told: Told) -> None:
    huge = f"{CHART}/files/huge"

    def add(lab: Lab) -> None:
        put(lab, huge, "")
        os.truncate(lab.checkout / huge, 17 << 20)

    assert {line.partition(": ")[0] for line in told(add)} == {huge}


def test_an_author_in_an_unknown_encoding(lab: Callable[[], Lab]) -> None:
    made = lab()
    put(made, "bootstrap/c-its.yaml", "edited: true\n")
    git(made.checkout, "add", "--all")
    tree, head = git(made.checkout, "write-tree"), git(made.checkout, "rev-parse", "HEAD")
    raw = f"tree {tree}\nparent {head}\nauthor \xff <a> 1 +0000\ncommitter \xff <a> 1 +0000\n"
    objects = pygit2.Repository(str(made.checkout))
    text = f"{raw}encoding none-such\n\nx\n".encode("latin-1")
    objects.set_head(objects.odb.write(pygit2.enums.ObjectType.COMMIT, text))
    assert made.check().code == 1


def test_helm_gets_no_schema_and_the_schema_of_a_library_counts(told: Told) -> None:
    def require(lab: Lab) -> None:
        schema = {"type": "object", "required": ["level"]}
        put(lab, f"{CHART}/charts/part/values.schema.json", json.dumps(schema))
        chart(lab, f"{CHART}/charts/part")
        metadata = lab.checkout / CHART / "Chart.yaml"
        entry = "  - {name: part, version: 0.1.0}\n"
        put(lab, f"{CHART}/Chart.yaml", metadata.read_text() + entry)

    (line,) = told(require)
    assert "level" in line
    assert line.startswith(f"{CHART}/values.yaml")

    def set_level(lab: Lab) -> None:
        require(lab)
        values = lab.checkout / CHART / "values.yaml"
        put(lab, f"{CHART}/values.yaml", values.read_text() + "\npart: {level: 1}\n")
        (lab.checkout / CHART / "values.schema.json").unlink()  # it allows no such values

    assert told(set_level) == []
