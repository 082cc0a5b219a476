"""Lints the charts of a checkout with helm, and renders them with the values of planned releases.

The charts of each application are also rendered for an example demand. The kinds of the rendered
objects are compared with those that the access domain allows. If an edit does not change a chart,
the chart is rendered only for the examples, and for the releases whose files the edit changes.
Charts in a registry are not rendered.

Helm sees no file of the checkout. For each chart, the texts that the check has read are written
into a temporary folder, under the names that they have in the chart. Schemas are left out, because
helm would fetch what a schema refers to; the generator's own validator checks them.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jsonschema_rs

from demandops.base import strict_yaml
from demandops.base.errors import Fault, InvalidInput, fault, field_path
from demandops.base.quoting import quoted
from demandops.base.runtime import REAL
from demandops.decide import changeset
from demandops.decide.state import State, trial_releases
from demandops.model.config.config import DOMAINS_FILE
from demandops.model.config.policy import matches
from demandops.model.release import ServiceRelease
from demandops.render.gitops import path_of, values_of
from demandops.repo.merge_check.helm import HELM_BIN, Helm, Report
from demandops.templating import charts
from demandops.templating.values import SchemaTask

MISSING = "helm is missing"
NO_HELM = (
    f"charts not rendered: {MISSING}; install it and name it in {HELM_BIN}, or put it on PATH and "
    f"leave {HELM_BIN} unset"
)
_SCHEMA = "values.schema.json"
_MOST_SECONDS = 1800  # 5,000 releases take about 1,000 s


@dataclass(frozen=True, slots=True)
class RenderedCharts:
    # a chart that is not used, or whose lint or schema has a fault, is in neither of the two lists
    # each chart that helm tried to render, even if there were faults
    rendered: tuple[str, ...] = ()
    releases: int = 0
    examples: int = 0
    # chart → why helm could not try: helm or a dependency is missing, or the chart is in a registry
    not_rendered: Mapping[str, str] = field(default_factory=dict)
    faults: tuple[Fault, ...] = ()
    warnings: tuple[Fault, ...] = ()


def render_charts(
    state: State, changed: Collection[str] | None, wanted: Collection[str]
) -> RenderedCharts:
    """Lint and render the charts of a checkout, whose state is that after the merge.

    The pull request changes the paths ``changed``, None if they are unknown. With the merge, the
    generated files at the paths ``wanted`` change.
    """
    config = state.config
    by_folder: dict[str | None, list[tuple[ServiceRelease, bool]]] = {}
    for release in changeset.planned_releases(state).values():
        if isinstance(release, ServiceRelease):
            by_folder.setdefault(release.chart.folder, []).append((release, False))
    edited = sorted(changed or ())
    for folder, pairs in by_folder.items():
        if changed is None or not folder:  # a chart in a registry is reported as not rendered
            continue
        # where the chart's own files stay, only these releases may get other objects
        parts = charts.folders(folder, config.files)
        if not any(charts.below(part, edited) for part in parts):
            by_folder[folder] = [pair for pair in pairs if path_of(pair[0]) in wanted]
    for examples in trial_releases(config).values():
        for release in examples:
            by_folder.setdefault(release.chart.folder, []).append((release, True))
    run = _Run(Helm.find(), state)
    for folder, pairs in by_folder.items():
        if pairs:
            run.render(folder, pairs)
    return run.result()


class _Run:
    def __init__(self, helm: Helm | None, state: State) -> None:
        self._helm, self._state = helm, state
        self._files = state.config.files
        self._paths = sorted(self._files)
        self._end = REAL.monotonic() + _MOST_SECONDS
        self._rendered: set[str] = set()
        self._counts: Counter[bool] = Counter()
        self._not_rendered: dict[str, str] = {}
        self._faults: dict[Fault, None] = {}
        self._warnings: dict[Fault, None] = {}

    def result(self) -> RenderedCharts:
        if self._helm is None:
            apps = self._state.config.services.values()
            charts = (service.chart for services in apps for service in services.values())
            self._not_rendered = dict.fromkeys(charts, MISSING)
        return RenderedCharts(
            tuple(sorted(self._rendered)),
            self._counts[False],
            self._counts[True],
            dict(sorted(self._not_rendered.items())),
            tuple(self._faults),
            tuple(self._warnings),
        )

    def render(self, folder: str | None, releases: Sequence[tuple[ServiceRelease, bool]]) -> None:
        # the truth value says that the release is an example
        names = dict.fromkeys(release.service.chart for release, _ in releases)
        if folder is None:
            self._not_rendered |= dict.fromkeys(names, "it is in a registry")
            return
        try:
            files, missing = charts.with_libraries(folder, self._files, self._paths)
            for place, path in files.items():
                if place.rpartition("/")[2] == _SCHEMA:
                    self._state.evaluate(self._files, SchemaTask(path))
        except InvalidInput as error:
            self._faults |= dict.fromkeys(error.faults)
            return
        if missing:
            reason = f"its dependency {missing} is not in charts/"
            self._not_rendered |= dict.fromkeys(names, reason)
        elif self._helm:
            with TemporaryDirectory(prefix="demandops-helm-") as scratch:
                self._render(self._helm, Path(scratch), folder, files, releases)

    def _render(
        self,
        helm: Helm,
        scratch: Path,
        folder: str,
        files: Mapping[str, str],
        releases: Sequence[tuple[ServiceRelease, bool]],
    ) -> None:
        home, file = scratch / "home", scratch / "values.json"
        chart = scratch / "chart" / folder.rpartition("/")[2]
        try:
            for place, path in files.items():
                if place.rpartition("/")[2] != _SCHEMA:
                    (chart / place).parent.mkdir(parents=True, exist_ok=True)
                    (chart / place).write_bytes(self._files[path].encode())
        except OSError as error:
            message = (
                f"{quoted(place)} cannot be written into a temporary folder for helm: "
                f"{error.strerror}; rename it, or make room there"
            )
            self._faults[fault("", message).within(folder)] = None
            return
        linted, seen = False, set[str]()
        for release, example in releases:
            try:
                data = values_of(release, self._state.config, self._state.evaluate)
            except InvalidInput:  # only if an override holds the release's file, with older values
                continue
            text = json.dumps(data)
            if f"{release.name} {text}" in seen:
                continue
            seen.add(f"{release.name} {text}")
            if REAL.monotonic() > self._end:
                message = f"is not rendered, because helm took more than {_MOST_SECONDS} s in all"
                self._faults[fault("", f"{message}; make it simpler").within(folder)] = None
                return
            try:
                self._check_libraries(folder, data)
            except InvalidInput as error:
                self._faults |= dict.fromkeys(error.faults)
                return
            file.write_text(text)
            if not linted:
                linted = True
                report = helm.lint(chart, file, home)
                self._add(report, folder, files)
                if report.faults:
                    return
            self._rendered.add(release.service.chart)
            self._counts[example] += 1
            namespace = release.domain.namespace
            report = helm.template(chart, file, home, release.name, namespace)
            self._add(report, folder, files)
            if not report.ended:
                return
            rules, apps = release.domain.rules, self._state.config.services
            names = [name for name, services in apps.items() if release.key.service in services]
            may_run = not rules or any(
                matches(name, rule.applications) for rule in rules for name in names
            )
            if not example or may_run:
                self._faults |= dict.fromkeys(self._kinds_refused(report, release))

    def _check_libraries(self, folder: str, values: Mapping[str, Any]) -> None:
        """Check the values of the charts in ``charts/`` against their schemas, as Helm does."""
        above = charts.merged(charts.defaults(folder, self._files), values)
        for dependency in charts.dependencies(folder, self._files):
            own = above.get(dependency.alias)
            if dependency.optional or not isinstance(own, dict | None):
                continue
            library = dependency.folder or f"{folder}/charts/{dependency.name}"
            try:
                charts.defaults(library, self._files)
            except InvalidInput:  # YAML that only Helm reads, for example with anchors
                continue
            inner = {"global": above.get("global", {}), **(own or {})}
            schema = f"{library}/{_SCHEMA}"
            if schema in self._files:
                self._state.evaluate(
                    self._files, SchemaTask(schema, inner, f"{folder}/values.yaml")
                )
            if dependency.folder:
                self._check_libraries(library, inner)

    def _add(self, report: Report, folder: str, files: Mapping[str, str]) -> None:
        for faults, into in ((report.faults, self._faults), (report.warnings, self._warnings)):
            for said in faults:
                place = said.file.partition("/")[2]  # helm's path starts with the chart's name
                into[said.within(files.get(place, f"{folder}/{place}".rstrip("/")))] = None

    def _kinds_refused(self, report: Report, release: ServiceRelease) -> Iterator[Fault]:
        domain = release.domain
        allowed = {(entry.group, entry.kind) for entry in domain.allowed_kinds}
        for group, kind in report.kinds:
            if (group, kind) not in allowed:
                file = self._state.config.file_of(DOMAINS_FILE, domain.name)
                message = (
                    f"renders a {kind}, which is not among the kinds of access domain "
                    f"'{domain.name}', so the domain's cluster would refuse the object; "
                    f"{domain.how_to_allow(kind, file)}, or leave the object out"
                )
                yield fault("", message).within(str(release.chart.folder))


# ---- whether what the generator writes is what Kubernetes takes ----
#
# Only objects of built-in kinds are compared with the schemas of Kubernetes: an override or an
# entry of the inventory may give them what its own file allows, and a cluster would refuse.

KUBERNETES_VERSION = "1.36.0"  # whose schemas
_BUILT_IN = (
    *("v1", "apps/v1", "admissionregistration.k8s.io/v1", "networking.k8s.io/v1"),
    "rbac.authorization.k8s.io/v1",
)
_API = re.compile(r"^apiVersion: (\S+)$", re.MULTILINE)


def manifest_faults(files: Mapping[str, str]) -> Iterator[Fault]:
    seen: dict[tuple[str, str, str, str], str] = {}
    for path, text in sorted(files.items()):
        for part in text.split("\n---\n"):
            api = _API.search(part)
            is_built_in = api is not None and api[1] in _BUILT_IN
            # nothing here reads the spec of other kinds, and Helm values may be long
            document = strict_yaml.load(part if is_built_in else part.partition("\nspec:\n")[0])
            if document is None:  # the comments above a bootstrap file
                continue
            metadata, kind = document["metadata"], document["kind"]
            cluster = path.split("/")[1].removesuffix(".yaml")
            identity = (cluster, kind, str(metadata.get("namespace")), metadata["name"])
            if other := seen.get(identity):
                message = f"{kind} {metadata['name']} is in {other} too; rename one of the two"
                yield fault("metadata.name", message).within(path)
            seen[identity] = path
            if is_built_in:
                for error in _schema_of(document["apiVersion"], kind).iter_errors(document):
                    place = field_path(tuple(error.instance_path))
                    yield fault(place, error.message).within(path)


@lru_cache(maxsize=64)
def _schema_of(api: str, kind: str) -> jsonschema_rs.Draft7Validator:
    group, _, version = api.rpartition("/")
    package = find_spec("kubernetes_validate")  # only its files are used; an import is slow
    assert package and package.origin  # noqa: S101 - it is one of our dependencies
    schemas = Path(package.origin).parent / "kubernetes-json-schema"
    folder = schemas / f"v{KUBERNETES_VERSION}-local-strict"
    name = "-".join(filter(None, [kind.lower(), group.partition(".")[0], version]))
    # the definitions are put into each schema, because no file is at the path that it refers to
    foreign, local = "/api/_definitions.json#/$defs/", "#/$defs/"
    schema, definitions = (
        json.loads((folder / file).read_text().replace(foreign, local))
        for file in (f"{name}.json", "_definitions.json")
    )
    return jsonschema_rs.Draft7Validator({**schema, "$defs": definitions["$defs"]})
