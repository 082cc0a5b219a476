"""Lints the charts of a checkout with helm, and renders them with the values of planned releases.

The charts of each application are also rendered for an example demand. The kinds of the rendered
objects are compared with those that the access domain allows. If an edit does not change a chart,
the chart is rendered only for the examples, and for the releases whose files the edit changes.
Charts in a registry are not rendered.
"""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

from demandops.charts import chart_files
from demandops.config.config import DOMAINS_FILE, Config
from demandops.config.policy import matches
from demandops.decision import State
from demandops.errors import Fault, InvalidInput, fault
from demandops.plan.release import ServiceRelease
from demandops.render.changes import merge_preview
from demandops.render.gitops.paths import path_of
from demandops.render.helm_values import values_of
from demandops.render.trial_render import trial_releases
from demandops.staterepo.pull_request.helm import HELM_BIN, Helm, Report
from demandops.templating.values import SchemaTask

MISSING = "helm is missing"
NO_HELM = (
    f"charts not rendered: {MISSING}; install it and name it in {HELM_BIN}, or put it on PATH and "
    f"leave {HELM_BIN} unset"
)


@dataclass(frozen=True, slots=True)
class RenderedCharts:
    """Which charts helm rendered, for how many releases and examples, and the faults found.

    ``rendered`` has each chart that helm tried to render, even if there were faults.
    ``not_rendered`` maps a chart to the reason why helm could not try: helm is missing, the chart
    is in a registry, or a dependency is missing. A chart that is not used, or whose lint or schema
    has a fault, is in neither.
    """

    rendered: tuple[str, ...] = ()
    releases: int = 0
    examples: int = 0
    not_rendered: Mapping[str, str] = field(default_factory=dict)
    faults: tuple[Fault, ...] = ()
    warnings: tuple[Fault, ...] = ()


def render_charts(
    folder: Path, state: State, changed: Collection[str] | None, wanted: Collection[str]
) -> RenderedCharts:
    """Lint and render the charts of a checkout, and return the result.

    Args:
        folder: the checkout, whose configuration must be valid.
        state: the state after the merge.
        changed: the paths that the pull request changes, or None if they are unknown.
        wanted: the paths of the generated files that will change because of the merge.
    """
    config = state.config
    used = {service.chart for services in config.services.values() for service in services.values()}
    with TemporaryDirectory(prefix="demandops-helm-") as scratch:
        helm = Helm.find(Path(scratch))
        if helm is None:
            return RenderedCharts(not_rendered=dict.fromkeys(sorted(used), MISSING))
        if (folder / "appdefs").is_dir():
            shutil.copytree(folder / "appdefs", Path(scratch, "appdefs"), ignore=_links)
        run = _Run(helm, Path(scratch), state)
        for release in merge_preview.planned_releases(state).values():
            if isinstance(release, ServiceRelease) and _concerned(release, config, changed, wanted):
                run.render(release)
        for release in (one for found in trial_releases(config).values() for one in found):
            run.render(release, example=True)
        return run.result()


def _links(folder: str, names: list[str]) -> list[str]:
    """Return the names of the symbolic links in a folder.

    They must not be copied, because helm would follow them out of the checkout.
    """
    return [name for name in names if Path(folder, name).is_symlink()]


def _concerned(
    release: ServiceRelease,
    config: Config,
    changed: Collection[str] | None,
    wanted: Collection[str],
) -> bool:
    """Return whether a release must be rendered, because an edit could affect its objects.

    This is also true if the changed paths are unknown, and for charts in a registry, which are then
    reported as not rendered.
    """
    if changed is None or not release.chart.folder or path_of(release) in wanted:
        return True
    prefixes = tuple(f"{one}/" for one in chart_files.folders(release.chart.folder, config.files))
    return any(path.startswith(prefixes) for path in changed)


class _Run:
    """Runs helm in a scratch folder with a copy of ``appdefs/``, and collects the results."""

    def __init__(self, helm: Helm, scratch: Path, state: State) -> None:
        self._helm, self._scratch, self._state = helm, scratch, state
        self._files = state.config.files
        self._sound: dict[str, bool] = {}
        self._rendered: dict[str, set[str]] = {}
        self._counts: Counter[bool] = Counter()
        self._not_rendered: dict[str, str] = {}
        self._faults: dict[Fault, None] = {}
        self._warnings: dict[Fault, None] = {}

    def result(self) -> RenderedCharts:
        return RenderedCharts(
            tuple(sorted(self._rendered)),
            self._counts[False],
            self._counts[True],
            dict(sorted(self._not_rendered.items())),
            tuple(self._faults),
            tuple(self._warnings),
        )

    def render(self, release: ServiceRelease, *, example: bool = False) -> None:
        """Render the chart of a release or an example; lint each chart once, before it renders."""
        name, folder = release.service.chart, release.chart.folder
        if folder is None:
            self._not_rendered[name] = "it is in a registry"
            return
        try:
            values = json.dumps(values_of(release, self._state.config, self._state.evaluate))
        except InvalidInput:  # only if an override holds the release's file, with older values
            return
        if folder not in self._sound:
            self._sound[folder] = self._prepare(name, folder) and self._lint(folder, values)
        if not self._sound[folder]:
            return
        seen = self._rendered.setdefault(name, set())
        if f"{release.name} {values}" in seen:
            return
        seen.add(f"{release.name} {values}")
        self._counts[example] += 1
        report = self._helm.template(
            self._scratch / folder, self._file(values), release.name, release.domain.namespace
        )
        self._add(report, folder)
        if not example or self._may_run(release):
            self._faults.update(dict.fromkeys(self._refused(report, release)))

    def _prepare(self, name: str, folder: str) -> bool:
        """Check a chart's schemas, and copy its libraries into the chart's folder.

        Return whether helm may render the chart.
        """
        for path in chart_files.folders(folder, self._files):
            for schema in (one for one in self._files if one.startswith(f"{path}/")):
                if schema.endswith("/values.schema.json"):
                    try:
                        self._state.evaluate(self._files, SchemaTask(schema))
                    except InvalidInput as error:  # helm would fetch what a schema refers to
                        self._faults.update(dict.fromkeys(error.faults))
                        return False
        if reason := self._place_libraries(folder):
            self._not_rendered[name] = reason
        return not reason

    def _place_libraries(self, folder: str) -> str:
        """Copy a chart's libraries into its folder ``charts/``.

        Return the reason why a library cannot be copied, or an empty text.
        """
        for one in chart_files.dependencies(folder, self._files):
            target = self._scratch / folder / "charts" / one.name
            if one.folder:
                if reason := self._place_libraries(one.folder):
                    return reason
                shutil.rmtree(target, ignore_errors=True)
                shutil.copytree(self._scratch / one.folder, target)
            elif not target.exists() and not [*target.parent.glob(f"{one.name}-*.tgz")]:
                return f"its dependency {one.name} is not in charts/"
        return ""

    def _lint(self, folder: str, values: str) -> bool:
        report = self._helm.lint(self._scratch / folder, self._file(values))
        self._add(report, folder)
        return not report.faults

    def _file(self, values: str) -> Path:
        file = self._scratch / "values.json"
        file.write_text(values)
        return file

    def _add(self, report: Report, folder: str) -> None:
        """Add the faults and warnings of a report to the result.

        A path in the report starts with the name of the chart's folder. In the result, the path
        starts at the top of the checkout.
        """
        above = folder.rpartition("/")[0]
        libraries = {
            f"{folder}/charts/{one.name}": one.folder
            for one in chart_files.dependencies(folder, self._files)
            if one.folder
        }
        for found, into in ((report.faults, self._faults), (report.warnings, self._warnings)):
            for one in found:
                path = f"{above}/{one.file}" if one.file else folder
                for place, library in libraries.items():
                    path = path.replace(f"{place}/", f"{library}/")
                into[one.within(path)] = None

    def _may_run(self, release: ServiceRelease) -> bool:
        """Return whether the domain's rules allow an application that has the release's service.

        A domain without rules allows every application.
        """
        rules, services = release.domain.rules, self._state.config.services
        appdefs = [name for name, known in services.items() if release.key.service in known]
        return not rules or any(
            matches(one, rule.applications) for rule in rules for one in appdefs
        )

    def _refused(self, report: Report, release: ServiceRelease) -> Iterator[Fault]:
        """Yield a fault for each rendered object whose kind the access domain does not allow."""
        domain = release.domain
        allowed = {(one.group, one.kind) for one in domain.allowed_kinds}
        for group, kind in report.kinds:
            if (group, kind) not in allowed:
                file = self._state.config.file_of(DOMAINS_FILE, domain.name)
                message = (
                    f"renders a {kind}, which is not among the kinds of access domain "
                    f"'{domain.name}', so the domain's cluster would refuse the object; "
                    f"{domain.how_to_allow(kind, file)}, or leave the object out"
                )
                yield fault("", message).within(str(release.chart.folder))
