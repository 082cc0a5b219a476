"""``demandops upgrade``: one commit in which this program renders everything again.

The state repo changes to another render version or GitOps controller in this one commit, so two
versions never undo each other's files. If the tip moves meanwhile, the commit is made again on the
new tip. The commit is never pushed by force.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime

from demandops.base import strict_yaml
from demandops.base.errors import InvalidInput, StateRepoError, fault
from demandops.base.runtime import REAL
from demandops.base.settings import LEDGER_API_VERSION, RENDER_VERSION, REPORTS_ROOT
from demandops.decide.carriers import with_one_carrier
from demandops.decide.edits import changed_claim_files, faults_of_edit, update_ledger
from demandops.decide.planning.flows import with_booked_topics_marked
from demandops.decide.state import State, planned_releases
from demandops.model.config.appdef import without_ignored_fields
from demandops.model.config.config import CONFIG_ROOTS, Config
from demandops.model.config.load import load
from demandops.model.config.repo_settings import ROOT_FILE
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger import records
from demandops.model.ledger.claim import LEDGER_ROOT, ClaimKey
from demandops.model.ledger.ledger import Ledger, changes_on
from demandops.model.release import ServiceRelease
from demandops.repo import reader
from demandops.repo.git import tree as trees
from demandops.repo.git.repository import StateRepository
from demandops.repo.git.signing import Signer
from demandops.repo.history import commit_log, commit_message
from demandops.repo.load import ledger_files
from demandops.repo.load import snapshot as snapshots
from demandops.repo.load.snapshot import Progress
from demandops.repo.write.commit_batch import CommitBatch
from demandops.templating.evaluator import EVALUATE

_ATTEMPTS = 10
_PAUSE_S = 0.1
# Before this render version, claims did not mark a source's further topics, so the marks are added.
_FIRST_WITH_MARKS = 2
_NAMES = {"flux": "Flux", "argocd": "Argo CD"}


@dataclass(frozen=True, slots=True)
class Upgrade:
    commit: str  # of the upgrade, or the tip if no commit was made
    old: Config
    new: Config
    files: Mapping[str, str | None]

    @property
    def switches(self) -> bool:
        return self.old.repo_settings.gitops != self.new.repo_settings.gitops


def plan(
    address: str, gitops: str | None, url: str | None, now: datetime, progress: Progress
) -> Upgrade:
    # ``gitops`` is the new GitOps controller; None keeps the current one. ``url`` is what a new one
    # fetches if demandops.yaml has no section for it; None: the current URL
    with reader.opened(address) as repo:
        return _plan(repo.repository, gitops, url, now, progress)[0]


def upgrade(
    address: str,
    gitops: str | None,
    url: str | None,
    now: datetime,
    progress: Progress,
    signer: Signer | None,
) -> Upgrade:
    # InvalidInput is raised if the state repo is not valid, or the request cannot be fulfilled
    with reader.opened(address, only_read=False) as repo:
        repository = repo.repository
        repository.signer = signer
        for attempt in range(1, _ATTEMPTS + 1):
            planned, batch, state, keys = _plan(repository, gitops, url, now, progress)
            if not planned.files:
                return planned
            who = commit_log.operator(repository.objects.path)
            author = commit_message.signature(who.name, who.email, now)
            text = _message(planned, keys)
            commit = batch.commit_files(planned.files, state, text, now, author)
            if batch.publish():
                return replace(planned, commit=commit)
            REAL.sleep(_PAUSE_S * attempt * REAL.uniform(0.5, 1.0))
            repository.refresh()
    raise StateRepoError(
        f"{repository.address} got new commits, or another process locked it, during each of "
        f"{_ATTEMPTS} attempts to render it; stop its generators and try again"
    )


def _plan(
    repository: StateRepository,
    gitops: str | None,
    url: str | None,
    now: datetime,
    progress: Progress,
) -> tuple[Upgrade, CommitBatch, State, tuple[ClaimKey, ...]]:
    # the upgrade, the batch and the state to commit, and the claims that may change
    objects, tip = repository.objects, repository.tip()
    snapshot = snapshots.load(objects, tip, progress)
    if snapshot.claim_faults:
        raise InvalidInput(snapshot.claim_faults)
    batch, old = CommitBatch(repository, snapshot), snapshot.state.config
    tree = trees.commit_of(objects, tip).tree
    files = trees.texts(tree, CONFIG_ROOTS)
    by_people = {path: without_ignored_fields(path, text) for path, text in files.items()}
    by_people[ROOT_FILE] = _root(files[ROOT_FILE], old, gitops or old.repo_settings.gitops, url)
    config = load(by_people)
    state = State(config, snapshot.state.ledger, EVALUATE)
    # people may have edited since the state in effect; their edits are checked and applied too
    start = snapshots.start_at(objects, tip)
    subjects = ledger_files.changed_subjects(start.state.ledger, state.ledger)
    edits = changes_on(start.state.ledger, state.ledger, subjects)
    refused = list(faults_of_edit(start.state, state, edits))
    if refused:
        raise InvalidInput(refused)
    markers = snapshots.end_markers_at(tree)
    applied = update_ledger(start.state, state, subjects, markers, now)
    state = replace(state, ledger=applied.ledger)
    if old.repo_settings.render_version < _FIRST_WITH_MARKS:
        state = replace(state, ledger=with_booked_topics_marked(state.ledger, config))
    ledger, keys = with_one_carrier(state.ledger)
    state = replace(state, ledger=ledger)
    changed_claims = changed_claim_files(applied.ledger, ledger, keys)
    if old.repo_settings.gitops != config.repo_settings.gitops:
        # a held file would stay rendered for the old controller
        held = [
            fault(
                "hold",
                f"keeps the file of {release.name} as rendered for the old controller; remove the "
                "hold, and add it again after the upgrade",
            ).within(override.path)
            for release in planned_releases(state).values()
            if isinstance(release, ServiceRelease) and release.shaping.held
            for override, effects in release.shaping.by
            if "hold" in effects
        ]
        if held:
            raise InvalidInput(held)
    files_of_ledger = _in_this_schema(trees.texts(tree, (LEDGER_ROOT,)), state.ledger)
    written = {**files_of_ledger, **applied.files, **changed_claims}
    changed = dict(snapshots.render_all(tree, state, written).files)
    # the second version listed there what was not valid
    changed |= dict.fromkeys(trees.texts(tree, (REPORTS_ROOT,)))
    changed |= {path: text for path, text in by_people.items() if text != files[path]}
    upgrade = Upgrade(str(tip), old, state.config, dict(sorted(changed.items())))
    return upgrade, batch, state, (*applied.keys, *keys)


def _in_this_schema(files: Mapping[str, str], ledger: Ledger) -> dict[str, str | None]:
    written = dict[str, str | None]()
    for path, text in files.items():
        new: str | None = text
        if path.startswith(records.GONE_ROOTS):
            new = None
        elif claim_files.kind_of(path) is not None:
            claim = ledger.get(claim_files.read(text, path).key)
            new = claim_files.text_of(claim) if claim else text
        elif waiting := records.read_waiting(text, path):
            new = records.waiting_text(waiting)
        elif records.read_ended_override({path: text}):
            new = strict_yaml.set_key(text, "apiVersion", LEDGER_API_VERSION)
        if new != text:
            written[path] = new
    return written


def _root(text: str, config: Config, gitops: str, url: str | None) -> str:
    repository = config.repo_settings
    try:
        if repository.render_version != RENDER_VERSION:
            text = strict_yaml.set_key(text, "renderVersion", RENDER_VERSION)
        if repository.gitops != gitops:
            text = strict_yaml.set_key(text, "gitops", gitops)
        section = getattr(repository, gitops)
        if section is None:
            # both controllers fetch the same repo, so the URL of the configured controller fits
            current = getattr(repository, repository.gitops)
            text = strict_yaml.set_key(text, gitops, {"url": url or current.url})
        elif url not in (None, section.url):
            what = f"is set to {section.url} already; change" if section.url else "is missing; add"
            message = f"{what} it in this file, or leave out --url"
            raise InvalidInput.at(f"{gitops}.url", message)
    except InvalidInput as error:
        raise InvalidInput(strict_yaml.faults_in(error, ROOT_FILE)) from None
    return text


def _message(upgrade: Upgrade, keys: tuple[ClaimKey, ...]) -> str:
    old, new = upgrade.old.repo_settings, upgrade.new.repo_settings
    title = "Render everything again"
    if upgrade.switches:
        title += f", for {_NAMES[new.gitops]}"
    why = f"with render version {new.render_version}"
    if old.render_version != new.render_version:
        why += f" instead of {old.render_version}"
    if upgrade.switches:
        why += f", for {_NAMES[new.gitops]} instead of {_NAMES[old.gitops]}"
    # by the folder ``clusters/<cluster>/<access domain>``
    counts = Counter("/".join(path.split("/")[:3]) for path in upgrade.files)
    trailers = [
        ("Operation", "upgrade"),
        ("From-Render-Version", str(old.render_version)),
        ("From-Gitops", old.gitops if upgrade.switches else ""),
        ("Gitops", new.gitops),
        *commit_message.override_trailers((), keys),
        *commit_message.demand_trailers(keys),
    ]
    files = [f"  {count} in {folder}" for folder, count in sorted(counts.items())]
    paragraphs = [
        [title],
        [f"Why: `demandops upgrade` renders everything {why}."],
        ["Files written or removed:", *files],
    ]
    return commit_message.of_generator(paragraphs, trailers)
