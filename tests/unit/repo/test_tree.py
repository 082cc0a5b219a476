"""Writing and comparing trees agree with a model of a file tree: a dict by path."""

from __future__ import annotations

import errno
import gc
import os
import tempfile
import weakref
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import pygit2
import pytest
from demandops.repo.git import tree as trees
from demandops.repo.git.objects import NewObjects
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.chance import examples
from tests.kit.repo import git

Files = dict[str, str]

NAMES = st.sampled_from(["a", "b", "a.b", "a-b", "é", "A b"])
PATHS = st.lists(NAMES, min_size=1, max_size=4).map("/".join)
TEXTS = st.sampled_from(["", "x", "x\n", "ü{{ y }}\n"])


def fits(path: str, paths: Iterable[str]) -> bool:
    """Return whether one tree can have files at a path and at others."""
    others = {*paths} - {path}
    return not any(one.startswith(f"{path}/") or path.startswith(f"{one}/") for one in others)


@st.composite
def file_trees(draw: st.DrawFn) -> Files:
    files: Files = {}
    for path, text in draw(st.dictionaries(PATHS, TEXTS, max_size=8)).items():
        if fits(path, files):
            files[path] = text
    return files


@st.composite
def changes(draw: st.DrawFn, files: Files) -> dict[str, str | None]:
    """Return random changes: files to remove (None), also such that do not exist, and new texts."""
    known = st.sampled_from(sorted(files)) if files else PATHS
    made: dict[str, str | None] = {}
    for path in draw(st.lists(known | PATHS, max_size=4)):
        if not any(file.startswith(f"{path}/") for file in files):
            made[path] = None
    for path, text in draw(st.lists(st.tuples(known | PATHS, TEXTS), max_size=5)):
        if fits(path, (other for other, new in made.items() if new is not None)):
            made[path] = text
    return {path: made[path] for path in draw(st.permutations(sorted(made)))}


def changed(files: Files, change: Mapping[str, str | None]) -> Files:
    """Return the files after a change; a new text replaces the files that conflict with it."""
    after = {path: text for path, text in files.items() if path not in change}
    new = {path: text for path, text in change.items() if text is not None}
    return {path: text for path, text in after.items() if fits(path, new)} | new


@contextmanager
def scratch() -> Iterator[pygit2.Repository]:
    with tempfile.TemporaryDirectory() as folder:
        yield pygit2.init_repository(folder, bare=True)


def read(repo: pygit2.Repository, tree: pygit2.Oid) -> Files:
    found = repo[tree]
    assert isinstance(found, pygit2.Tree)
    names = [str(entry.name) for entry in found]
    return {path: blob.data.decode() for path, blob in trees.blobs(found, names)}


def _text(repo: pygit2.Repository, blob: pygit2.Oid) -> str:
    found = repo[blob]
    assert isinstance(found, pygit2.Blob)
    return found.data.decode()


def lay(repo: pygit2.Repository, files: Files) -> pygit2.Tree:
    """Write a tree through an index, as Git itself does."""
    index = pygit2.Index()
    for path, text in files.items():
        blob = repo.create_blob(text.encode())
        index.add(pygit2.IndexEntry(path, blob, pygit2.enums.FileMode.BLOB))
    tree = repo[index.write_tree(repo)]
    assert isinstance(tree, pygit2.Tree)
    return tree


@given(data=st.data())
@examples(80)
def test_a_change_gives_the_tree_that_git_would_write_and_differs_in_the_changed_files(
    data: st.DataObject,
) -> None:
    files = data.draw(file_trees(), "files")
    change = data.draw(changes(files), "change")
    wanted = changed(files, change)
    more = data.draw(changes(wanted), "more")
    with scratch() as repo:
        new, before = NewObjects(repo), lay(repo, files)
        made = repo[new.add_tree(before if files else None, change)].peel(pygit2.Tree)
        assert read(repo, made.id) == wanted
        assert made.id == lay(repo, wanted).id, "the tree has an empty folder or a wrong mode"
        for further in (more, {}):  # each starts from a tree that `new` has
            assert new.add_tree(made, further) == lay(repo, changed(wanted, further)).id
        told = list(trees.differences(before, made))
        paths = {path for path in {*files, *wanted} if files.get(path) != wanted.get(path)}
        # if a folder replaces a file, the file's removal and the folder's files are reported
        assert {path for path, _ in told} == paths
        assert len(told) == len(paths)
        for path, blob in told:
            assert (_text(repo, blob) if blob else None) == wanted.get(path)


def test_bytes_that_are_no_text_show_instead_of_stopping(repo: pygit2.Repository) -> None:
    builder = repo.TreeBuilder()
    builder.insert("f", repo.create_blob(b"caf\xe9"), pygit2.enums.FileMode.BLOB)
    tree = repo[builder.write()].peel(pygit2.Tree)
    assert trees.read_text(tree, "f") == "caf\ufffd"
    assert trees.texts(tree, ("f", "nothing")) == {"f": "caf\ufffd"}
    assert trees.read_text(tree, "nothing/there") is None


def test_a_submodule_has_no_text_and_is_told_as_a_difference(repo: pygit2.Repository) -> None:
    builder = repo.TreeBuilder()
    builder.insert("sub", pygit2.Oid(hex="1" * 40), pygit2.enums.FileMode.COMMIT)
    builder.insert("f", repo.create_blob(b"x"), pygit2.enums.FileMode.BLOB)
    inner = builder.write()
    builder = repo.TreeBuilder()
    builder.insert("top", inner, pygit2.enums.FileMode.TREE)
    tree = repo[builder.write()].peel(pygit2.Tree)
    assert trees.texts(tree, ("top",)) == {"top/f": "x"}
    assert [path for path, _ in trees.differences(None, tree)] == ["top/f", "top/sub"]


@pytest.mark.parametrize("has_links", [True, False])
def test_housekeeping_keeps_a_pack_that_no_reference_leads_to_yet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_links: bool
) -> None:
    def link(*_: object) -> None:
        raise OSError(errno.EPERM, os.strerror(errno.EPERM))  # as exFAT answers

    if not has_links:
        monkeypatch.setattr(os, "link", link)
    repo = pygit2.init_repository(tmp_path, bare=True)
    new = NewObjects(repo)
    tree = new.add(pygit2.enums.ObjectType.TREE, b"")
    people = "A <a@example.org> 1770000000 +0000"
    text = f"tree {tree}\nauthor {people}\ncommitter {people}\n\nx\n"
    commit = new.add(pygit2.enums.ObjectType.COMMIT, text.encode())
    with new.packed(commit):
        git(tmp_path, "gc", "--prune=now", "--quiet")
        assert git(tmp_path, "cat-file", "-p", str(commit)) == text.rstrip("\n")
        repo.references.create("refs/heads/main", commit)
        (keep,) = (tmp_path / "objects" / "pack").glob("*.keep")
        left = keep.read_bytes()
    assert not keep.exists()
    keep.write_bytes(left)  # as if the process had been killed
    new.clean()
    assert not keep.exists()
    git(tmp_path, "gc", "--prune=now", "--quiet")
    git(tmp_path, "fsck", "--strict")


def test_two_that_write_the_same_pack_at_once_leave_its_index_alone(tmp_path: Path) -> None:
    pygit2.init_repository(tmp_path, bare=True)
    repos = [pygit2.Repository(tmp_path) for _ in range(2)]
    one, other = map(NewObjects, repos)
    first, second = (new.add_tree(None, {"f": "x"}) for new in (one, other))
    with one.packed(first):
        assert repos[0].odb.exists(first)  # by the index, which it keeps in memory from now on
        with other.packed(second):
            assert repos[0].odb.exists(pygit2.hash("x"))


def test_git_reads_packed_files_of_every_size(tmp_path: Path) -> None:
    repo = pygit2.init_repository(tmp_path, bare=True)
    new = NewObjects(repo)
    sizes = [0, 1, 15, 16, 17, 2047, 2048, 2049, 300_000]
    files: dict[str, str | None] = {f"f{size}": "é" + "x" * size for size in sizes}
    tree = new.add_tree(None, files)
    who = pygit2.Signature("A", "a@example.org", 1_770_000_000)
    text = repo.create_commit_string(who, who, "x", tree, [])
    commit = new.add(pygit2.enums.ObjectType.COMMIT, text.encode())
    with new.packed(commit):
        repo.references.create("refs/heads/main", commit)
    (index,) = (tmp_path / "objects" / "pack").glob("*.idx")
    git(tmp_path, "verify-pack", str(index))
    git(tmp_path, "fsck", "--strict")
    assert {path: git(tmp_path, "show", f"main:{path}") for path in files} == files


def test_a_repo_that_nobody_holds_is_closed(tmp_path: Path) -> None:
    repo = pygit2.init_repository(tmp_path, bare=True)
    new, seen = NewObjects(repo), weakref.ref(repo)
    del repo, new
    gc.collect()
    assert seen() is None
