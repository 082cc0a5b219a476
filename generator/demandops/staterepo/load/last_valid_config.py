"""The configuration at a commit, and its last valid version if a file is not valid.

An invalid file is replaced by its last valid version. So are the other files of the commits that
changed it, because half a commit is not what was merged, and the other files of its application
definition. All other changes apply. If the result is not valid either, no change applies.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from pygit2 import Blob, Commit, Oid, Repository, Tree
from pygit2.enums import SortMode

from demandops import strict_yaml
from demandops.config.config import CONFIG_ROOTS, Config
from demandops.config.load import load as load_config
from demandops.config.repo_settings import ROOT_FILE
from demandops.errors import Fault, InvalidInput, StateRepoError
from demandops.ledger import ended_override_file
from demandops.settings import RENDER_VERSION
from demandops.staterepo.git import tree as trees

NO_STATE_REPO = (
    "this is not a state repo, because it has no demandops.yaml; `demandops init DIR` makes one"
)

Replacements = Mapping[str, Oid | None]
"""Path → the blob in effect instead of the commit's; None if no such file is in effect."""


@dataclass(frozen=True, slots=True)
class ConfigSource:
    """The source of the configuration in effect: a commit, with some files in another version."""

    commit: Oid
    replacements: Replacements = field(default_factory=dict)

    def blobs(self, repo: Repository) -> dict[str, Oid]:
        """Return path → blob of every file in effect."""
        blobs = dict(_blobs(repo, self.commit))
        for path, blob in self.replacements.items():
            blobs.pop(path, None)
            if blob is not None:
                blobs[path] = blob
        return blobs

    def texts(self, repo: Repository) -> dict[str, str]:
        """Return path → text of every file in effect."""
        return {path: _text(repo, blob) for path, blob in self.blobs(repo).items()}


@dataclass(frozen=True, slots=True)
class LastValidConfig:
    """The part of a commit's configuration that is valid; ``config`` is None if no part is."""

    config: Config | None
    source: ConfigSource
    faults: tuple[Fault, ...]


def config_at(tree: Tree) -> Config:
    """Return the configuration of one tree.

    Raises:
        StateRepoError: the tree is not a state repo.
        InvalidInput: every fault of every file.
    """
    files = trees.texts(tree, CONFIG_ROOTS)
    if ROOT_FILE not in files:
        raise StateRepoError(NO_STATE_REPO)
    return load_config(files).with_ended_overrides(ended_override_file.read(end_markers_at(tree)))


def end_markers_at(tree: Tree) -> dict[str, str]:
    """Return path → text of the markers of ended overrides."""
    return trees.texts(tree, (ended_override_file.MARKERS_ROOT,))


def refuse_other_render_version(tree: Tree) -> None:
    """Raise if the repo has another render version, because two versions undo each other's work.

    Raises:
        StateRepoError: names the version and the remedy.
    """
    try:
        data = strict_yaml.load(trees.read_text(tree, ROOT_FILE) or "")
    except InvalidInput:
        return
    version = data.get("renderVersion") if isinstance(data, dict) else None
    if not isinstance(version, int) or version == RENDER_VERSION:
        return
    remedy = "update the generator"
    if version < RENDER_VERSION:
        remedy = "stop older generators, then run `demandops upgrade` to render everything again"
    raise StateRepoError(
        f"{ROOT_FILE}: renderVersion: is {version}, but this generator renders version "
        f"{RENDER_VERSION}; {remedy}"
    )


def newest_valid_config(commit: Commit, fault: InvalidInput) -> Config:
    """Return the configuration of the newest ancestor where it was valid.

    Raises:
        InvalidInput: ``fault``, if there is no such ancestor.
    """
    seen = {_config_ids(commit.tree)}
    while commit.parents:
        commit = commit.parents[0]
        if _config_ids(commit.tree) in seen:
            continue
        seen.add(_config_ids(commit.tree))
        try:
            return config_at(commit.tree)
        except (InvalidInput, StateRepoError):
            continue
    raise fault


def _config_ids(tree: Tree) -> tuple[str, ...]:
    return tuple(str(trees.entry_id(tree, root)) for root in CONFIG_ROOTS)


def load_last_valid_config(
    repo: Repository,
    before: ConfigSource,
    last_valid_commit: Oid | None,
    to: Oid,
    load: Callable[[Mapping[str, str]], Config],
) -> LastValidConfig:
    """Return the configuration of a commit, with last valid versions of what is not valid.

    Args:
        before: what was in effect before.
        last_valid_commit: the newest commit where all files were valid.
        to: the commit.
        load: makes a configuration from texts, or raises ``InvalidInput``.
    """
    known = before.blobs(repo)
    blobs = dict(_blobs(repo, to))
    merged = {path for path in {*known, *blobs} if known.get(path) != blobs.get(path)}
    replacements: dict[str, Oid | None] = {}
    faults: list[Fault] = []
    while True:
        try:
            config = load({path: _text(repo, blob) for path, blob in blobs.items()})
        except InvalidInput as error:
            faults += error.faults
            broken = {one.file for one in error.faults} & (merged - set(replacements))
            if not broken:
                return LastValidConfig(None, before, tuple(dict.fromkeys(faults)))
            for path in merged & _with_files_merged_together(repo, broken, last_valid_commit, to):
                replacements[path] = known.get(path)
                blobs.pop(path, None)
                if path in known:
                    blobs[path] = known[path]
        else:
            return LastValidConfig(
                config, ConfigSource(to, replacements), tuple(dict.fromkeys(faults))
            )


def _with_files_merged_together(
    repo: Repository, broken: Iterable[str], last_valid_commit: Oid | None, to: Oid
) -> set[str]:
    """Return files and those merged in the same commits or of the same definition."""
    together = set(broken)
    merges = list(_merges(repo, last_valid_commit, to))
    known = {
        path for commit in (to, last_valid_commit) if commit for path, _ in _blobs(repo, commit)
    }
    size = 0
    while size != len(together):
        size = len(together)
        for touched in merges:
            if touched & together:
                together |= touched
        folders = tuple(
            "/".join(path.split("/")[:2]) + "/" for path in together if path.startswith("appdefs/")
        )
        together |= {path for path in known if path.startswith(folders)} if folders else set()
    return together


def _merges(repo: Repository, last_valid_commit: Oid | None, to: Oid) -> Iterator[set[str]]:
    """Yield the files that each commit changed; a merge changes all files of its branch."""
    walker = repo.walk(to, SortMode.TOPOLOGICAL)
    if last_valid_commit is not None:
        walker.hide(last_valid_commit)
    for commit in walker:
        if commit.parents:
            before, after = commit.parents[0].tree, commit.tree
            yield {
                path
                for root in CONFIG_ROOTS
                for path, _ in trees.differences_below(repo, before, after, root)
            }


def _blobs(repo: Repository, commit: Oid) -> Iterator[tuple[str, Oid]]:
    tree = repo[commit].peel(Commit).tree
    for root in CONFIG_ROOTS:
        entry = trees.child(tree, root)
        if isinstance(entry, Tree):
            yield from trees.files_below(entry, f"{root}/")
        elif isinstance(entry, Blob):
            yield root, entry.id


def _text(repo: Repository, blob: Oid) -> str:
    content = repo[blob]
    return content.data.decode("utf-8", "replace") if isinstance(content, Blob) else ""
