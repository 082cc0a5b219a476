"""The configuration at a commit, with the last valid versions of invalid files.

If a file is invalid, its last valid version is in effect. The same holds for the files that apply
only together with the invalid file:

- all files of each commit that changed the invalid file since all files were valid, because a
  commit applies whole or not at all;
- the other files of the application definition, if the invalid file belongs to one.

All other changes apply. If the result is still not valid, no change of the configuration applies.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from pygit2 import Oid, Repository, Tree

from demandops import strict_yaml
from demandops.config.config import CONFIG_ROOTS, Config
from demandops.config.load import load as load_config
from demandops.config.repo_settings import ROOT_FILE
from demandops.errors import Fault, InvalidInput, StateRepoError
from demandops.ledger import ended_override_file
from demandops.settings import RENDER_VERSION
from demandops.staterepo.git import tree as trees
from demandops.staterepo.history import commit_log

NO_STATE_REPO = (
    "this is not a state repo, because it has no demandops.yaml; if the file was deleted, restore "
    "it; `demandops init DIR` makes a new state repo"
)

# Path → the blob that is in effect instead of the commit's file; None if no file is in effect.
Replacements = Mapping[str, Oid | None]


@dataclass(frozen=True, slots=True)
class ConfigSource:
    """The commit whose configuration is in effect, except for the files in ``replacements``."""

    commit: Oid
    replacements: Replacements = field(default_factory=dict)

    def files(self, repo: Repository) -> dict[str, Oid]:
        tree = trees.commit_of(repo, self.commit).tree
        files = {path: blob.id for path, blob in trees.blobs(tree, CONFIG_ROOTS)}
        wanted = {**files, **self.replacements}
        return {path: blob for path, blob in wanted.items() if blob is not None}

    def texts(self, repo: Repository) -> dict[str, str]:
        return {path: trees.text_of(repo[blob]) for path, blob in self.files(repo).items()}


@dataclass(frozen=True, slots=True)
class LastValidConfig:
    """A commit's configuration, with the last valid versions of its invalid files."""

    # none if it is not valid even so; then the source is the one that was in effect before
    config: Config | None
    source: ConfigSource
    faults: tuple[Fault, ...]


def config_at(tree: Tree) -> Config:
    """Return the configuration of a tree, or raise InvalidInput with the faults of all files."""
    files = trees.texts(tree, CONFIG_ROOTS)
    if ROOT_FILE not in files:
        raise StateRepoError(NO_STATE_REPO)
    return load_config(files)


def end_markers_at(tree: Tree) -> dict[str, str]:
    return trees.texts(tree, (ended_override_file.MARKERS_ROOT,))


def ended_overrides_at(tree: Tree) -> dict[str, str]:
    """Return the time ``expires`` of each ended override when it ended, by the override's name."""
    return ended_override_file.read(end_markers_at(tree))


def refuse_other_render_version(repo: Repository, commit: Oid) -> None:
    """Raise StateRepoError if a program of another render version serves the state repo."""
    # generators of two render versions would undo each other's changes
    try:
        text = trees.read_text(trees.commit_of(repo, commit).tree, ROOT_FILE)
        data = strict_yaml.load(text or "")
    except InvalidInput:
        return
    version = data.get("renderVersion") if isinstance(data, dict) else None
    if type(version) is not int or version == RENDER_VERSION:
        return
    # A version that no program ever wrote here is a person's mistake, and load_last_valid_config
    # holds it back like any other invalid file. Else one merge would stop all demands.
    if not commit_log.was_rendered_with(repo, commit, version):
        return
    remedy = "update the generator"
    if version < RENDER_VERSION:
        remedy = "stop older generators, then run `demandops upgrade` to render everything again"
    raise StateRepoError(
        f"{ROOT_FILE}: renderVersion: is {version}, but this generator renders version "
        f"{RENDER_VERSION}; {remedy}"
    )


def load_last_valid_config(
    repo: Repository,
    before: ConfigSource,
    last_valid_commit: Oid,
    to: Oid,
    load: Callable[[Mapping[str, str]], Config],
) -> LastValidConfig:
    """Return the configuration of a commit, with the last valid versions of invalid files.

    Args:
        repo: the repository.
        before: the source of the configuration that was in effect before ``to``.
        last_valid_commit: the newest commit where all files were valid.
        to: the commit to load.
        load: gets files as path → text, and returns their configuration or raises
            ``InvalidInput``.
    """
    old, source = before.files(repo), ConfigSource(to)
    new = source.files(repo)
    changed = {path for path in {*old, *new} if old.get(path) != new.get(path)}
    faults: dict[Fault, None] = {}
    while True:
        try:
            config = load(source.texts(repo))
        except InvalidInput as error:
            faults |= dict.fromkeys(error.faults)
            broken = {fault.file for fault in error.faults} & changed - set(source.replacements)
            if not broken:  # nothing is left to hold back
                return LastValidConfig(None, before, tuple(faults))
            # the old version may have faults with another new file, so check the result again
            together = changed & _with_files_merged_together(repo, broken, last_valid_commit, to)
            more = {path: old.get(path) for path in together}
            source = ConfigSource(to, {**source.replacements, **more})
        else:
            return LastValidConfig(config, source, tuple(faults))


def _with_files_merged_together(
    repo: Repository, broken: Iterable[str], last_valid_commit: Oid, to: Oid
) -> set[str]:
    """Return the broken files, and all files that apply only together with them or with these."""
    together = set(broken)
    merges = [
        {path for path, _ in trees.differences(commit.parents[0].tree, commit.tree, CONFIG_ROOTS)}
        for commit, _ in commit_log.commits(repo, to, last_valid_commit)
        if commit.parents  # compared with its first parent, a merge changes all files of a branch
    ]
    paths = {
        path for commit in (to, last_valid_commit) for path in ConfigSource(commit).files(repo)
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
        together |= {path for path in paths if path.startswith(folders)}
    return together
