"""A checkout that a person edited, and what to do in place of edits of generated files."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pygit2
from pygit2 import Commit, Repository

from demandops.base import strict_yaml
from demandops.base.errors import Fault, InvalidInput, StateRepoError, fault
from demandops.base.quoting import quoted
from demandops.base.runtime import REAL
from demandops.base.settings import API_VERSION, GENERATED_ROOTS, MAIN_BRANCH, modeline
from demandops.decide import changeset
from demandops.decide.changeset import ABSENT, leaf_differences
from demandops.decide.planning.release_keys import ReleaseKey
from demandops.decide.state import State
from demandops.model.config.config import CONFIG_ROOTS, Config
from demandops.model.config.override import OVERRIDES_ROOT
from demandops.model.ledger import claim as claim_files
from demandops.model.release import Release, ServiceRelease
from demandops.repo.git import tree as trees
from demandops.repo.git.repository import reading, unopened
from demandops.repo.history import revisions
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


# ---- the checkout: its files, and the commit that an edit started from ----

_ROOTS = (*CONFIG_ROOTS, claim_files.LEDGER_ROOT, *GENERATED_ROOTS)
_DEFAULTS = (f"refs/remotes/origin/{MAIN_BRANCH}", f"refs/heads/{MAIN_BRANCH}")
# A fleet of 20,000 nodes has fewer; more would fill the memory of the machine that checks.
_MOST_BYTES = 16 << 20
_MOST_BYTES_IN_ALL = 1 << 30
_MOST_FILES = 500_000
_SHALLOW = (
    "this clone is shallow and lacks the commit that the edit started from; fetch all commits: "
    "git fetch --unshallow origin (in a pipeline, set fetch-depth: 0 or GIT_DEPTH: 0)"
)


@dataclass(frozen=True, slots=True)
class Base:
    commit: str
    files: Mapping[str, str]
    # in effect at this commit, with last valid versions; None if there never was a valid state
    state: State | None
    valid: bool  # whether all files of the commit are valid
    target: str = ""  # the merge target as git names it, such as ``origin/main``, if there is one
    newer: int = 0  # how many commits of the merge target the checkout lacks
    # the merge target's generated files, if the checkout lacks commits of it
    merged: Mapping[str, str] = field(default_factory=dict)

    def releases(self) -> dict[ReleaseKey, Release]:
        return changeset.planned_releases(self.state) if self.state else {}


def files_of(folder: Path) -> tuple[dict[str, str], list[Fault]]:
    """Return the state repo's files as path → text, and a fault for each entry that is not read."""
    # The author of a pull request may be hostile, so only plain files inside of the folder are
    # read, and no other code of the check reads the checkout.
    if not os.path.lexists(folder / "demandops.yaml"):  # is_file follows a link, and may fail
        if (folder / "HEAD").is_file():
            raise StateRepoError(
                f"{folder} is a bare repository, which has no files to edit; clone it, and use the "
                f"clone: git clone {folder}"
            )
        raise StateRepoError(
            f"{folder} is not a state repo, because it has no demandops.yaml; name a checkout of "
            "one, or make one with `demandops init`"
        )
    files, faults, size = dict[str, str](), list[Fault](), 0
    waiting = [folder / root for root in reversed(_ROOTS)]
    while waiting:
        path = waiting.pop()
        parts = path.relative_to(folder)
        name = os.fsencode(parts).decode("utf-8", "backslashreplace")
        try:
            status = path.lstat()
            if message := _why_not_read(path.name, len(parts.parts), status):
                faults.append(fault("", message).within(name))
            elif stat.S_ISDIR(status.st_mode):
                waiting += sorted(path.iterdir(), reverse=True)
            else:
                files[name] = path.read_bytes().decode("utf-8", "replace")
                size += status.st_size
        except FileNotFoundError:  # one of _ROOTS
            continue
        except OSError as error:
            raise StateRepoError(f"{path} cannot be read: {error.strerror}") from None
        if size > _MOST_BYTES_IN_ALL or len(files) + len(waiting) > _MOST_FILES:
            raise StateRepoError(
                f"{folder} has more than {_MOST_FILES:,} files or {_MOST_BYTES_IN_ALL >> 20} MiB "
                "to check; take some out"
            )
    return files, faults


def _why_not_read(name: str, depth: int, status: os.stat_result) -> str:
    if stat.S_ISLNK(status.st_mode):  # it may point to a file that the report must not show
        return "is a symbolic link, which is not followed; replace it by a file"
    if not (stat.S_ISDIR(status.st_mode) or stat.S_ISREG(status.st_mode)):
        return "is neither a file nor a folder; remove it"
    if name.lower() == ".git":  # some file systems do not tell .GIT from .git
        return "belongs to another Git repository, whose files are not read; remove it"
    if stat.S_ISDIR(status.st_mode):
        deep = f"is more than {trees.MAX_DEPTH} folders deep; move it up"
        return deep if depth > trees.MAX_DEPTH else ""
    large = f"has more than {_MOST_BYTES >> 20} MiB; make it smaller"
    return large if status.st_size > _MOST_BYTES else ""


def base_of(folder: Path, revision: str | None) -> Base | None:
    # ``revision`` is the merge target; by default ``origin/main``, else ``main``. If there is
    # neither, the edit is compared with HEAD. None if the folder is no checkout with a commit.
    try:
        repo = Repository(str(folder))
    except pygit2.GitError as error:
        if reason := unopened(folder, error):
            raise reason from None
        if revision is not None:
            raise StateRepoError(f"{folder} is not a Git checkout; leave out --base") from None
        return None
    if "core.sparsecheckout" in repo.config and repo.config.get_bool("core.sparsecheckout"):
        raise StateRepoError(
            f"{folder} is a sparse checkout, which lacks files; check out all files with "
            "`git sparse-checkout disable`"
        )
    if repo.is_empty or repo.head_is_unborn:
        return None
    with reading(str(folder), repo):
        target = revision or next((name for name in _DEFAULTS if name in repo.references), "")
        head = repo.head.peel(Commit)
        try:
            tip = revisions.resolve(repo, head.id, target, REAL.now()) if target else None
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
        base = Base(str(commit.id), trees.texts(commit.tree, _ROOTS), None, False)
        if tip is not None:
            _, newer = repo.ahead_behind(head.id, tip.id)
            merged = trees.texts(tip.tree, GENERATED_ROOTS) if newer else {}
            name = target.removeprefix("refs/remotes/").removeprefix("refs/heads/")
            base = replace(base, target=name, newer=newer, merged=merged)
        try:
            snapshot = snapshots.state_at(repo, commit.id)
        except (InvalidInput, StateRepoError):
            return base
        return replace(base, state=snapshot.state, valid=not snapshot.problems)


def author_of(folder: Path) -> str:
    try:
        repo = Repository(str(folder))
        return str(repo.head.peel(Commit).author.name)
    except (pygit2.GitError, LookupError, ValueError):  # also an encoding that nobody knows
        return ""
