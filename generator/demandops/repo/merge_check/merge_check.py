"""The check of a pull request: whether an edit can be merged, and the effect of the merge.

All files must be valid, and the generator must be able to render the desired state. Generated files
must not have manual edits. A changed chart must have a new version, because Flux and Argo CD
compare only versions. The edit is compared with the commit that it started from. The result also
shows how the merge would change desired state and bookkeeping.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from itertools import chain, count
from pathlib import Path

from demandops.base import strict_yaml
from demandops.base.errors import Fault, InvalidInput, fault
from demandops.base.runtime import REAL
from demandops.base.settings import GENERATED_ROOTS, RENDER_VERSION
from demandops.base.strict_yaml import with_lines
from demandops.decide import override_report, warnings
from demandops.decide.bookkeeping import EntryChange, bookkeeping, bookkeeping_changes
from demandops.decide.edits import expired_overrides, faults_of_edit, update_ledger
from demandops.decide.state import (
    MergePreview,
    State,
    planned_releases,
    preview,
    rendered_files,
    try_configuration,
)
from demandops.decide.warnings import missing_inputs
from demandops.model.config.config import CHARTS_FILE, CONFIG_ROOTS, Config
from demandops.model.config.discovered import is_discovered
from demandops.model.config.load import load
from demandops.model.config.override import OVERRIDES_ROOT, format_time
from demandops.model.config.repo_settings import ROOT_FILE
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger import records
from demandops.model.ledger.ledger import Ledger, World, changes_on, ledger_of
from demandops.render import gitops
from demandops.render.gitops import BOOTSTRAP_ROOT, path_of
from demandops.repo.git import tree as trees
from demandops.repo.load import ledger_files
from demandops.repo.merge_check import edited_checkout, rendered_charts
from demandops.repo.merge_check.edited_checkout import Base, author_of, base_of
from demandops.repo.merge_check.rendered_charts import RenderedCharts
from demandops.templating import charts
from demandops.templating.evaluator import EVALUATE

_MOST_LEFT = 5


@dataclass(frozen=True, slots=True)
class Suggestion:
    instead_of: str  # the path of the edited file
    file: str  # path and content of the override
    text: str
    not_covered: tuple[str, ...]  # the parts of the edit that the override leaves out
    other_releases: tuple[str, ...]  # the other releases to which the override also applies


@dataclass(frozen=True, slots=True)
class CheckResult:
    faults: tuple[Fault, ...]
    start: Base = field(default_factory=Base)
    suggestions: tuple[Suggestion, ...] = ()
    # what the merge changes, without claims that are not valid; None if it cannot be rendered
    preview: MergePreview | None = None
    # also None if the base's bookkeeping is not known; empty if there is no base
    bookkeeping: tuple[EntryChange, ...] | None = None
    # the files of the preview that a generator would write without the edit too
    pending: tuple[str, ...] = ()
    warnings: tuple[Fault, ...] = ()  # likely mistakes, and what a person has to do after the merge
    charts: RenderedCharts | None = None


def check(
    folder: Path,
    base: str | None = None,
    now: datetime | None = None,
    *,
    require_helm: bool = False,
) -> CheckResult:
    """Check the files of a state repo, and return the faults and the effect of a merge.

    The folder is a checkout, or its files without Git. The edit is compared with the common
    ancestor of HEAD and the merge target ``base``, by default ``origin/main``, else ``main``, and
    without one with HEAD. Overrides that ended before ``now`` do not apply.
    """
    try:
        with edited_checkout.opened(folder) as (repo, tree):
            files = trees.texts(tree, edited_checkout.ROOTS)
            start, owner = base_of(repo, base, files), author_of(repo)
    except InvalidInput as error:  # of what is no plain file
        return CheckResult(error.faults)
    edit = _Edit(files, start, now or REAL.now())
    claims, faults = ledger_files.read_claims(sorted(files.items()))
    edited = [path for path in edit.changed if _is_written_by_generator(path)]
    result = CheckResult((), start)
    try:
        config = edit.config()
        faults += edit.unversioned_charts(config)
        state = edit.merged_state(config, ledger_of(claims))
        faults += edit.refused_claims(state)
        wanted = edit.rendered(state)
    except InvalidInput as error:
        faults += error.faults
    else:
        # a proposal or an upgrade has files as the generator renders them, so they are no manual
        # edits
        edited = [
            path for path in edited if not _generated(path) or files.get(path) != wanted.get(path)
        ]
        new = planned_releases(state)
        previewed = preview(
            start.releases() if start.commit else new, new, edit.before_merge(wanted), wanted
        )
        charts = rendered_charts.render_charts(
            state, edit.changed if start.commit else None, {file.path for file in previewed.files}
        )
        faults += charts.faults
        written = {file.path: file.after for file in previewed.files if file.after is not None}
        faults += rendered_charts.manifest_faults(written)
        if require_helm and rendered_charts.MISSING in charts.not_rendered.values():
            faults.append(fault("", rendered_charts.NO_HELM))
        idle = override_report.warnings(override_report.override_report(state, edit.now))
        # a topic that was lacking before is not of this edit
        old = missing_inputs(start.state) if start.state else ()
        lacking = {(topic.application, topic.reason) for topic in old}
        booked: tuple[EntryChange, ...] | None = ()
        if start.commit:
            booked = None
            with suppress(InvalidInput):  # the base's bookkeeping may not be known
                if start.state is not None:
                    booked = bookkeeping_changes(bookkeeping(start.state), bookkeeping(state))
        result = replace(
            result,
            preview=previewed,
            pending=tuple(edit.pending(previewed)),
            charts=charts,
            bookkeeping=booked,
            warnings=(
                *(fault("", text).within(path) for path, text in idle),
                *warnings.ignored_field_warnings(state.config),
                *warnings.truth_warnings(files),
                *warnings.request_warnings(state.config),
                *warnings.live_warnings(state),
                *warnings.policy_warnings(state),
                *warnings.unmatched_pattern_warnings(state.config),
                *warnings.tied_override_warnings(new.values()),
                *warnings.unheld_output_warnings(state),
                *edit.changed_bootstraps(wanted),
                *(
                    topic.warning
                    for topic in missing_inputs(state)
                    if (topic.application, topic.reason) not in lacking
                ),
                *charts.warnings,
            ),
        )
    if start.theirs and not faults:
        faults += edit.faults_once_merged(start)
    if edited:
        suggestions = _suggestions(files, start, edited, owner)
        faults += [
            fault(
                "", _remedy(path, start.files.get(path), files.get(path), suggestions.get(path))
            ).within(path)
            for path in edited
        ]
        result = replace(result, suggestions=tuple(suggestions.values()))
    # an InvalidInput has only so many faults of one file
    listed = with_lines(InvalidInput(dict.fromkeys(faults)).faults, files.get)

    def place(fault: Fault) -> tuple[str, bool, int, str, str]:
        return fault.file, fault.code == "more", fault.line or 0, fault.field, fault.message

    return replace(
        result,
        faults=tuple(sorted(listed, key=place)),
        warnings=tuple(with_lines(InvalidInput(result.warnings).faults, files.get)),
    )


def _generated(path: str) -> bool:
    return path.split("/", maxsplit=1)[0] in GENERATED_ROOTS


def _is_written_by_generator(path: str) -> bool:
    root = path.split("/", maxsplit=1)[0]
    if trees.is_readme(path):
        return False
    if root == claim_files.LEDGER_ROOT:  # people may edit claims and waiting demands
        is_waiting = path.startswith(f"{records.WAITING_ROOT}/")
        return claim_files.kind_of(path) is None and not is_waiting
    return root in GENERATED_ROOTS or is_discovered(path)


def _suggestions(
    files: Mapping[str, str], start: Base, edited: Iterable[str], owner: str
) -> dict[str, Suggestion]:
    releases = {path_of(release): release for release in start.releases().values()}
    suggestions, taken = dict[str, Suggestion](), set(files)
    for path in edited:
        release, before, after = releases.get(path), start.files.get(path), files.get(path)
        if start.state is None or release is None or before is None or after is None:
            continue
        effects, left = edited_checkout.effects_of(before, after, release, start.state.config)
        if not effects:
            continue
        names = chain([release.name], (f"{release.name}-{number}" for number in count(2)))
        file = next(f for name in names if (f := f"{OVERRIDES_ROOT}/{name}.yaml") not in taken)
        taken.add(file)
        others = [r.name for r in releases.values() if edited_checkout.also_applies(release, r)]
        text = edited_checkout.override_text(effects, release, owner)
        suggestions[path] = Suggestion(path, file, text, tuple(left), tuple(sorted(others)))
    return suggestions


def _remedy(path: str, before: str | None, after: str | None, suggestion: Suggestion | None) -> str:
    lost = "is generated, so a manual edit is lost; revert it"
    root = path.split("/", maxsplit=1)[0]
    if suggestion is not None:
        left = suggestion.not_covered
        listed = ", ".join(left[:_MOST_LEFT]) + (", …" if len(left) > _MOST_LEFT else "")
        unchanged = f" (this override does not change {listed})" if left else ""
        return f"{lost}, and merge {suggestion.file} as shown{unchanged}"
    if is_discovered(path):
        return (
            "is written by the generator, as the cluster has its nodes, so a manual edit is lost; "
            "revert it, and change the node in the cluster, or list it in inventory/nodes.yaml"
        )
    if root == claim_files.LEDGER_ROOT:
        if before is not None:
            return "is written only by the generator; revert the edit"
        return (
            "is not the path of a claim, and people may add only claims and waiting demands to "
            "ledger/; remove the file"
        )
    if before is None:
        if root == BOOTSTRAP_ROOT:
            return (
                "is in a generated folder, from which the generator removes other files; delete it"
            )
        return (
            "is in a generated folder, from which the generator removes what no demand needs; "
            "delete it, and demand what you need with `demandops demand`"
        )
    if root == BOOTSTRAP_ROOT:
        return f"{lost}, and change demandops.yaml, inventory/ or policy/ instead"
    if "/_charts/" in path:
        return f"{lost}, and change registry/ instead"
    if path.endswith("/_domain.yaml"):
        return f"{lost}, and change policy/ instead"
    if after is None:
        return (
            f"{lost}; to stop the release, delete its claims in ledger/, or deny it by an override "
            "(docs/overrides.md)"
        )
    return f"{lost}, and change the configuration or write an override instead (docs/overrides.md)"


@dataclass(frozen=True, slots=True)
class _Edit:
    files: Mapping[str, str]
    start: Base
    now: datetime

    @property
    def changed(self) -> list[str]:
        before, after = self.start.files, self.files
        return sorted(path for path in {*before, *after} if before.get(path) != after.get(path))

    @property
    def generated_before(self) -> dict[str, str]:
        return {
            path: text
            for path, text in self.start.files.items()
            if _generated(path) and not trees.is_readme(path)
        }

    def before_merge(self, wanted: Mapping[str, str]) -> dict[str, str]:
        files, theirs = self.generated_before, self.start.theirs
        for path in {*filter(_generated, theirs), *files} if theirs else ():
            # what the merge target has already is no effect of this merge
            if theirs.get(path) == wanted.get(path):
                files.pop(path, None)
                files |= {path: wanted[path]} if path in wanted else {}
        return files

    def pending(self, preview: MergePreview) -> Iterator[str]:
        if (state := self.start.state) is None:
            return
        releases = {path_of(release): release for release in self.start.releases().values()}
        for file in preview.files:
            is_gone = file.after is None and not file.path.rsplit("/", 1)[-1].startswith("_")
            if (release := releases.get(file.path)) is None:
                if is_gone:
                    yield file.path
                continue
            with suppress(InvalidInput):
                if gitops.render(release, state.config, state.evaluate) == file.after:
                    yield file.path

    def faults_once_merged(self, start: Base) -> Iterator[Fault]:
        # of the edit and the newer commits of the merge target together, or of these commits alone
        merged = dict(self.files)
        for path in {*start.files, *start.theirs}:
            was, theirs = start.files.get(path), start.theirs.get(path)
            # what both have changed is for git to merge
            if was != theirs and self.files.get(path) == was:
                merged.pop(path, None)
                merged |= {path: theirs} if theirs is not None else {}
        whole = replace(self, files=merged)
        claims, faults = ledger_files.read_claims(sorted(merged.items()))
        try:
            whole.rendered(whole.merged_state(whole.config(), ledger_of(claims)))
        except InvalidInput as error:
            faults += error.faults
        for each in faults:
            message = f"{each.message} (once merged into {start.target}, which has newer commits)"
            yield replace(each, message=message)

    def config(self) -> Config:
        files = {p: text for p, text in self.files.items() if p.split("/")[0] in CONFIG_ROOTS}
        config = load(files)
        version = config.repo_settings.render_version
        if version < RENDER_VERSION:
            message = (
                f"is {version}, but this program renders version {RENDER_VERSION}; run this "
                "check with the same program version as the generator, or run `demandops upgrade` "
                "to render everything again"
            )
            raise InvalidInput.at("renderVersion", message, file=ROOT_FILE)
        return config

    def merged_state(self, config: Config, ledger: Ledger) -> State:
        root = f"{records.MARKERS_ROOT}/"
        markers = {path: text for path, text in self.files.items() if path.startswith(root)}
        ended = records.read_ended_override(markers)
        expired = expired_overrides(World(config, replace(ledger, ended=ended)), self.now)
        ended |= {override.name: format_time(override.end) for override in expired if override.end}
        state = State(config, replace(ledger, ended=ended), EVALUATE)
        try_configuration(state)
        if self.start.state is None:
            return state
        old = self.start.state
        subjects = ledger_files.changed_subjects(old.ledger, ledger)
        applied = update_ledger(old, state, subjects, markers, self.now)
        return replace(state, ledger=applied.ledger)

    def refused_claims(self, state: State) -> Iterator[Fault]:
        old = self.start.state
        if old is not None:
            subjects = ledger_files.changed_subjects(old.ledger, state.ledger)
            changes = changes_on(old.ledger, state.ledger, subjects)
            by_path = {
                claim_files.path_of(change.key): change for change in changes if change.after
            }
            # an override may change claims too, but not their files in the checkout
            written = {path: change for path, change in by_path.items() if path in self.files}
            for path, change in written.items():
                if path in self.start.files:
                    was = ledger_files.claim_in(path, old.ledger)
                    yield from ledger_files.owner_faults(change.after, was, path)
            yield from faults_of_edit(old, state, written.values())

    def rendered(self, state: State) -> dict[str, str]:
        return rendered_files(state, self.generated_before, edited=self.changed)

    def changed_bootstraps(self, wanted: Mapping[str, str]) -> Iterator[Fault]:
        # a person must apply these files
        before = self.before_merge(wanted)
        for path, text in sorted(wanted.items()):
            if path.startswith(f"{BOOTSTRAP_ROOT}/") and before.get(path) != text:
                cluster = path.removeprefix(f"{BOOTSTRAP_ROOT}/").removesuffix(".yaml")
                change = "changes" if path in before else "is new"
                message = (
                    f"{change} with the merge, but no controller applies bootstrap files; after "
                    f"the merge, an administrator of cluster '{cluster}' must run: "
                    f"git show main:{path} | kubectl apply -f -"
                )
                yield fault("", message).within(path)

    def unversioned_charts(self, config: Config) -> Iterator[Fault]:
        sources = {
            source.folder: (name, source)
            for name, chart in sorted(config.charts.items())
            for source in chart.sources()
            if source.folder
        }
        edited = self.changed
        for folder, (name, source) in sorted(sources.items()):
            metadata = f"{folder}/Chart.yaml"
            folders = charts.folders(folder, self.files)
            changed = sorted(path for part in folders for path in charts.below(part, edited))
            if not changed or metadata not in self.start.files:
                continue
            try:
                data = strict_yaml.load(self.start.files[metadata])
            except InvalidInput:
                continue
            if isinstance(data, dict) and data.get("version") == source.version:
                first = changed[0].removeprefix(f"{folder}/")
                yield fault(
                    "version",
                    f"is still {source.version}, but {first} changed; raise the version here and "
                    f"at charts.{name} in {config.file_of(CHARTS_FILE, name)}, or no cluster "
                    "applies the change",
                ).within(metadata)
