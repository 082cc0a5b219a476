"""People's configuration at a commit, and what of it is in force where it is not valid.

A broken file holds back itself and what came with it: the other files of the commits that touched
it, for half of a commit is not what anybody merged, and the rest of its application definition. All
else that people merge is taken in. Where that gives nothing valid, nothing is taken in.
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
    "this is no state repo, for it has no demandops.yaml; `demandops init DIR` makes one"
)

StandIns = Mapping[str, Oid | None]
"""Path → the blob that is in force in its place; nothing where no such file is."""


@dataclass(frozen=True, slots=True)
class Source:
    """Where the configuration in force is: the files of a commit, some in another version."""

    commit: Oid
    stand_ins: StandIns = field(default_factory=dict)

    def blobs(self, repo: Repository) -> dict[str, Oid]:
        """Return path → blob of every file in force."""
        found = dict(_blobs(repo, self.commit))
        for path, blob in self.stand_ins.items():
            found.pop(path, None)
            if blob is not None:
                found[path] = blob
        return found

    def texts(self, repo: Repository) -> dict[str, str]:
        """Return path → text of every file in force."""
        return {path: _text(repo, blob) for path, blob in self.blobs(repo).items()}


@dataclass(frozen=True, slots=True)
class Found:
    """What of a commit's configuration can be in force; no configuration where nothing can."""

    config: Config | None
    source: Source
    faults: tuple[Fault, ...]


def config_at(tree: Tree) -> Config:
    """Return the configuration of one tree.

    Raises:
        StateRepoError: where it is no state repo.
        InvalidInput: with every fault of every file.
    """
    files = trees.texts(tree, CONFIG_ROOTS)
    if ROOT_FILE not in files:
        raise StateRepoError(NO_STATE_REPO)
    return load_config(files).with_ended_overrides(ended_override_file.read(markers_at(tree)))


def markers_at(tree: Tree) -> dict[str, str]:
    """Return path → text of the files that say which overrides ended."""
    return trees.texts(tree, (ended_override_file.MARKERS_ROOT,))


def refuse_other_rendering(tree: Tree) -> None:
    """Raise where a generator of another version writes the repo: two would undo each other's work.

    Raises:
        StateRepoError: saying which version it is and what to do.
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
        remedy = "stop older generators, then have all rendered anew by `demandops upgrade`"
    raise StateRepoError(
        f"{ROOT_FILE}: renderVersion: is {version}, but this generator renders version "
        f"{RENDER_VERSION}; {remedy}"
    )


def newest_valid(commit: Commit, fault: InvalidInput) -> Config:
    """Return the configuration of the newest commit before one that is not valid, and was.

    Raises:
        InvalidInput: ``fault``, where there never was one.
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
    return tuple(str(trees.id_of(tree, root)) for root in CONFIG_ROOTS)


def found(
    repo: Repository,
    before: tuple[Source, Oid | None],
    to: Oid,
    load: Callable[[Mapping[str, str]], Config],
) -> Found:
    """Return the configuration of a commit, with stand-ins for what is not valid.

    Args:
        before: what was in force, and the newest commit where all was valid.
        to: the commit.
        load: makes a configuration of texts, or raises ``InvalidInput``.
    """
    known, sound = before[0].blobs(repo), before[1]
    blobs = dict(_blobs(repo, to))
    merged = {path for path in {*known, *blobs} if known.get(path) != blobs.get(path)}
    stand_ins: dict[str, Oid | None] = {}
    faults: list[Fault] = []
    while True:
        try:
            config = load({path: _text(repo, blob) for path, blob in blobs.items()})
        except InvalidInput as error:
            faults += error.faults
            broken = {one.file for one in error.faults} & (merged - set(stand_ins))
            if not broken:
                return Found(None, before[0], tuple(dict.fromkeys(faults)))
            for path in merged & _with_company(repo, broken, sound, to):
                stand_ins[path] = known.get(path)
                blobs.pop(path, None)
                if path in known:
                    blobs[path] = known[path]
        else:
            return Found(config, Source(to, stand_ins), tuple(dict.fromkeys(faults)))


def _with_company(repo: Repository, broken: Iterable[str], sound: Oid | None, to: Oid) -> set[str]:
    """Return files and what came with them: in the same commit, or in the same definition."""
    company = set(broken)
    merges = list(_merges(repo, sound, to))
    known = {path for commit in (to, sound) if commit for path, _ in _blobs(repo, commit)}
    size = 0
    while size != len(company):
        size = len(company)
        for touched in merges:
            if touched & company:
                company |= touched
        folders = tuple(
            "/".join(path.split("/")[:2]) + "/" for path in company if path.startswith("appdefs/")
        )
        company |= {path for path in known if path.startswith(folders)} if folders else set()
    return company


def _merges(repo: Repository, sound: Oid | None, to: Oid) -> Iterator[set[str]]:
    """Yield what each commit since ``sound`` brought; of a merged branch, all of it at once."""
    walker = repo.walk(to, SortMode.TOPOLOGICAL)
    if sound is not None:
        walker.hide(sound)
    for commit in walker:
        if commit.parents:
            before, after = commit.parents[0].tree, commit.tree
            yield {
                path
                for root in CONFIG_ROOTS
                for path, _ in trees.below_root(repo, before, after, root)
            }


def _blobs(repo: Repository, commit: Oid) -> Iterator[tuple[str, Oid]]:
    tree = repo[commit].peel(Commit).tree
    for root in CONFIG_ROOTS:
        entry = trees.child(tree, root)
        if isinstance(entry, Tree):
            yield from trees.entries(entry, f"{root}/")
        elif isinstance(entry, Blob):
            yield root, entry.id


def _text(repo: Repository, blob: Oid) -> str:
    found = repo[blob]
    return found.data.decode("utf-8", "replace") if isinstance(found, Blob) else ""
