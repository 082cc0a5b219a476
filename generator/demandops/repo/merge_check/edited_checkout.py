"""A checkout that a person edited, and what to do in place of edits of generated files."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pygit2
from pygit2 import Commit, Repository, Tree

from demandops.base import strict_yaml
from demandops.base.errors import InvalidInput, StateRepoError, fault
from demandops.base.quoting import quoted
from demandops.base.runtime import REAL
from demandops.base.settings import API_VERSION, GENERATED_ROOTS, MAIN_BRANCH, modeline
from demandops.decide.planning.planner import ReleaseKey
from demandops.decide.state import ABSENT, State, leaf_differences, planned_releases
from demandops.model.config.config import CONFIG_ROOTS, Config
from demandops.model.config.override import OVERRIDES_ROOT
from demandops.model.config.repo_settings import ROOT_FILE
from demandops.model.ledger import claim as claim_files
from demandops.model.release import Release, ServiceRelease
from demandops.repo.git import child_processes
from demandops.repo.git import tree as trees
from demandops.repo.git.repository import PARTIAL, open_folder, reading
from demandops.repo.history import commit_log
from demandops.repo.load import snapshot as snapshots

# ---- overrides in place of manual edits, for values, replicas and images ----
#
# The generator's next commit undoes a manual edit, but an override lasts. So the check suggests one
# where it can, and a person has to write only the reason into it.

_VALUES = (("spec", "values"), ("spec", "source", "helm", "valuesObject"))  # Flux, Argo CD
_REFERENCE = re.compile(
    r"(?P<repository>.+?)(?::(?P<tag>[^:/@]+))?(?:@(?P<digest>sha256:[0-9a-f]{64}))?"
)
_REASON = "Say here why you need this override; it replaces a manual edit of a generated file"


def override_text(effects: dict[str, Any], release: Release, owner: str) -> str:
    who = owner.strip()[:100] if owner.isprintable() and owner.strip() else "unknown"
    head = {"apiVersion": API_VERSION, "kind": "Override", "reason": _REASON, "owner": who}
    if isinstance(release, ServiceRelease):
        select = {"applications": [*release.applications], "services": [release.key.service]}
    else:
        select = {"connections": [*release.connections]}
    if not (isinstance(release, ServiceRelease) and release.key.application):
        select["nodes"] = [release.node.id]
    text = strict_yaml.dump({**head, "select": [select], **effects})
    return modeline(f"{OVERRIDES_ROOT}/NAME.yaml", "override") + text


def also_applies(release: Release, other: Release) -> bool:
    if not (isinstance(release, ServiceRelease) and isinstance(other, ServiceRelease)):
        return False
    same = (release.key.service, release.node.id) == (other.key.service, other.node.id)
    shared = {*release.applications} & {*other.applications}
    return other.name != release.name and same and bool(shared)


def effects_of(
    before: str, after: str, release: Release, config: Config
) -> tuple[dict[str, Any], list[str]]:
    try:
        old, new = list(strict_yaml.load_all(before)), list(strict_yaml.load_all(after))
    except InvalidInput:
        return {}, []
    values, replicas, pins, left = dict[str, Any](), None, dict[str, dict[str, str]](), list[str]()
    is_service = isinstance(release, ServiceRelease)
    if isinstance(release, ServiceRelease):
        images = [(config.images[name].repository, name) for name in release.images]
        # a repository of two images does not tell which of them an edit means
        repositories = [repository for repository, _ in images]
        names = {repo: name for repo, name in images if repositories.count(repo) == 1}
        for path in _VALUES:
            was, now = _take(old, path), _take(new, path)
            if isinstance(was, dict) and isinstance(now, dict):
                values = _merge_patch(was, now, names, pins)
                count = values.get("replicas")
                if was.get("replicas") == release.replicas and type(count) is int and count >= 0:
                    replicas = values.pop("replicas")
            elif was != now:
                left.append(".".join(path))
    by_reference = {image.reference(): name for name, image in config.images.items()}
    for place, was, now in leaf_differences(old, new):
        index, _, field = place[1:].partition("].")
        is_image = field.endswith(".image") and not is_service and isinstance(now, str)
        name = by_reference.get(str(was)) if is_image else None
        match = _REFERENCE.fullmatch(now) if name else None
        if name and match and (match["tag"] or match["digest"]):
            same = (None, config.images[name].repository)
            pins[name] = {
                part: text for part, text in match.groupdict().items() if text not in same
            }
        elif not index.isdigit():
            left.append(place or "the number of documents")
        else:
            left.append(field if is_service else f"{old[int(index)].get('kind')} {field}")
    effects = {"values": values or None, "images": pins or None, "replicas": replicas}
    return {name: effect for name, effect in effects.items() if effect is not None}, left


def _take(documents: list[Any], path: tuple[str, ...]) -> Any:  # noqa: ANN401
    part = documents[0] if documents else None
    for key in path[:-1]:
        part = part.get(key) if isinstance(part, dict) else None
    return part.pop(path[-1], None) if isinstance(part, dict) else None


def _merge_patch(
    old: dict[str, Any], new: dict[str, Any], names: dict[str, str], pins: dict[str, dict[str, str]]
) -> dict[str, Any]:
    # RFC 7386; changes of an image whose repository is in ``names`` go to ``pins`` instead
    patch: dict[str, Any] = {key: None for key in old if key not in new}  # None removes a key
    for key, value in new.items():
        was = old.get(key, ABSENT)
        if isinstance(was, dict) and isinstance(value, dict):
            inner = _merge_patch(was, value, names, pins)
            pin = {part: str(text) for part, text in inner.items() if text}
            name = names.get(str(was.get("repository")))
            if name and pin and inner.keys() <= {"repository", "tag", "digest"}:
                pins[name] = pin
            elif inner:
                patch[key] = inner
        elif next(leaf_differences(was, value), None):
            patch[key] = value
    return patch


# ---- the tree that Git would make of a checkout ----
#
# What counts is what Git would commit: what filters and conversions of line ends make of the files,
# without ignored ones. So git itself makes the tree, in a temporary index and folder of objects.
# It runs only filters that the configuration of this machine names.

ROOTS = (*CONFIG_ROOTS, claim_files.LEDGER_ROOT, *GENERATED_ROOTS)
# A fleet of 20,000 nodes has fewer; more would fill the memory of the machine that checks.
_LARGEST, _MOST = 16 << 20, 1 << 30  # bytes of a file, and of all
_NO_PROGRAMS = ("-c", "core.fsmonitor=false", "-c", f"core.hooksPath={os.devnull}")
_NO_SPLIT = ("-c", "core.splitIndex=false")  # or git would write into the checkout's repository


@contextmanager
def opened(folder: Path) -> Iterator[tuple[Repository, Tree]]:
    """Yield a checkout's repository, and the tree that git would make of the files in ``ROOTS``.

    Files without Git are in an empty repository meanwhile.
    """
    with TemporaryDirectory(prefix="demandops-check-") as scratch:
        repo = open_folder(folder)
        if repo is not None and repo.is_bare:
            raise StateRepoError(
                f"{folder} is a bare repository, which has no files to edit; clone it, and use the "
                f"clone: git clone {folder}"
            )
        if repo is None:
            repo = pygit2.init_repository(f"{scratch}/empty.git", bare=True)
        with reading(str(folder), repo):
            tree = _written_tree(folder, repo, Path(scratch))
            if ROOT_FILE not in tree:
                raise StateRepoError(
                    f"{folder} is not a state repo, because it has no {ROOT_FILE}; name a checkout "
                    "of one, or make one with `demandops init`"
                )
            yield repo, tree


def _written_tree(folder: Path, repo: Repository, scratch: Path) -> Tree:
    index, objects = scratch / "index", scratch / "objects"
    environment = {
        "GIT_DIR": repo.path,
        "GIT_WORK_TREE": str(folder.resolve()),
        "GIT_INDEX_FILE": str(index),
        "GIT_OBJECT_DIRECTORY": str(objects),
        # a partial clone must not fetch; before Git 2.44 only the latter prevents that
        **{"GIT_NO_LAZY_FETCH": "1", "GIT_ALLOW_PROTOCOL": "none", "LC_ALL": "C"},
    }

    def git(*arguments: str, stdin: bytes = b"") -> list[bytes]:
        done = subprocess.run(
            ["git", *_NO_PROGRAMS, *_NO_SPLIT, *arguments],
            cwd=folder,
            env=os.environ | child_processes.mark() | environment,
            input=stdin,
            capture_output=True,
            check=False,
        )
        if done.returncode and b"promisor" in done.stderr:
            raise StateRepoError(PARTIAL.format(folder))
        if done.returncode:
            told = done.stderr.decode(errors="replace").strip().splitlines()
            raise StateRepoError(
                f"{folder} cannot be read as git would commit it: {'; '.join(told)}; mend it until "
                "`git add --all` succeeds"
            )
        return [part for part in done.stdout.removesuffix(b"\n").split(b"\0") if part]

    shared = Path(repo.path, "commondir")  # of a linked work tree
    common = shared.read_text().strip() if shared.is_file() else ""
    (objects / "info").mkdir(parents=True)
    store = Path(repo.path, common, "objects").resolve()
    (objects / "info" / "alternates").write_text(f"{store}\n")
    if (own := Path(repo.path, "index")).is_file():
        # with its time, after which git reads files again whose size and time are as before
        shutil.copy2(own, index)
    unmerged = {entry.partition(b"\t")[2] for entry in git("ls-files", "--unmerged", "-z")}
    _refuse(dict.fromkeys(unmerged, "is not merged yet; edit it as it shall be, and `git add` it"))
    new = git("ls-files", "--others", "--exclude-standard", "-z", "--", *ROOTS)
    _refuse({path.rstrip(b"/"): _NESTED for path in new if path.endswith(b"/")})
    git("add", "--update")
    git("update-index", "--add", "--replace", "-z", "--stdin", stdin=b"\0".join(new))
    (tree,) = git("write-tree", "--missing-ok")
    reasons, total = dict[bytes, str](), 0
    for entry in git("ls-tree", "-r", "-l", "-z", tree.decode(), *ROOTS):
        about, _, path = entry.partition(b"\t")
        mode, _, _, size = about.split()
        if mode == b"120000":  # it may point to a file that the report must not show
            reasons[path] = "is a symbolic link, which is not followed; replace it by a file"
        elif mode == b"160000":
            reasons[path] = _NESTED
        elif path.count(b"/") > trees.MAX_DEPTH:
            reasons[path] = f"is more than {trees.MAX_DEPTH} folders deep; move it up"
        elif int(size) > _LARGEST:
            reasons[path] = f"has more than {_LARGEST >> 20} MiB; make it smaller"
        else:
            total += int(size)
    _refuse(reasons)
    if total > _MOST:
        raise StateRepoError(f"{folder} has more than {_MOST >> 20} MiB to check; take files out")
    repo.odb.add_disk_alternate(str(objects))
    return repo[tree.decode()].peel(Tree)


_NESTED = "belongs to another Git repository, whose files are not read; remove it"


def _refuse(reasons: Mapping[bytes, str]) -> None:
    if reasons:
        raise InvalidInput(
            fault("", why).within(trees.printable(path)) for path, why in reasons.items()
        )


# ---- the commit that an edit started from ----

_DEFAULTS = (f"refs/remotes/origin/{MAIN_BRANCH}", f"refs/heads/{MAIN_BRANCH}")
_SHALLOW = (
    "this clone is shallow and lacks the commit that the edit started from; fetch all commits: "
    "git fetch --unshallow origin (in a pipeline, set fetch-depth: 0 or GIT_DEPTH: 0)"
)


@dataclass(frozen=True, slots=True)
class Base:
    commit: str = ""  # empty if there is none
    files: Mapping[str, str] = field(default_factory=dict)
    state: State | None = None  # in effect at this commit; None if there never was a valid one
    valid: bool = True  # whether it is of all files of the commit
    target: str = ""  # the merge target as git names it, such as ``origin/main``, if there is one
    newer: int = 0  # how many commits of the merge target the checkout lacks
    # the merge target's files, if the checkout lacks commits of it
    theirs: Mapping[str, str] = field(default_factory=dict)

    def releases(self) -> dict[ReleaseKey, Release]:
        return planned_releases(self.state) if self.state else {}


def base_of(repo: Repository, revision: str | None, files: Mapping[str, str]) -> Base:
    # ``revision`` is the merge target; by default ``origin/main``, else ``main``. If there is
    # neither, the edit is compared with HEAD, and without a commit with its own ``files``.
    if repo.is_empty or repo.head_is_unborn:
        if revision is not None:
            raise StateRepoError(
                "the folder has no commit or is not a Git checkout; leave out --base"
            )
        return Base(files=files)
    target = revision or next((name for name in _DEFAULTS if name in repo.references), "")
    head = repo.head.peel(Commit)
    try:
        tip = commit_log.resolve(repo, head.id, target, REAL.now()) if target else None
        common = repo.merge_base(head.id, tip.id) if tip is not None else None
    except (StateRepoError, pygit2.GitError, KeyError):
        if repo.is_shallow:
            raise StateRepoError(f"{quoted(target)}: {_SHALLOW}") from None
        raise
    if common is None and repo.is_shallow:
        raise StateRepoError(_SHALLOW)
    if common is None and target:
        raise StateRepoError(
            f"HEAD and {target} have no commit in common; name the merge target with --base"
        )
    commit = head if common is None else trees.commit_of(repo, common)
    newer = repo.ahead_behind(head.id, tip.id)[1] if tip is not None else 0
    state, valid = None, False
    with suppress(InvalidInput, StateRepoError):
        snapshot = snapshots.state_at(repo, commit.id)
        state, valid = snapshot.state, not snapshot.problems
    return Base(
        str(commit.id),
        trees.texts(commit.tree, ROOTS),
        state,
        valid,
        target.removeprefix("refs/remotes/").removeprefix("refs/heads/"),
        newer,
        trees.texts(tip.tree, ROOTS) if tip is not None and newer else {},
    )


def author_of(repo: Repository) -> str:
    try:
        return str(repo.head.peel(Commit).author.name)
    except (pygit2.GitError, LookupError, ValueError):  # also an encoding that nobody knows
        return ""
