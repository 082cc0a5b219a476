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
import os
import re
import shutil
import subprocess
import sys
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
from demandops.decide.state import State, planned_releases, trial_releases
from demandops.model.config.base_model import matches
from demandops.model.config.config import DOMAINS_FILE, Config
from demandops.model.release import ServiceRelease
from demandops.render.gitops import path_of, values_of
from demandops.repo.git import child_processes
from demandops.repo.merge_check import confined_process
from demandops.templating import charts
from demandops.templating.values import SchemaTask

# ---- helm, which renders the charts of a pull request, whose author may be hostile ----
#
# Helm gets an empty home folder, no secrets of the environment, no access to a cluster or to chart
# repositories, limits of time, memory and output, and no network where the kernel allows that.

# The environment variable that names the program, instead of ``helm`` on ``PATH``.
HELM_BIN = "HELM_BIN"

# helm renders a chart in a tenth of a second. The limit of processor time ends a chart that loops,
# also on a busy machine; the other one ends a helm that waits.
_HELM_CPU_S = 30
_HELM_S = 300
_MOST_SECONDS = 1800  # of all charts of a check; 5,000 releases take about 1,000 s
_MOST_OUTPUT = 16 << 20
# Patterns search the text of a message, whose length is the author's choice.
_MOST_MESSAGE = 4_000
_MOST_LINT = 100_000
_LONGEST_SAID = 400
_API_VERSION = re.compile(r"(?m)^[\"']?apiVersion[\"']?\s*: *[\"']?([^\s\"']+)")
_KIND = re.compile(r"(?m)^[\"']?kind[\"']?\s*: *[\"']?([^\s\"']+)")
_LINT = re.compile(r"\[(?P<level>ERROR|WARNING)\] (?P<text>.*)")
_PLACE = re.compile(
    r"(?P<path>[A-Za-z0-9][\w.-]*/(?:charts/[\w.-]+/)*templates/[\w./-]+?)(?::(?P<line>\d{1,9}))?(?=[:)\s])"
)


@dataclass(frozen=True, slots=True)
class Report:
    kinds: tuple[tuple[str, str], ...] = ()  # API group and kind of each rendered object
    faults: tuple[Fault, ...] = ()
    warnings: tuple[Fault, ...] = ()
    ended: bool = True  # not, if helm was stopped because of its limits


@dataclass(frozen=True, slots=True)
class Helm:
    """The installed program ``helm``. Its ``home`` is a folder that holds nothing else."""

    program: str
    end: float  # of the monotonic clock: when it may render nothing more

    @staticmethod
    def find() -> Helm | None:
        program = shutil.which(os.environ.get(HELM_BIN) or "helm")
        end = REAL.monotonic() + _MOST_SECONDS
        return Helm(str(Path(program).absolute()), end) if program else None

    def lint(self, chart: Path, values: Path, home: Path) -> Report:
        code, out, err = self._run(home, "lint", str(chart), f"--values={values}")
        report = parsed_lint(out[:_MOST_LINT], chart.name)
        if code != 0 and not report.faults:
            return Report(faults=(parsed_error(err or out, chart.name),), ended=code > 0)
        return report

    def template(
        self, chart: Path, values: Path, home: Path, release: str, namespace: str
    ) -> Report:
        code, out, err = self._run(
            home,
            *("template", release, str(chart), "--include-crds", "--skip-tests"),
            *(f"--namespace={namespace}", f"--values={values}"),
        )
        if code != 0:
            return Report(faults=(parsed_error(err, chart.name),), ended=code > 0)
        return Report(tuple(dict.fromkeys(parsed_kinds(out))))

    def _run(self, home: Path, *arguments: str) -> tuple[int, str, str]:
        """Return helm's exit code, output and errors; a negative code if it was stopped."""
        home.mkdir(exist_ok=True)
        environment = {
            "PATH": os.environ.get("PATH", os.defpath),
            "HOME": str(home),
            "TMPDIR": str(home),
            "KUBECONFIG": os.devnull,
            "HELM_PLUGINS": str(home / "plugins"),
            **child_processes.mark(),
        }
        command = [sys.executable, "-IS", confined_process.__file__, str(_HELM_CPU_S), self.program]
        # files, because a pipe would keep in memory whatever a hostile chart prints
        files = home / "out", home / "err"
        with files[0].open("wb") as out, files[1].open("wb") as err:
            try:
                code = subprocess.run(
                    [*command, *arguments],
                    cwd=home,
                    env=environment,
                    stdin=subprocess.DEVNULL,
                    stdout=out,
                    stderr=err,
                    check=False,
                    timeout=_HELM_S,
                ).returncode
            except subprocess.TimeoutExpired:
                code = -1
        if code not in (0, 1):  # a signal, or 2 from Go, for example if it gets no memory
            limits = f"{_HELM_CPU_S} s or {confined_process.MEMORY >> 30} GiB"
            return -1, "", f"Error: helm crashed, or took more than {limits}"
        if files[0].stat().st_size > _MOST_OUTPUT:
            return -1, "", f"Error: helm printed more than {_MOST_OUTPUT >> 20} MiB"
        texts = []
        for file in files:
            with file.open("rb") as opened:
                text = opened.read(_MOST_OUTPUT).decode("utf-8", "replace")
            texts.append(text.replace(f"{home.parent}/chart/", ""))
        return code, texts[0], texts[1]


def parsed_kinds(out: str) -> Iterator[tuple[str, str]]:
    for document in re.split(r"(?m)^---(?=\s|$)", out):
        api, kind = _API_VERSION.search(document), _KIND.search(document)
        if kind:
            yield api[1].rpartition("/")[0] if api else "", kind[1]


def parsed_lint(out: str, chart: str) -> Report:
    # a fault whose template helm does not name is located at the chart's folder
    by_level: dict[str, list[Fault]] = {"ERROR": [], "WARNING": []}
    for entry in re.split(r"\n(?=\[|\n)", out):
        match = _LINT.match(entry.strip())
        if match:
            by_level[match["level"]].append(_fault(entry.strip()[match.start("text") :], chart))
    return Report(faults=tuple(by_level["ERROR"]), warnings=tuple(by_level["WARNING"]))


def parsed_error(err: str, chart: str) -> Fault:
    text = err.partition("Error: ")[2] or err
    return _fault(text.partition("\n\nUse --debug")[0].strip(), chart)


def _fault(text: str, chart: str) -> Fault:
    text = text[:_MOST_MESSAGE]
    places = [*_PLACE.finditer(text)]  # helm names first who includes, and last what is at fault
    place = places[-1] if places else None
    file = place["path"] if place else chart
    line = int(place["line"]) if place and place["line"] else None
    said = quoted(" ".join(text.split()), _LONGEST_SAID)
    return fault("", f"helm says {said}; fix the chart or its values", line=line).within(file)


# ---- the charts of a checkout ----

MISSING = "helm is missing"
NO_HELM = (
    f"charts not rendered: {MISSING}; install it and name it in {HELM_BIN}, or put it on PATH and "
    f"leave {HELM_BIN} unset"
)
_SCHEMA = "values.schema.json"


@dataclass
class RenderedCharts:
    # a chart that is not used, or whose lint or schema has a fault, is in neither of the two lists
    # each chart that helm tried to render, even if there were faults
    rendered: list[str] = field(default_factory=list)
    releases: int = 0
    examples: int = 0
    # chart → why helm could not try: helm or a dependency is missing, or the chart is in a registry
    not_rendered: dict[str, str] = field(default_factory=dict)
    faults: dict[Fault, None] = field(default_factory=dict)
    warnings: dict[Fault, None] = field(default_factory=dict)


def render_charts(  # noqa: PLR0912
    state: State, changed: Collection[str] | None, wanted: Collection[str]
) -> RenderedCharts:
    """Lint and render the charts of a checkout, whose state is that after the merge.

    The pull request changes the paths ``changed``, None if they are unknown. With the merge, the
    generated files at the paths ``wanted`` change.
    """
    config, result, helm = state.config, RenderedCharts(), Helm.find()
    # by folder, the releases, and whether each is an example
    by_folder: dict[str | None, list[tuple[ServiceRelease, bool]]] = {}
    for release in planned_releases(state).values():
        if isinstance(release, ServiceRelease):
            by_folder.setdefault(release.chart.folder, []).append((release, False))
    edited, paths = sorted(changed or ()), sorted(config.files)
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
    for folder, pairs in by_folder.items():
        names = dict.fromkeys(release.service.chart for release, _ in pairs)
        if folder is None:
            result.not_rendered |= dict.fromkeys(names, "it is in a registry")
        if folder is None or not pairs:
            continue
        try:
            files, missing = charts.with_libraries(folder, config.files, paths)
            for place, path in files.items():
                if place.rpartition("/")[2] == _SCHEMA:
                    state.evaluate(config.files, SchemaTask(path))
            if missing:
                reason = f"its dependency {missing} is not in charts/"
                result.not_rendered |= dict.fromkeys(names, reason)
            elif helm:
                with TemporaryDirectory(prefix="demandops-helm-") as scratch:
                    _render(helm, Path(scratch), folder, files, pairs, state, result)
        except InvalidInput as error:
            result.faults |= dict.fromkeys(error.faults)
    if helm is None:
        services = (each for app in config.services.values() for each in app.values())
        result.not_rendered = dict.fromkeys((service.chart for service in services), MISSING)
    result.rendered = sorted(set(result.rendered))
    result.not_rendered = dict(sorted(result.not_rendered.items()))
    return result


def _render(
    helm: Helm,
    scratch: Path,
    folder: str,
    files: Mapping[str, str],
    releases: Sequence[tuple[ServiceRelease, bool]],
    state: State,
    result: RenderedCharts,
) -> None:
    home, file, config = scratch / "home", scratch / "values.json", state.config
    chart = scratch / "chart" / folder.rpartition("/")[2]
    try:
        for place, path in files.items():
            if place.rpartition("/")[2] != _SCHEMA:
                (chart / place).parent.mkdir(parents=True, exist_ok=True)
                (chart / place).write_bytes(config.files[path].encode())
    except OSError as error:
        message = f"{quoted(place)} cannot be written into a temporary folder for helm: "
        message += f"{error.strerror}; rename it, or make room there"
        raise InvalidInput.at("", message, file=folder) from None

    def add(report: Report) -> bool:
        for faults, into in ((report.faults, result.faults), (report.warnings, result.warnings)):
            for said in faults:
                place = said.file.partition("/")[2]  # helm's path starts with the chart's name
                into[said.within(files.get(place, f"{folder}/{place}".rstrip("/")))] = None
        return not report.faults

    linted, seen = False, set[str]()
    for release, is_example in releases:
        try:
            data = values_of(release, config, state.evaluate)
        except InvalidInput:  # only if an override holds the release's file, with older values
            continue
        text = json.dumps(data)
        if f"{release.name} {text}" in seen:
            continue
        seen.add(f"{release.name} {text}")
        if REAL.monotonic() > helm.end:
            message = f"is not rendered, because helm took more than {_MOST_SECONDS} s in all; "
            raise InvalidInput.at("", f"{message}make it simpler", file=folder)
        _check_libraries(state, folder, data)
        file.write_text(text)
        if not linted and not add(helm.lint(chart, file, home)):
            return
        linted = True
        result.rendered.append(release.service.chart)
        result.examples += is_example
        result.releases += not is_example
        report = helm.template(chart, file, home, release.name, release.domain.namespace)
        add(report)
        if not report.ended:
            return
        rules, apps = release.domain.rules, config.services
        names = [name for name, services in apps.items() if release.key.service in services]
        may_run = not rules or any(
            matches(name, rule.applications) for rule in rules for name in names
        )
        if not is_example or may_run:
            result.faults |= dict.fromkeys(kinds_refused(report, release, config))


def _check_libraries(state: State, folder: str, values: Mapping[str, Any]) -> None:
    """Check the values of the charts in ``charts/`` against their schemas, as Helm does."""
    files = state.config.files
    above = charts.merged(charts.defaults(folder, files), values)
    for dependency in charts.dependencies(folder, files):
        own = above.get(dependency.alias)
        if dependency.optional or not isinstance(own, dict | None):
            continue
        library = dependency.folder or f"{folder}/charts/{dependency.name}"
        try:
            charts.defaults(library, files)
        except InvalidInput:  # YAML that only Helm reads, for example with anchors
            continue
        inner = {"global": above.get("global", {}), **(own or {})}
        schema = f"{library}/{_SCHEMA}"
        if schema in files:
            state.evaluate(files, SchemaTask(schema, inner, f"{folder}/values.yaml"))
        if dependency.folder:
            _check_libraries(state, library, inner)


def kinds_refused(report: Report, release: ServiceRelease, config: Config) -> Iterator[Fault]:
    domain = release.domain
    allowed = {(entry.group, entry.kind) for entry in domain.allowed_kinds}
    for group, kind in report.kinds:
        if (group, kind) not in allowed:
            file = config.file_of(DOMAINS_FILE, domain.name)
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
