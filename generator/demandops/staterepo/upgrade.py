"""``demandops upgrade``: everything rendered anew in one commit, by this program's version.

So a state repo goes over to another render version or another GitOps controller at once, and two
versions never undo each other's files in turn. Published like every other commit: on top of what is
there, judged anew where that moved, never forced.
"""

from __future__ import annotations

import random
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime

import pygit2
from pygit2 import Repository, Signature

from demandops import strict_yaml
from demandops.config.config import CONFIG_ROOTS, Config
from demandops.config.load import load
from demandops.config.repo_settings import ROOT_FILE
from demandops.decision import State
from demandops.errors import InvalidInput, StateRepoError, fault
from demandops.ledger import ended_override_file
from demandops.plan.overrides.lifecycle import LedgerUpdate, update_ledger
from demandops.plan.release import ServiceRelease
from demandops.render.changes.merge_preview import planned_releases
from demandops.render.gitops.controller_switch import SwitchSteps, switch_steps
from demandops.settings import RENDER_VERSION
from demandops.staterepo import reader
from demandops.staterepo.git import tree as trees
from demandops.staterepo.git.repository import StateRepository
from demandops.staterepo.git.signing import Signer
from demandops.staterepo.history import commit_log, commit_message
from demandops.staterepo.load import last_valid_config
from demandops.staterepo.load import snapshot as snapshots
from demandops.staterepo.load.snapshot import Progress, Snapshot
from demandops.staterepo.write.commit_line import CommitLine

_ATTEMPTS = 10
_PAUSE_S = 0.1
_FOLDER_DEPTH = 3
"""``clusters/<cluster>/<access domain>``, which the commit's message counts files by."""


@dataclass(frozen=True, slots=True)
class UpgradeRequest:
    """What a person asked for: a controller and its URL, or nothing but the newest rendering."""

    gitops: str | None = None
    url: str | None = None


@dataclass(frozen=True, slots=True)
class Upgrade:
    """What an upgrade changes. ``commit`` is the newest one; no file: there was nothing to do."""

    commit: str
    old: Config
    new: Config
    files: Mapping[str, str | None]

    @property
    def handover(self) -> SwitchSteps:
        """What to do on the clusters before and after."""
        return switch_steps(self.old, self.new)


def plan(
    address: str, wish: UpgradeRequest, now: datetime, progress: Progress = lambda done, total: None
) -> Upgrade:
    """Return what an upgrade would change; nothing is written.

    Raises:
        InvalidInput: where the state repo is not valid or the wish cannot be fulfilled.
        StateRepoError: where it cannot be read.
    """
    with reader.opened(address) as repo:
        return _planned(repo.repository, wish, now, progress)[0]


def upgrade(
    address: str,
    wish: UpgradeRequest,
    now: datetime,
    progress: Progress = lambda done, total: None,
    signer: Signer | None = None,
) -> Upgrade:
    """Render everything anew and publish it as one commit; nothing where nothing would change.

    Args:
        address: a folder with a bare repository, or a URL that git clones.
        wish: which controller the state repo is for.
        now: the time of the commit.
        progress: told (files read, files in all) while the ledger is read.
        signer: signs the commit, if given.

    Raises:
        InvalidInput: where the state repo is not valid or the wish cannot be fulfilled.
        StateRepoError: where it cannot be read or written, or never stood still.
    """
    with reader.opened(address) as repo:
        repository = repo.repository
        repository.signer = signer
        for attempt in range(1, _ATTEMPTS + 1):
            made, line, taken = _planned(repository, wish, now, progress)
            if not made.files:
                return made
            author = _person(repository.objects, now)
            state = replace(line.head.state, ledger=taken.ledger, config=taken.config)
            commit = line.record(made.files, state, _message(made, taken), author, now, taken.keys)
            if line.publish():
                return Upgrade(commit, made.old, made.new, made.files)
            time.sleep(_PAUSE_S * attempt * random.uniform(0.5, 1.0))  # noqa: S311 - no secret
            repository.refresh()
    raise StateRepoError(
        f"{repository.address} moved {_ATTEMPTS} times while it was rendered; stop its generators "
        "and try again"
    )


def _planned(
    repository: StateRepository, wish: UpgradeRequest, now: datetime, progress: Progress
) -> tuple[Upgrade, CommitLine, LedgerUpdate]:
    objects, tip = repository.objects, repository.tip()
    snapshot = snapshots.load(objects, tip, progress)
    line, old = CommitLine(repository, snapshot), snapshot.state.config
    tree = trees.commit_of(objects, tip).tree
    files = trees.texts(tree, CONFIG_ROOTS)
    before = files[ROOT_FILE]
    files[ROOT_FILE] = _root(before, old, wish)
    marked = last_valid_config.markers_at(tree)
    config = load(files).with_ended_overrides(ended_override_file.read(marked))
    state = State.of(config, snapshot.state.ledger)
    taken = _taken_in(repository, snapshot, state, marked, now)
    state = replace(state, ledger=taken.ledger, config=taken.config)
    if old.repo_settings.gitops != config.repo_settings.gitops:
        _refuse_held(state)
    found = dict(line.everything(state, taken.files).files)
    if files[ROOT_FILE] != before:
        found[ROOT_FILE] = files[ROOT_FILE]
    return Upgrade(str(tip), old, state.config, dict(sorted(found.items()))), line, taken


def _taken_in(
    repository: StateRepository,
    tip: Snapshot,
    state: State,
    marked: Mapping[str, str],
    now: datetime,
) -> LedgerUpdate:
    """Return the books with what people changed since the generator's last commit taken in."""
    objects = repository.objects
    last = commit_log.last_generated(objects, tip.commit)
    before = tip.state if last is None else snapshots.load_last_valid(objects, last).state
    after = state.ledger
    keys = {claim.key for books in (before.ledger, after) for claim in books}
    subjects = {key.subject for key in keys if before.ledger.get(key) != after.get(key)}
    books = (before.ledger, before.config)
    return update_ledger(books, (after, state.config), sorted(subjects, key=str), marked, now)


def _refuse_held(state: State) -> None:
    """Raise where an override holds a file that is made for the other controller."""
    faults = [
        fault(
            "hold",
            f"keeps {release.name} as it is rendered for the other controller; remove it, and "
            "hold the release again afterwards",
        ).within(override.path)
        for release in planned_releases(state.ledger, state.config).values()
        if isinstance(release, ServiceRelease) and release.shaping.held
        for override, effects in release.shaping.by
        if "hold" in effects
    ]
    if faults:
        raise InvalidInput(faults)


def _root(text: str, config: Config, wish: UpgradeRequest) -> str:
    """Return ``demandops.yaml`` as wished, with whatever else a person wrote in it."""
    repository = config.repo_settings
    gitops = wish.gitops or repository.gitops
    try:
        if repository.render_version != RENDER_VERSION:
            text = strict_yaml.set_key(text, "renderVersion", RENDER_VERSION)
        if repository.gitops != gitops:
            text = strict_yaml.set_key(text, "gitops", gitops)
        section = getattr(repository, gitops)
        if section is None:
            # both fetch the same repo, so the one that stands says from where
            known = getattr(repository, repository.gitops)
            text = strict_yaml.set_key(text, gitops, {"url": wish.url or known.url})
        elif wish.url not in (None, section.url):
            told = f"is {section.url} already; change it there, or leave out --url"
            raise InvalidInput([fault(f"{gitops}.url", told)])
    except InvalidInput as error:
        raise InvalidInput(strict_yaml.faults_in(error, ROOT_FILE)) from None
    return text


def _person(objects: Repository, now: datetime) -> Signature:
    """Return who runs the command, as their Git knows them; the generator where it does not."""
    try:
        who = objects.default_signature
    except (KeyError, ValueError, pygit2.GitError):
        return commit_message.generator_signature(now)
    return Signature(who.name, who.email, int(now.timestamp()), 0)


def _message(made: Upgrade, taken: LedgerUpdate) -> str:
    old, new = made.old.repo_settings, made.new.repo_settings
    moved = old.gitops != new.gitops
    title = "Render everything anew"
    if moved:
        title += f", for {_NAMES[new.gitops]}"
    why = f"from render version {old.render_version} to {new.render_version}"
    if old.render_version == new.render_version:
        why = f"by render version {new.render_version}"
    counts = Counter("/".join(path.split("/")[:_FOLDER_DEPTH]) for path in made.files)
    lines = [
        title,
        "",
        f"Why: `demandops upgrade` renders all {why}"
        + (f", and from {_NAMES[old.gitops]} to {_NAMES[new.gitops]}." if moved else "."),
        "",
        "Files written or removed:",
        *(f"  {count} in {folder}" for folder, count in sorted(counts.items())),
        "",
        "Operation: upgrade",
        f"From-Render-Version: {old.render_version}",
        *([f"From-Gitops: {old.gitops}"] if moved else []),
        f"Gitops: {new.gitops}",
        *(
            f"{key}: {path}"
            for key, path in commit_message.of_overrides(commit_message.keeping(taken.keys))
        ),
        f"Render-Version: {new.render_version}",
    ]
    return "\n".join(lines) + "\n"


_NAMES = {"flux": "Flux", "argocd": "Argo CD"}
