"""What is in effect at a commit: its ledger, and the configuration of one commit.

If the configuration of a commit is valid, with its ledger, it is in effect. If not, that of the
newest commit found valid stays in effect, as a whole, until a commit is valid. Commits of a
generator say so in the trailer ``Configuration``; without it, their own configuration is in effect.
So a start, every reader and `demandops verify` find the same, by the history alone.

The ledger is always that of the commit. A claim in it that is not valid, or that no demand could
have booked, is put back by the generator, like a generated file that a person has edited, or what a
cluster says of its nodes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from typing import NamedTuple

from pygit2 import Commit, Oid, Repository, Tree

from demandops.base import strict_yaml
from demandops.base.errors import Fault, InvalidInput, OverLimit, StateRepoError, fault
from demandops.base.quoting import one_line
from demandops.base.settings import GENERATED_ROOTS, RENDER_VERSION
from demandops.base.strict_yaml import with_lines
from demandops.decide import edits
from demandops.decide.state import (
    Change,
    Changeset,
    FileReader,
    ReleaseChange,
    State,
    rendered_files,
    try_configuration,
)
from demandops.model.config.config import CONFIG_ROOTS, Config
from demandops.model.config.discovered import DISCOVERED_ROOT, is_discovered
from demandops.model.config.load import load as load_config
from demandops.model.config.repo_settings import ROOT_FILE
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger import records
from demandops.model.ledger.claim import Claim, ClaimKey
from demandops.model.ledger.ledger import ClaimChange, Ledger, claim_changes
from demandops.repo.git import tree as trees
from demandops.repo.history import commit_log
from demandops.repo.history.commit_log import LogEntry
from demandops.repo.load import ledger_files
from demandops.repo.load.ledger_files import valid_claim_at
from demandops.templating.evaluator import DEMAND_S, EVALUATE, processor_time

Progress = Callable[[int, int], None]
Files = Mapping[str, str | None]  # path → the new text; None removes the file
# The ids of the files and folders of a configuration: equal ids, equal content.
ConfigIds = tuple[Oid | None, ...]

NO_STATE_REPO = (
    "this is not a state repo, because it has no demandops.yaml; if the file was deleted, restore "
    "it; `demandops init DIR` makes a new state repo"
)
# The trailer that names the commit whose configuration is in effect instead of the commit's own.
CONFIGURATION = "Configuration"


@dataclass(frozen=True, slots=True)
class Snapshot:
    commit: Oid
    state: State
    # the commit whose configuration is in effect; ``commit`` itself unless its own is not valid
    configuration: Oid
    # the newest commit of a generator: what clusters say of their nodes is as it is there
    written: Oid
    # why the configuration of ``commit`` is not in effect, and its ids, which are not judged again
    faults: tuple[Fault, ...] = ()
    refused: ConfigIds | None = None
    # the configuration that the newest commit of a generator says is not in effect
    told: ConfigIds | None = None
    # files of claims that are not valid at ``commit`` → the claims in effect instead; and why these
    # and other files are put back
    put_back: Mapping[str, Claim | None] = field(default_factory=dict)
    claim_faults: tuple[Fault, ...] = ()
    # whether a generator has written the files of this state; if not, all must be rendered
    is_rendered: bool = True

    @property
    def is_settled(self) -> bool:
        """Whether nothing is left to judge, to render, to put back or to tell."""
        return self.is_rendered and not self.claim_faults and self.is_told

    @property
    def is_told(self) -> bool:
        return self.told == (self.refused if self.faults else None)

    @property
    def problems(self) -> tuple[Fault, ...]:
        return (*self.faults, *self.claim_faults)

    @property
    def trailers(self) -> list[tuple[str, str]]:
        return [(CONFIGURATION, str(self.configuration))] if self.faults else []


# ---- the files of one commit ----


def config_ids(tree: Tree) -> ConfigIds:
    return tuple(trees.entry_id(tree, root) for root in CONFIG_ROOTS)


def config_at(tree: Tree) -> Config:
    files = trees.texts(tree, CONFIG_ROOTS)
    if ROOT_FILE not in files:
        raise StateRepoError(NO_STATE_REPO)
    return load_config(files)


def end_markers_at(tree: Tree) -> dict[str, str]:
    return trees.texts(tree, (records.MARKERS_ROOT,))


def load(
    repo: Repository,
    revision: str | Oid,
    progress: Progress = lambda done, total: None,
    entry: LogEntry | None = None,
    before: Snapshot | None = None,
) -> Snapshot:
    """Read a commit's ledger, and with ``entry`` the configuration that the commit names.

    After a known commit ``before``, only what differs is read. InvalidInput is raised if that
    configuration is not valid.
    """
    commit = trees.commit_of(repo, revision)
    configuration = configuration_of(repo, commit, entry)
    source, config = trees.commit_of(repo, configuration).tree, None
    if before:
        known = trees.commit_of(repo, before.configuration).tree
        config = None if trees.differ(known, source, CONFIG_ROOTS) else before.state.config
    config = config or config_at(source)
    read = _read_ledger(repo, before, commit, progress, entry)
    is_own = configuration == commit.id
    return Snapshot(
        commit.id,
        read.state_with(before.state if before else None, config),
        configuration,
        commit.id,
        faults=before.faults if before and not is_own else (),
        refused=before.refused if before and not is_own else None,
        told=None if is_own else config_ids(commit.tree),
        put_back=read.put_back,
        claim_faults=tuple(read.faults),
    )


class _LedgerRead(NamedTuple):
    ledger: Ledger
    changes: list[ClaimChange]
    # files of claims that are not valid → the claims in effect instead
    put_back: dict[str, Claim | None]
    faults: list[Fault]
    # files of waiting demands that are not valid → their texts from before
    waiting: dict[str, str]

    def state_with(self, before: State | None, config: Config) -> State:
        if before and config == before.config and self.ledger.ended == before.ledger.ended:
            return before.with_ledger(self.ledger, self.changes)
        return State(config, self.ledger, EVALUATE)


def _read_ledger(
    repo: Repository,
    before: Snapshot | None,
    commit: Commit,
    progress: Progress = lambda done, total: None,
    entry: LogEntry | None = None,
) -> _LedgerRead:
    """Read the ledger of a commit; of what is as at ``before``, the content is known."""
    old, new = trees.commit_of(repo, before.commit).tree if before else None, commit.tree
    ledger = before.state.ledger if before else Ledger()
    ledger = replace(ledger, ended=records.read_ended_override(end_markers_at(new)))
    changes, waiting = list[ClaimChange](), dict[str, str]()
    put_back = dict(before.put_back) if before else {}
    paths = [*ledger_files.changed_files(old, new)]
    stays = put_back.keys() - {*paths}
    faults = [each for each in (before.claim_faults if before else ()) if each.file in stays]
    if trees.differ(old, new, (records.WAITING_ROOT,)):
        texts = trees.texts(new, (records.WAITING_ROOT,))
        ledger = replace(ledger, waiting=records.read_all_waiting(texts))
    for path, blob in trees.differences(old, new, (records.WAITING_ROOT,)):
        text = trees.read_text(old, path) or ""
        waits = records.read_waiting(text, path)
        # who deletes the file withdraws the demand
        if blob is not None and waits and waits.demand not in ledger.waiting:
            waiting[path] = text
            ledger = replace(ledger, waiting=ledger.waiting.insert(waits.demand, waits))
            faults.append(fault("", "is not a valid waiting demand").within(path))
    # the second version put no claim back, and named those that were not in effect
    held_back = entry.trailers.get("Held-Back", ()) if entry else ()
    for done, path in enumerate(paths):
        if done % 200 == 0:
            progress(done, len(paths))
        was = put_back.pop(path) if path in put_back else valid_claim_at(old, path)
        try:
            claim = ledger_files.claim_at(new, path)
            conflict = list(ledger_files.owner_faults(claim, was, path))
            if path in held_back:
                conflict = [fault("", "no demand could have booked this").within(path)]
            if conflict:
                raise InvalidInput(conflict)
        except InvalidInput as error:
            faults += error.faults
            claim = was
            if before is None:
                claim = ledger_files.as_last_written(repo, commit.id, path)
            elif was and ledger_files.was_deleted(repo, path, before.commit, commit.id):
                claim = None
            put_back[path] = claim
        if claim != was and (key := (claim or was)) is not None:
            changes.append(ClaimChange(was, claim))
            ledger = ledger.replace(key.key, claim)
    progress(len(paths), len(paths))
    return _LedgerRead(ledger, changes, put_back, faults, waiting)


def configuration_of(repo: Repository, commit: Commit, entry: LogEntry | None) -> Oid:
    # in the second version, ``In-Force`` named the newest commit where all files were valid
    named = (entry.first("In-Force") or entry.first(CONFIGURATION)) if entry else ""
    if not named:
        return commit.id
    found = trees.commit_of(repo, named).id
    if not _was_main(repo, commit.id, found):
        raise StateRepoError(
            f"commit {commit.id} names {named} as its configuration, which is no commit before it; "
            "set the branch back to the commit before it"
        )
    return found


# By the commit of a configuration, the newest generator's commit that is known to follow it.
_followed_by: dict[Oid, Oid] = {}


def _was_main(repo: Repository, to: Oid, configuration: Oid) -> bool:
    """Return whether a commit was main before ``to``, because people merge what they looked at.

    It is along the first parents of ``to`` or of a generator's commit, or is a generator's.
    """
    if _follows(repo, to, _followed_by.get(configuration)):
        return True
    if not _follows(repo, to, configuration):
        return False
    main = {to}
    for commit, _ in commit_log.commits(repo, to, configuration):
        if commit.id in main or commit_log.is_by_generator(repo, commit):
            main.update(commit.parent_ids[:1])
    found = trees.commit_of(repo, configuration)
    if configuration not in main and not commit_log.is_by_generator(repo, found):
        return False
    if commit_log.is_by_generator(repo, trees.commit_of(repo, to)):
        _followed_by[configuration] = to
    return True


def _follows(repo: Repository, to: Oid, commit: Oid | None) -> bool:
    # a commit of another repository may be asked for, or one that is gone
    return to == commit or (
        commit is not None and commit in repo and repo.descendant_of(to, commit)
    )


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
    # A version that no program ever wrote here is a person's mistake, and not in effect like any
    # other. Else one merge would stop all demands.
    if not commit_log.was_rendered_with(repo, commit, version):
        return
    remedy = "update the generator"
    if version < RENDER_VERSION:
        remedy = "stop older generators, then run `demandops upgrade` to render everything again"
    raise StateRepoError(
        f"{ROOT_FILE}: renderVersion: is {version}, but this generator renders version "
        f"{RENDER_VERSION}; {remedy}"
    )


# ---- from a generator's newest commit to people's commits after it ----


@dataclass(frozen=True, slots=True)
class Followed:
    """What is in effect after people's commits, and what carries them out."""

    snapshot: Snapshot
    # at the newest commit of a generator, from which people's commits were read
    before: Snapshot
    change: Changeset = field(default_factory=lambda: Changeset({}, ()))
    # the claims that overrides changed, or that were put back
    keys: tuple[ClaimKey, ...] = ()


def newest_of_generator(repo: Repository, tip: Oid) -> LogEntry | None:
    line = commit_log.first_parents(repo, tip)
    first = next((commit for commit in line if commit_log.is_by_generator(repo, commit)), None)
    if first is None:
        return None
    # there is a later one if main was pulled into a branch
    later = next((commit for commit, _ in _by_generator(repo, tip, first.id)), first)
    return commit_log.entry_of(later)


def start_at(repo: Repository, tip: Oid, progress: Progress = lambda done, total: None) -> Snapshot:
    """Return what the newest commit of a generator has in effect, else the tip if it is valid."""
    told: InvalidInput | StateRepoError | None = None
    if (entry := newest_of_generator(repo, tip)) is not None:
        try:  # it may be forged, or of a newer program
            return load(repo, entry.commit, progress, entry)
        except (InvalidInput, StateRepoError) as error:
            told = error
    try:
        return replace(load(repo, tip, progress), is_rendered=False)
    except (InvalidInput, StateRepoError) as error:
        raise told or error from None


def _by_generator(repo: Repository, to: Oid, after: Oid) -> Iterator[tuple[Commit, LogEntry]]:
    # newest first; without those of a fork, which a person has merged
    for commit, entry in commit_log.commits(repo, to, after):
        if commit_log.is_by_generator(repo, commit) and _follows(repo, commit.id, after):
            yield commit, entry


def state_at(
    repo: Repository, revision: str | Oid, progress: Progress = lambda done, total: None
) -> Snapshot:
    """Return what is in effect at a commit, as soon as a generator has followed it."""
    commit = trees.commit_of(repo, revision)
    start = start_at(repo, commit.id, progress)
    # the overrides that have ended are those that had ended at the time of the commit
    return follow(repo, start, commit.id, commit_log.time_of(commit)).snapshot


def follow(
    repo: Repository, before: Snapshot, to: Oid, now: datetime, *, again: bool = False
) -> Followed:
    """Return what is in effect at the commit ``to``, and the files that a generator must write.

    Only files that differ are read, unless people have set main back. A configuration that was not
    valid is judged ``again`` if asked, or if people edit claims: it may be valid without a claim.
    """
    is_later = _follows(repo, to, before.commit)
    if not (is_later and _was_main(repo, to, before.configuration)):
        try:
            before = start_at(repo, to)
        except InvalidInput as error:
            raise StateRepoError(
                f"main was rewritten, its configuration is not valid ({error.faults[0]}), and it "
                "has no commit of a generator; correct the file, or set main back"
            ) from None
    for commit, entry in _by_generator(repo, to, before.commit):
        try:
            # what another generator has published is right, so it is not judged or rendered again
            before = load(repo, commit.id, entry=entry, before=before)
        except (InvalidInput, StateRepoError) as refused:
            try:  # people may have put this right since
                before = replace(load(repo, to), is_rendered=False)
            except (InvalidInput, StateRepoError):
                if isinstance(refused, StateRepoError):
                    raise refused from None
                raise StateRepoError(
                    f"another generator's commit {commit.id} has a configuration in effect which "
                    f"is not valid for this program ({refused.faults[0]}); update this generator"
                ) from None
        break
    if before.commit == to and before.is_settled and not again:
        return Followed(before, before)
    tree = trees.commit_of(repo, to).tree
    ids = config_ids(tree)
    if ids == config_ids(trees.commit_of(repo, before.configuration).tree):
        return _carried_out(
            repo, before, replace(before, commit=to, configuration=to, faults=(), refused=None), now
        )
    faults = before.faults
    claims = trees.commit_of(repo, before.commit).tree, tree, (claim_files.LEDGER_ROOT,)
    if ids != before.refused or again or trees.differ(*claims):
        try:
            config = _judged(tree, trees.commit_of(repo, before.written).tree, before.state)
            state = replace(before.state, config=config)
            wanted = Snapshot(to, state, to, before.written, told=before.told)
            return _carried_out(repo, before, wanted, now)
        except InvalidInput as error:
            faults = error.faults
    held = replace(before, commit=to, faults=faults, refused=ids)
    return _carried_out(repo, before, held, now)


def with_started_leases(repo: Repository, followed: Followed, now: datetime) -> Followed:
    # an approved claim's lease starts only now, because else it could end before the approval
    snapshot, files = followed.snapshot, dict(followed.change.files)
    ledger = snapshot.state.ledger
    for claim in ledger.unstarted_claims():
        assert claim.lease is not None  # noqa: S101 - unstarted claims have a lease
        path = claim_files.path_of(claim.key)
        line = commit_log.first_parents(repo, snapshot.commit)
        claims = (valid_claim_at(commit.tree, path) for commit in line)
        leases = (was.lease if was else None for was in claims)
        # a merged proposal's lease has not started; the one before it has
        earlier = next((lease for lease in leases if lease is None or lease.has_started), None)
        started = replace(claim, lease=claim.lease.started(now, earlier))
        ledger = ledger.replace(claim.key, started)
        files[path] = claim_files.text_of(started)
    # a lease does not affect a release, so the usage of nodes need not be counted again
    snapshot = replace(snapshot, state=snapshot.state.with_ledger(ledger, ()))
    return replace(followed, snapshot=snapshot, change=replace(followed.change, files=files))


# By the ids of their files, the newest configurations that were judged.
_judgements: dict[object, Config | InvalidInput] = {}
_MOST_JUDGED = 8


def _judged(tree: Tree, written: Tree, before: State) -> Config:
    """Return the configuration of people's commit if it can be used, whatever is demanded.

    What clusters say of their nodes is that of the tree ``written``; people's edits are put back.
    """
    in_effect = before.config.repo_settings.render_version
    of_clusters = trees.entry_id(written, DISCOVERED_ROOT)
    key = (config_ids(tree), of_clusters, in_effect, frozenset(before.ledger.ended.items()))
    judgement = _judgements.get(key)
    if judgement is None:
        try:
            files = trees.texts(tree, CONFIG_ROOTS)
            files = {path: text for path, text in files.items() if not is_discovered(path)}
            files |= trees.texts(written, (DISCOVERED_ROOT,))
            if ROOT_FILE not in files:
                raise InvalidInput.at("", NO_STATE_REPO, file=ROOT_FILE)
            config = load_config(files)
            if config.repo_settings.render_version < in_effect:
                message = (
                    f"is lower than {in_effect}, which `demandops upgrade` wrote; write {in_effect}"
                )
                raise InvalidInput.at("renderVersion", message, file=ROOT_FILE)
            if config != before.config:  # a new one must render samples
                # what takes too long is a fault for `check`, and of each demand that needs it;
                # whether a configuration is valid must not depend on the machine
                with suppress(OverLimit), processor_time(each=DEMAND_S, together=4 * DEMAND_S):
                    try_configuration(State(config, Ledger(ended=before.ledger.ended), EVALUATE))
            judgement = config
        except InvalidInput as error:
            judgement = error
        if len(_judgements) >= _MOST_JUDGED:
            _judgements.clear()
        _judgements[key] = judgement
    if isinstance(judgement, InvalidInput):
        raise InvalidInput(judgement.faults)
    return judgement


def _carried_out(repo: Repository, before: Snapshot, wanted: Snapshot, now: datetime) -> Followed:
    """Return the effect of people's commits with the configuration of ``wanted``.

    InvalidInput is raised if a release cannot be planned or rendered with it.
    """
    commit, old = trees.commit_of(repo, wanted.commit), before.state
    tree, earlier = commit.tree, trees.commit_of(repo, before.commit).tree
    read, read_text = _read_ledger(repo, before, commit), partial(trees.read_text, tree)
    state = read.state_with(old, wanted.state.config)
    renders_all = (
        state.config != old.config
        or state.ledger.ended != old.ledger.ended
        or not before.is_rendered
        or trees.differ(earlier, tree, GENERATED_ROOTS)
    )

    def carry_out(
        state: State, changes: Iterable[ClaimChange]
    ) -> tuple[State, Changeset, tuple[ClaimKey, ...]]:
        subjects = tuple(dict.fromkeys(change.key.subject for change in changes))
        if renders_all:
            markers = end_markers_at(tree)
            applied = edits.update_ledger(old, state, subjects, markers, now)
            state = replace(state, ledger=applied.ledger)
            return state, render_all(tree, state, applied.files), tuple(applied.keys)
        applied = edits.update_claims(old.ledger, state, subjects, now)
        touched = claim_changes(state.ledger, applied.ledger, applied.keys)
        state = state.with_ledger(applied.ledger, touched)
        subjects = tuple(dict.fromkeys((*subjects, *(edit.key.subject for edit in touched))))
        change = edits.changeset_of_edit(state, old.ledger, subjects, read_text)
        return state, replace(change, files={**applied.files, **change.files}), tuple(applied.keys)

    # claims that no demand could have booked, or that cannot be planned, are put back
    kept, refused, faults = list[ClaimChange](), list[ClaimChange](), list(read.faults)
    for change in read.changes:
        found = _faults_of(change, old, state, read_text)
        faults += found
        (refused if found else kept).append(change)
    state = _without(state, refused)
    try:
        state, carried, keys = carry_out(state, kept)
    except InvalidInput as error:
        # with the configuration that was in effect, only what people did to the ledger can fail
        if state.config != old.config or not kept:
            raise
        faults += error.faults
        state, refused = _without(state, kept), [*refused, *kept]
        state, carried, keys = carry_out(state, ())
    put_back = read.put_back | {
        claim_files.path_of(change.key): change.before for change in refused
    }
    written = trees.commit_of(repo, before.written).tree
    of_clusters = {
        path: trees.read_text(written, path)
        for path, _ in trees.differences(written, tree, (DISCOVERED_ROOT,))
        if not trees.is_readme(path)
    }
    edited = "is written only by the generator, as the cluster has its nodes"
    faults += [fault("", edited).within(path) for path in of_clusters]
    files: dict[str, str | None] = {
        **of_clusters,
        **{path: claim_files.text_of(claim) if claim else None for path, claim in put_back.items()},
        **read.waiting,
        **carried.files,
    }
    snapshot = replace(
        wanted, state=state, put_back=put_back, claim_faults=tuple(faults), is_rendered=True
    )
    named = (*keys, *(claim.key for claim in put_back.values() if claim))
    return Followed(snapshot, before, replace(carried, files=files), named)


def _faults_of(change: ClaimChange, old: State, state: State, read: FileReader) -> list[Fault]:
    if found := list(edits.faults_of_edit(old, state, [change])):
        return found
    try:
        edits.changeset_of_edit(state, old.ledger, [change.key.subject], read)
    except InvalidInput as error:
        path = claim_files.path_of(change.key)
        return [
            each.within(path) if claim_files.kind_of(each.file) is None else each
            for each in error.faults
        ]
    return []


def _without(state: State, changes: Iterable[ClaimChange]) -> State:
    ledger, undone = state.ledger, list[ClaimChange]()
    for change in changes:
        ledger = ledger.replace(change.key, change.before)
        undone.append(ClaimChange(change.after, change.before))
    return state.with_ledger(ledger, undone) if undone else state


def render_all(tree: Tree, state: State, more: Files) -> Changeset:
    """Return the generated files that differ from those of ``tree``, and the files ``more``."""
    generated = trees.texts(tree, GENERATED_ROOTS)
    files: dict[str, str | None] = dict(rendered_files(state, generated, keeps_late=True))
    changes = []
    are_files = {path: trees.is_file(child) for path, child in trees.entries(tree, GENERATED_ROOTS)}
    for path, is_file in are_files.items():
        if path not in files and not (is_file and trees.is_readme(path)):
            files[path] = None
    for path in sorted(files):
        old = generated.get(path)
        # a link is replaced by a file, even if its text is the right one
        if old == files[path] and are_files.get(path, True):
            del files[path]
            continue
        kind: Change = "stop" if files[path] is None else "start" if old is None else "change"
        name = path.rsplit("/", 1)[-1].removesuffix(".yaml")
        changes.append(ReleaseChange(name, path, path, kind))
    return Changeset({**more, **files}, tuple(changes))


# ---- what people are told of a configuration that is not in effect ----

# How many faults get the commit that caused them, and how many commits are named to be reverted.
_MOST_ORIGINS, _MOST_REVERTED = 100, 50


class Problem(NamedTuple):
    """A fault, with the id and the author of the commit that caused it, or empty texts."""

    file: str
    field: str
    message: str
    since: str
    author: str
    line: int | None

    def __str__(self) -> str:
        text = str(Fault("invalid", self.field, self.message, self.file, self.line))
        return f"{text} (since {self.since[:10]} by {self.author})" if self.since else text


def problems_of(repo: Repository, snapshot: Snapshot) -> tuple[Problem, ...]:
    if not snapshot.problems:
        return ()
    tree = trees.commit_of(repo, snapshot.commit).tree
    origin = commit_log.fault_origin(repo, snapshot.configuration, snapshot.commit)
    problems = []
    faults = dict.fromkeys(with_lines(snapshot.problems, partial(trees.read_text, tree)))
    for number, each in enumerate(faults):
        since, author = origin(each.file) if number < _MOST_ORIGINS else ("", "")
        problems.append(
            Problem(each.file, each.field, each.message, since, one_line(author), each.line)
        )
    return tuple(problems)


def commits_to_revert(repo: Repository, snapshot: Snapshot) -> list[str]:
    """Return the commits of main, newest first, that changed the files at fault since then.

    Also the later ones that changed the same files as these, as a revert would else conflict.
    """
    in_effect = trees.commit_of(repo, snapshot.configuration).tree
    tip = trees.commit_of(repo, snapshot.commit).tree
    changed = {path for path, _ in trees.differences(in_effect, tip, CONFIG_ROOTS)}
    files, found = {each.file for each in snapshot.faults}, list[str]()
    # a file may be at fault because of another one
    files = files if files <= changed else changed
    people = commit_log.first_parents(repo, snapshot.commit, snapshot.configuration)
    for commit in reversed([*people]):
        # a merge into a branch also brought what is in effect
        is_pull = len(commit.parents) > 1 and not _follows(
            repo, commit.parent_ids[0], snapshot.configuration
        )
        if is_pull or commit_log.is_by_generator(repo, commit):
            continue
        before = trees.parent_tree(commit)
        touched = {path for path, _ in trees.differences(before, commit.tree, CONFIG_ROOTS)}
        if touched & files:
            files = files | touched
            found.append(str(commit.id))
    return found[::-1]


def how_to_mend(repo: Repository, snapshot: Snapshot) -> str:
    if not snapshot.faults:
        return ""
    commits = commits_to_revert(repo, snapshot)
    if not 0 < len(commits) <= _MOST_REVERTED:
        return "correct the files"
    named = " ".join(commit[:10] for commit in commits)
    return f"correct the files, or undo the commits: git revert --no-edit -m 1 {named}"
