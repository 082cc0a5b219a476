"""The configuration at a commit, when a file that people merged may be invalid."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field

from pygit2 import Oid, Repository, Tree

from demandops.base import strict_yaml
from demandops.base.errors import Fault, InvalidInput, StateRepoError, place_text
from demandops.base.quoting import is_visible, one_line
from demandops.base.settings import API_VERSION, NOTES_ROOT, RENDER_VERSION
from demandops.model.config.config import CONFIG_ROOTS, Config
from demandops.model.config.load import load as load_config
from demandops.model.config.repo_settings import ROOT_FILE
from demandops.model.ledger import records
from demandops.repo.git import tree as trees
from demandops.repo.history import commit_log

# ---- the problem report, which lists the invalid files ----
#
# The report names the first 100 faults and counts the others. A fault has the commit that caused it
# and the author of the commit, if the commit was found. The same problems give the same bytes, so
# an unchanged report causes no commit.

PATH = f"{NOTES_ROOT}/reports/problems.yaml"
_HEAD = (
    "# Written by the generator: the files that are not valid. The last valid version of each\n"
    "# stays in effect until the file is fixed. The generator then removes this report.\n"
)
_MOST = 100
_WRITTEN = ("file", "field", "message", "since", "author")


@dataclass(frozen=True, slots=True)
class Problem:
    """A fault, with the id and the author of the commit that caused it, or empty texts."""

    file: str
    field: str
    message: str
    since: str = ""
    author: str = ""
    line: int | None = None  # not written to the report: ``Reader.problems`` finds it in the file

    def __str__(self) -> str:
        places = (place_text(self.file, self.line), self.field)
        text = ": ".join(part for part in (*places, self.message) if part)
        if not self.since:
            return text
        return f"{text} (since {self.since[:10]} by {self.author})"


# From a file's path to the commit that caused the file's fault: its id and author.
Origin = Callable[[str], tuple[str, str] | None]


def with_origins(
    faults: Iterable[Fault], reported: Iterable[Problem], origin: Origin
) -> tuple[Problem, ...]:
    # a problem that is reported already keeps its commit and author
    existing = {(old.file, old.field, old.message): old for old in reported if old.since}
    places = sorted({(fault.file, fault.field, fault.message) for fault in faults})
    problems = []
    for place in places[:_MOST]:
        file, field, message = map(one_line, place)
        if (file, field, message) in existing:
            problems.append(existing[file, field, message])
            continue
        commit, author = origin(place[0]) or ("", "")
        problems.append(Problem(file, field, message, commit, one_line(author)))
    # What the report has no room for gets no commit: it would have to be sought at each demand.
    return (*problems, *(Problem(*place) for place in places[_MOST:]))


def write(problems: tuple[Problem, ...]) -> str | None:
    if not problems:
        return None
    data: dict[str, object] = {
        "apiVersion": API_VERSION,
        "kind": "ProblemReport",
        "problems": [
            {name: value for name, value in asdict(problem).items() if value}
            for problem in problems[:_MOST]
        ],
    }
    if len(problems) > _MOST:
        data["more"] = len(problems) - _MOST
    return _HEAD + strict_yaml.dump(data)


def read(text: str | None) -> tuple[Problem, ...]:
    """Return the problems of a report; none if it is missing or a person made it unreadable."""
    try:
        data = strict_yaml.load(text or "")
    except InvalidInput:
        return ()

    def visible(value: object) -> str:
        return value if isinstance(value, str) and is_visible(value) else ""

    entries = data.get("problems") if isinstance(data, dict) else None
    return tuple(
        Problem(**{name: visible(entry.get(name)) for name in _WRITTEN})  # type: ignore[arg-type]
        for entry in (entries if isinstance(entries, list) else ())
        if isinstance(entry, dict)
    )


# ---- the configuration, with the last valid versions of invalid files ----
#
# If a file is invalid, its last valid version is in effect. The same holds for the files that apply
# only together with the invalid file:
#
# - all files of each commit that changed the invalid file since all files were valid, because a
#   commit applies whole or not at all;
# - the other files of the application definition, if the invalid file belongs to one.
#
# All other changes apply. If the result is still not valid, no change of the configuration applies.

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
    # none if it is not valid even so; then the source is the one that was in effect before
    config: Config | None
    source: ConfigSource
    faults: tuple[Fault, ...]


def config_at(tree: Tree) -> Config:
    files = trees.texts(tree, CONFIG_ROOTS)
    if ROOT_FILE not in files:
        raise StateRepoError(NO_STATE_REPO)
    return load_config(files)


def end_markers_at(tree: Tree) -> dict[str, str]:
    return trees.texts(tree, (records.MARKERS_ROOT,))


def ended_overrides_at(tree: Tree) -> dict[str, str]:
    # by the override's name: its time ``expires`` when it ended
    return records.read_ended_override(end_markers_at(tree))


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
    # ``before`` was in effect before the commit ``to``; at ``last_valid_commit``, the newest such
    # commit, all files were valid
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
