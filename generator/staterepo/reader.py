"""Looking into a state repo without writing: for the command line's views, a dry run and checks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from pygit2 import Commit

from generator import settings
from generator.catalog.catalog import Catalog
from generator.decision import rendered
from generator.errors import InvalidInput
from generator.render.changeset import Read
from generator.settings import GENERATED_ROOTS, RENDER_VERSION
from generator.staterepo import history, in_force, remote, reports
from generator.staterepo import snapshot as snapshots
from generator.staterepo import tree as trees
from generator.staterepo.address import is_url
from generator.staterepo.history import LogEntry
from generator.staterepo.message import PROPOSAL
from generator.staterepo.outbox import Slot
from generator.staterepo.proposals import Waiting, waiting
from generator.staterepo.repository import StateRepository
from generator.staterepo.snapshot import Progress, Snapshot


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether the rendered files of one commit are those that its books and settings give."""

    commit: str
    summary: str
    holds: bool
    skipped: str = ""
    fault: str = ""
    differing: tuple[str, ...] = ()


class Reader:
    """An open state repo, at its newest commit."""

    def __init__(self, address: str) -> None:
        """Open the state repo; of a URL a clone is kept, and fetched.

        Raises:
            StateRepoError: where it cannot be read.
        """
        self._slot: Slot | None = None
        folder = Path()
        if is_url(address):
            self._slot = Slot(settings.data_home(address) / "reader")
            folder = self._slot.folder
        try:
            self._repository = remote.connect(address, folder)
            self._tip = self._repository.refresh()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Give the clone back."""
        if self._slot is not None:
            self._slot.close()

    @property
    def repository(self) -> StateRepository:
        """The state repo itself, for a command that writes to it."""
        return self._repository

    def refuse_other_rendering(self) -> None:
        """Raise where a generator of another version writes this repo, as a generator does.

        Raises:
            StateRepoError: saying which version it is and what to do.
        """
        tip = snapshots.commit_of(self._repository.objects, self._tip)
        snapshots.refuse_other_rendering(tip.tree)

    def commit(self, revision: str | None = None) -> str:
        """Return the id of a commit; the newest where no revision is given."""
        return str(snapshots.commit_of(self._repository.objects, revision or self._tip).id)

    def includes(self, commit: str, other: str) -> bool:
        """Tell whether ``commit`` is ``other`` or comes after it."""
        return self._repository.includes(commit, other)

    def unchanged(self, commit: str, other: str, path: str) -> bool:
        """Tell whether two commits hold the same under ``path``."""
        return self._repository.unchanged(commit, other, path)

    def snapshot(
        self, revision: str | None = None, progress: Progress = lambda done, total: None
    ) -> Snapshot:
        """Load the books and the configuration that are in force at a commit.

        Where the generator reported that people broke a file, these are its last valid versions.

        Raises:
            InvalidInput, StateRepoError: where it holds no valid state repo.
        """
        commit = snapshots.commit_of(self._repository.objects, self.commit(revision))
        told = self._told_at(commit)
        if told is not None and told.one("In-Force"):
            return in_force.at(self._repository.objects, commit, told)
        return snapshots.load(self._repository.objects, commit.id, progress)

    def _told_at(self, commit: Commit) -> LogEntry | None:
        """Return the generator's newest commit up to one: it says what is in force."""
        base = history.last_generated(self._repository.objects, commit.id)
        if base is None:
            return None
        return history.entry_of(snapshots.commit_of(self._repository.objects, base))

    def problems(self) -> tuple[reports.Problem, ...]:
        """Return what the generator reports not to be valid at the newest commit."""
        return reports.read(self.file_reader()(reports.PATH))

    def file_reader(self, revision: str | None = None) -> Read:
        """Return a function that gives the text of a file at a commit."""
        tree = snapshots.commit_of(self._repository.objects, self.commit(revision)).tree
        return lambda path: trees.read_text(tree, path)

    def catalog(self) -> Catalog:
        """Return the configuration at the newest commit.

        Raises:
            InvalidInput, StateRepoError: where it holds no valid one.
        """
        return snapshots.catalog_at(snapshots.commit_of(self._repository.objects, self._tip).tree)

    def proposals(self) -> list[Waiting]:
        """Return the demands that await approval, by branch.

        Raises:
            RemoteAway: where the remote does not answer.
        """
        return list(waiting(self._repository))

    def log(self, spec: str | None = None) -> Iterator[LogEntry]:
        """Yield commits newest first: all, those up to ``REV``, or those of ``A..B``."""
        first, dots, last = (spec or "").partition("..")
        if dots:
            yield from history.walk(self._repository.objects, last or self._tip, first)
        else:
            yield from history.walk(self._repository.objects, first or self._tip)

    def revisions(self, spec: str | None) -> list[str]:
        """Return the commits that ``REV`` or ``A..B`` names, oldest first."""
        return history.revisions(self._repository.objects, self._tip, spec or str(self._tip))

    def verify(self, revision: str) -> Verdict:
        """Render the books of a commit again and compare the bytes."""
        commit = snapshots.commit_of(self._repository.objects, revision)
        entry = history.entry_of(commit)
        if not entry.by_generator:
            return Verdict(entry.commit, entry.summary, True, _not_ours(entry))
        version = entry.one("Render-Version")
        if version != str(RENDER_VERSION):
            return Verdict(
                entry.commit,
                entry.summary,
                True,
                f"rendered by version {version}, this is version {RENDER_VERSION}",
            )
        try:
            snapshot = in_force.at(self._repository.objects, commit, entry)
        except InvalidInput as error:
            why = f"a person's file was not valid then: {error.faults[0]}"
            return Verdict(entry.commit, entry.summary, True, why)
        try:
            wanted = rendered(snapshot.state, _held_from(commit, snapshot.state.catalog))
        except InvalidInput as error:  # the generator did render it then, so it must now
            return Verdict(entry.commit, entry.summary, False, fault=str(error.faults[0]))
        differing = _differing(wanted, commit)
        return Verdict(entry.commit, entry.summary, not differing, differing=differing)


def _held_from(commit: Commit, catalog: Catalog) -> dict[str, str]:
    """Return the files as they were before a commit, where overrides hold some of them."""
    if not commit.parents or not any(override.hold for override in catalog.in_force):
        return {}
    return trees.texts(commit.parents[0].tree, GENERATED_ROOTS)


def _not_ours(entry: LogEntry) -> str:
    return "merged by a person" if PROPOSAL in entry.trailers else "made by a person"


def _differing(wanted: dict[str, str], commit: Commit) -> tuple[str, ...]:
    standing = trees.texts(commit.tree, GENERATED_ROOTS)
    return tuple(
        path
        for path in sorted({*wanted, *standing})
        if wanted.get(path) != standing.get(path) and not trees.is_note(path)
    )


@contextmanager
def opened(address: str) -> Iterator[Reader]:
    """Open a state repo for reading and close it again."""
    reader = Reader(address)
    try:
        yield reader
    finally:
        reader.close()
