"""A commit's configuration and ledger, and the state in effect if some files are not valid.

:func:`load` reads all files, :func:`advance` only those that changed. If a file is not valid, its
last valid version stays in effect and the file is reported.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain, takewhile
from urllib.parse import quote, unquote

from pygit2 import Blob, GitError, Oid, Repository, Tree

from demandops.base.errors import Fault, InvalidInput, OverLimit, StateRepoError, fault
from demandops.base.naming import Subject
from demandops.base.settings import GENERATED_ROOTS
from demandops.decide.edits import changeset_of_edit, faults_of_edit
from demandops.decide.state import State, rendered_files, try_configuration
from demandops.model.config.config import CONFIG_ROOTS, Config
from demandops.model.config.load import load as load_config
from demandops.model.config.repo_settings import ROOT_FILE
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger import records
from demandops.model.ledger.claim import Claim
from demandops.model.ledger.ledger import ClaimChange, Ledger
from demandops.repo.git import tree as trees
from demandops.repo.git.repository import StateRepository
from demandops.repo.history import commit_log
from demandops.repo.history.commit_log import LogEntry
from demandops.repo.load import last_valid_config, ledger_files
from demandops.repo.load.last_valid_config import ConfigSource, LastValidConfig
from demandops.templating.evaluator import DEMAND_S, EVALUATE, processor_time

Progress = Callable[[int, int], None]

# The folders and files that a snapshot is read from.
ROOTS = (*CONFIG_ROOTS, claim_files.LEDGER_ROOT)


@dataclass(frozen=True, slots=True)
class Snapshot:
    commit: Oid
    state: State
    last_valid_commit: Oid  # the newest commit without problems
    # the faults of invalid files, whose last valid versions are in effect
    problems: tuple[Fault, ...] = ()
    # ledger files whose content at this commit is not in effect
    quarantined_files: tuple[str, ...] = ()
    # the source of the configuration in effect; None means this commit
    other_config_source: ConfigSource | None = None
    # whether a generator has written the files of this state; if not, all must be rendered
    is_rendered: bool = True

    @property
    def config_source(self) -> ConfigSource:
        return self.other_config_source or ConfigSource(self.commit)


@dataclass(frozen=True, slots=True)
class Advance:
    snapshot: Snapshot
    subjects: tuple[Subject, ...]  # those whose claims changed
    # all releases must be rendered again, usually because the configuration changed
    config_changed: bool


def load(
    repo: Repository, revision: str | Oid, progress: Progress = lambda done, total: None
) -> Snapshot:
    # ``progress`` gets the numbers of read and of all claim files
    commit = trees.commit_of(repo, revision)
    config = last_valid_config.config_at(commit.tree)
    files = ledger_files.read_claims(_claim_texts(commit.tree, progress))
    if files.faults:
        raise InvalidInput(files.faults)
    ended = last_valid_config.ended_overrides_at(commit.tree)
    waits = records.read_all_waiting(trees.texts(commit.tree, (records.WAITING_ROOT,)))
    ledger = replace(files.ledger(), ended=ended, waiting=waits)
    return Snapshot(commit.id, State(config, ledger, EVALUATE), commit.id)


def _claim_texts(tree: Tree, progress: Progress) -> Iterator[tuple[str, str]]:
    blobs: list[tuple[str, Blob]] = [
        (path, blob)
        for path, blob in trees.blobs(tree, (claim_files.LEDGER_ROOT,))
        if claim_files.kind_of(path)
    ]
    for done, (path, blob) in enumerate(blobs):
        if done % 200 == 0:
            progress(done, len(blobs))
        yield path, trees.text_of(blob)
    progress(len(blobs), len(blobs))


def advance(
    repo: Repository, before: Snapshot, to: Oid, recorded: ConfigSource | None = None
) -> Advance:
    """Return the snapshot of the commit ``to``, and the changes since the snapshot ``before``.

    Only files that differ are read. ``recorded`` is the recorded source of the configuration in
    effect at ``to``; if its files are not valid, InvalidInput is raised.
    """
    old, new = trees.commit_of(repo, before.commit).tree, trees.commit_of(repo, to).tree
    state, in_effect = before.state, LastValidConfig(None, before.config_source, ())
    if recorded is not None:
        in_effect = LastValidConfig(load_config(recorded.texts(repo)), recorded, ())
    elif before.problems or trees.differ(old, new, CONFIG_ROOTS):
        in_effect = _last_valid_config(repo, before, to)
    config, ended = in_effect.config or state.config, last_valid_config.ended_overrides_at(new)
    world_changed = config != state.config or ended != state.ledger.ended
    config_changed = (
        world_changed or not before.is_rendered or _must_render_all(repo, before.commit, to)
    )
    waits = state.ledger.waiting
    if trees.differ(old, new, (records.WAITING_ROOT,)):
        waits = records.read_all_waiting(trees.texts(new, (records.WAITING_ROOT,)))
    ledger = replace(state.ledger, ended=ended, waiting=waits)
    state = State(config, ledger, EVALUATE) if in_effect.config else replace(state, ledger=ledger)
    problems, claims, invalid = list(in_effect.faults), dict[str, Claim | None](), list[str]()
    # a quarantined file is read again, because another change may have made it valid
    for path in sorted({*ledger_files.changed_files(old, new), *before.quarantined_files}):
        try:
            claims[path] = claim = ledger_files.claim_at(new, path)
            # the owner of a path is sought in the whole ledger, and only of a replaced file
            if trees.entry(old, path) and (
                faults := list(ledger_files.owner_faults(claim, path, state.ledger))
            ):
                raise InvalidInput(faults)
        except InvalidInput as error:
            problems += error.faults
            invalid.append(path)
    claims |= ledger_files.last_valid_claims(repo, before.last_valid_commit, to, invalid)
    ledger, changes = state.ledger, list[ClaimChange]()
    for path in sorted(claims):
        claim = claims[path]
        keyed = claim or ledger_files.valid_claim_at(old, path)
        key = keyed.key if keyed else ledger_files.key_of(path, ledger)
        if key is not None and ledger.get(key) != claim:
            changes.append(ClaimChange(ledger.get(key), claim))
            ledger = ledger.replace(key, claim)
    if world_changed:
        state = replace(state, ledger=ledger)
    else:
        state = before.state.with_ledger(ledger, changes)
    snapshot = Snapshot(
        to,
        state,
        before.last_valid_commit if problems else to,
        tuple(problems),
        tuple(invalid),
        in_effect.source if in_effect.faults or recorded else None,
    )
    subjects = dict.fromkeys(change.key.subject for change in changes)
    return Advance(snapshot, tuple(subjects), config_changed)


def _must_render_all(repo: Repository, before: Oid, to: Oid) -> bool:
    # people may have changed generated files since ``before``
    people = list(commit_log.person_commits(repo, to, before))
    # where a generator made the newest commit, the generated files match the ledger
    if not people or people[0].id != to:
        return False
    # a person's commit may undo what another generator has committed meanwhile
    is_alone = len(people) == sum(1 for _ in commit_log.commits(repo, to, before))
    roots = GENERATED_ROOTS if is_alone else (*GENERATED_ROOTS, *ROOTS)
    return any(
        trees.differ(commit.parents[0].tree, commit.tree, roots)
        for commit in people
        if commit.parents
    )


# By their arguments, the newest results of _last_valid_config: an invalid file is judged only once,
# and not again for each demand.
_judged: dict[object, LastValidConfig] = {}
_MOST_JUDGED = 8


def _last_valid_config(repo: Repository, before: Snapshot, to: Oid) -> LastValidConfig:
    key = (
        frozenset(before.config_source.files(repo).items()),
        frozenset(ConfigSource(to).files(repo).items()),
        before.last_valid_commit,
        frozenset(before.state.ledger.ended.items()),
    )
    result = _judged.get(key)
    if result is None:
        result = last_valid_config.load_last_valid_config(
            repo,
            before.config_source,
            before.last_valid_commit,
            to,
            lambda files: _load_and_rehearse(files, before.state),
        )
        if len(_judged) >= _MOST_JUDGED:
            _judged.clear()
        _judged[key] = result
    # a result may be of another commit with the same files
    if result.config is None:
        return replace(result, source=before.config_source)
    return replace(result, source=replace(result.source, commit=to))


def _load_and_rehearse(files: Mapping[str, str], state: State) -> Config:
    if ROOT_FILE not in files:
        raise InvalidInput([fault("", last_valid_config.NO_STATE_REPO).within(ROOT_FILE)])
    config, in_force = load_config(files), state.config.repo_settings.render_version
    if config.repo_settings.render_version < in_force:
        message = f"is lower than {in_force}, which `demandops upgrade` wrote; write {in_force}"
        raise InvalidInput([fault("renderVersion", message).within(ROOT_FILE)])
    if config != state.config:  # a new one must render samples
        # what takes too long is a fault for `check`, and of each demand that needs it; whether a
        # configuration is valid must not depend on the machine
        with suppress(OverLimit), processor_time(each=DEMAND_S, together=4 * DEMAND_S):
            try_configuration(State(config, Ledger(ended=state.ledger.ended), EVALUATE))
    return config


class ReadAhead:
    # Reading takes time. If each attempt to publish read all commits since this generator's last
    # publication, and not only the newer ones, other generators could publish first every time.
    def __init__(self) -> None:
        self._so_far: Advance | None = None
        self._start: Oid | None = None

    def advance(self, repo: Repository, before: Snapshot, tip: Oid) -> Advance:
        last_valid_config.refuse_other_render_version(repo, tip)
        so_far = self._so_far
        if so_far is None or self._start != before.commit:
            so_far = Advance(before, (), False)
        start = so_far.snapshot
        if start.commit != tip or start.problems or not start.is_rendered:
            later = advance(repo, start, tip)
            so_far = Advance(
                later.snapshot,
                tuple(dict.fromkeys((*so_far.subjects, *later.subjects))),
                so_far.config_changed
                or later.config_changed
                or (start.commit != before.commit and _must_render_all(repo, before.commit, tip)),
            )
        self._so_far, self._start = so_far, before.commit
        return so_far


# ---- the state in effect at a commit, even if some files are not valid ----
#
# While some files are not valid, the generator's commits record this state in trailers. ``In-
# Force`` names the newest commit where all files were valid. ``Configuration`` names the commit
# whose configuration is in effect. Each ``Stands-In`` names a file that is in effect in another
# version, as path and blob. Each ``Held-Back`` names a file of the ledger that is not in effect. A
# restart and `demandops verify` start from these trailers. They then apply people's later changes
# with the same code as a running generator.
#
# If a person's change of a claim is refused or cannot be planned, for example because the claim
# names an unknown node, the change is quarantined: the generator leaves the file alone, but the
# file's last valid version is in effect. If the new configuration is at fault, the old
# configuration stays in effect.

_NONE = "none"
_HELD_BACK = "Held-Back"
# A placeholder for the problems of a recorded state, until the files are checked again.
_TO_CHECK = Fault("invalid", "", "must be checked again")


def trailers_of(snapshot: Snapshot) -> list[tuple[str, str]]:
    if not snapshot.problems:
        return []
    source = snapshot.config_source
    return [
        ("In-Force", str(snapshot.last_valid_commit)),
        ("Configuration", str(source.commit)),
        *(
            # quoted, so that a space in a path does not begin the blob
            ("Stands-In", f"{quote(path)} {blob or _NONE}")
            for path, blob in sorted(source.replacements.items())
        ),
        *((_HELD_BACK, path) for path in sorted(snapshot.quarantined_files)),
    ]


def first_snapshot(repository: StateRepository, progress: Progress) -> Snapshot:
    # the caller then follows people's later changes
    objects, tip = repository.objects, repository.tip()
    last_valid_config.refuse_other_render_version(objects, tip)
    return start_at(objects, tip, progress)


def state_at(
    repo: Repository, revision: str | Oid, progress: Progress = lambda done, total: None
) -> Snapshot:
    # InvalidInput or StateRepoError is raised if there never was a valid state
    commit = trees.commit_of(repo, revision)
    return state_after(repo, start_at(repo, commit.id, progress), commit.id)


def state_after(repo: Repository, start: Snapshot, to: Oid) -> Snapshot:
    if start.commit == to:
        return start
    commit, change = trees.commit_of(repo, to), advance(repo, start, to)
    judgement = judge(repo, change, start, commit.tree)
    accepted = judgement.with_new_config().snapshot
    try:
        if change.config_changed:
            rendered_files(
                accepted.state, trees.texts(commit.tree, GENERATED_ROOTS), keeps_late=True
            )
    except InvalidInput as error:
        accepted = judgement.with_old_config(error.faults).snapshot
    return accepted


def start_at(
    repo: Repository, commit: Oid, progress: Progress = lambda done, total: None
) -> Snapshot:
    """Return the state in effect that the generator's newest commit up to ``commit`` records.

    If the record is missing or wrong, return the state of the newest commit with only valid files
    up to the generator's commit or, if there is none, up to ``commit``.
    """
    record = record_at(repo, commit)
    tried, faults = set[tuple[Oid | None, ...]](), list[InvalidInput | StateRepoError]()
    if record.first("In-Force"):
        # the record may be forged, or name commits that people have removed from the history
        with suppress(InvalidInput, StateRepoError):
            return recorded_state(repo, record, progress)
    line = commit_log.first_parents(repo, commit)
    newer = list(takewhile(lambda by_person: str(by_person.id) != record.commit, line))
    for ancestor in chain(commit_log.first_parents(repo, record.commit), newer):
        content = tuple(trees.entry_id(ancestor.tree, root) for root in ROOTS)
        if content not in tried:  # most commits change other files, and loading takes time
            tried.add(content)
            try:
                snapshot = load(repo, ancestor.id, progress)
                return replace(snapshot, is_rendered=ancestor not in newer)
            except (InvalidInput, StateRepoError) as error:
                faults.append(error)
    raise faults[0]


def snapshot_at(
    repo: Repository, revision: str | Oid, progress: Progress = lambda done, total: None
) -> Snapshot:
    # unlike state_at, this fails if a file is not valid and no generator has quarantined it
    if record_at(repo, revision).first("In-Force"):
        return state_at(repo, revision, progress)
    return load(repo, revision, progress)


def record_at(repo: Repository, revision: str | Oid) -> LogEntry:
    """Return the generator's newest commit, else the revision's own commit without trailers."""
    commit = trees.commit_of(repo, revision)
    last = commit_log.last_generator_commit(repo, commit.id)
    if last is None:
        return replace(commit_log.entry_of(commit), trailers={})
    return commit_log.entry_of(trees.commit_of(repo, last))


def recorded_state(
    repo: Repository, record: LogEntry, progress: Progress = lambda done, total: None
) -> Snapshot:
    commit = trees.commit_of(repo, record.commit)
    if not record.first("In-Force"):
        return load(repo, commit.id, progress)
    last_valid = load(repo, record.first("In-Force"), progress)
    configuration = record.first("Configuration") or record.first("In-Force")
    replacements: dict[str, Oid | None] = {}
    try:
        for line in record.trailers.get("Stands-In", ()):
            path, _, blob = line.rpartition(" ")
            replacements[unquote(path)] = None if blob == _NONE else repo[blob].peel(Blob).id
        source = ConfigSource(Oid(hex=configuration), replacements)
    except (ValueError, KeyError, GitError):
        raise StateRepoError(
            f"commit {record.commit} has unreadable trailers about invalid files; revert it, or "
            "merge valid files"
        ) from None
    change = advance(repo, last_valid, commit.id, source)
    held_back = record.trailers.get(_HELD_BACK, ())
    judgement = judge(repo, change, last_valid, commit.tree, held_back)
    snapshot = judgement.with_new_config().snapshot
    problems = snapshot.problems or (_TO_CHECK,)
    return replace(snapshot, last_valid_commit=last_valid.commit, problems=problems)


Faults = Mapping[Subject, tuple[Fault, ...]]


@dataclass(frozen=True, slots=True)
class Judgement:
    # of people's changes with the new and with the old configuration, by subject
    repo: Repository
    before: Snapshot
    advance: Advance
    with_new: Faults  # why a subject cannot be planned with the new configuration
    with_old: Faults  # why a subject cannot be planned, or is refused, with the old configuration
    refused: Faults  # why a person's claim on the subject is refused with the new configuration
    old: State  # the configuration that was in effect before, with the new ledger

    def with_new_config(self) -> Advance:
        # with the last valid versions of claims at fault; what has a fault only with the new
        # configuration is not the claims' fault
        faults = {
            subject: faults for subject, faults in self.with_new.items() if subject in self.with_old
        }
        return self._quarantined(self.advance, _merged(faults, self.refused))

    def with_old_config(self, faults: Iterable[Fault]) -> Advance:
        accepted = self.with_new_config()
        ledger, problems = accepted.snapshot.state.ledger, accepted.snapshot.problems
        snapshot = replace(
            accepted.snapshot,
            state=replace(self.old, ledger=ledger),
            problems=(*problems, *faults),
            last_valid_commit=self.before.last_valid_commit,
            other_config_source=self.before.config_source,
        )
        return self._quarantined(replace(accepted, snapshot=snapshot), self.with_old)

    def _quarantined(self, accepted: Advance, faults: Faults) -> Advance:
        snapshot, before = accepted.snapshot, self.before
        problems, ledger = list(snapshot.problems), snapshot.state.ledger
        quarantined = dict.fromkeys(snapshot.quarantined_files)
        for subject in (subject for subject in accepted.subjects if subject in faults):
            claims = (*before.state.ledger.claims_on(subject), *ledger.claims_on(subject))
            keys = {claim_files.path_of(claim.key): claim.key for claim in claims}
            # a fault outside claim files is told at a claim on the subject, best at a changed one
            now = snapshot.state.ledger.claims_on(subject)
            changed = [claim for claim in now if before.state.ledger.get(claim.key) != claim]
            paths = [claim_files.path_of(claim.key) for claim in (changed or now)]
            problems += [
                fault.within(paths[0])
                if paths and claim_files.kind_of(fault.file) is None
                else fault
                for fault in faults[subject]
            ]
            last_valid = ledger_files.last_valid_claims(
                self.repo, before.last_valid_commit, snapshot.commit, keys
            )
            for path, key in keys.items():
                ledger = ledger.replace(key, last_valid[path])
            quarantined |= dict.fromkeys(keys)
        snapshot = replace(
            snapshot,
            state=replace(snapshot.state, ledger=ledger),
            problems=tuple(problems),
            last_valid_commit=before.last_valid_commit if problems else snapshot.commit,
            quarantined_files=tuple(quarantined),
        )
        good = tuple(subject for subject in accepted.subjects if subject not in faults)
        return replace(accepted, snapshot=snapshot, subjects=good)


def judge(
    repo: Repository,
    advance: Advance,
    before: Snapshot,
    tree: Tree,
    held_back: Collection[str] | None = None,
) -> Judgement:
    """Return the judgement of people's changes, from the snapshot ``before`` to ``advance``.

    ``tree`` has the current generated files. ``held_back`` are the claim files that a generator's
    commit records as not in effect; without them, it is decided anew which claims are refused.
    """
    state, ledger = advance.snapshot.state, before.state.ledger
    old = replace(before.state, ledger=state.ledger)

    def faults_in(state: State) -> Faults:
        faults = {}
        for subject in advance.subjects:
            try:
                changeset_of_edit(
                    state, ledger, [subject], lambda path: trees.read_text(tree, path)
                )
            except InvalidInput as error:
                faults[subject] = error.faults
        return faults

    start, commit = before.last_valid_commit, advance.snapshot.commit
    by_people = list[ClaimChange]()
    if held_back is None and advance.subjects:
        by_people = ledger_files.claims_by_people(repo, start, commit, ledger)

    def refused_in(state: State) -> Faults:
        refused: dict[Subject, tuple[Fault, ...]] = {}
        for change in by_people:
            faults = tuple(faults_of_edit(before.state, state, [change]))
            if faults:
                refused[change.key.subject] = (*refused.get(change.key.subject, ()), *faults)
        return refused

    with_new, refused = faults_in(state), refused_in(state)
    if held_back is not None:
        refused = {
            subject: (_TO_CHECK,)
            for subject in advance.subjects
            if any(claim_files.path_of(c.key) in held_back for c in state.ledger.claims_on(subject))
        }
    if state.config == old.config:
        return Judgement(repo, before, advance, with_new, with_new, refused, old)
    with_old = _merged(faults_in(old), refused_in(old))
    return Judgement(repo, before, advance, with_new, with_old, refused, old)


def _merged(one: Faults, other: Faults) -> Faults:
    return {subject: (*one.get(subject, ()), *other.get(subject, ())) for subject in {*one, *other}}
