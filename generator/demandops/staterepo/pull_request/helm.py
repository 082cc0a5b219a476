"""Runs ``helm`` on charts, and parses its output: kinds of rendered objects, or faults.

Helm gets a home folder of its own, and has no access to a cluster or to chart repositories.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from demandops.errors import Fault, fault
from demandops.quoting import quoted
from demandops.staterepo.git import child_processes

HELM_BIN = "HELM_BIN"
"""The environment variable that names the program, instead of ``helm`` on ``PATH``."""

_SECONDS = 120
_MOST = 400
_API = re.compile(r"(?m)^apiVersion: *[\"']?([^\s\"']+)")
_KIND = re.compile(r"(?m)^kind: *[\"']?([^\s\"']+)")
_LINT = re.compile(r"\[(?P<level>ERROR|WARNING)\] (?P<text>.*)")
_PLACE = re.compile(
    r"(?P<path>[A-Za-z0-9][\w.-]*/(?:charts/[\w.-]+/)*templates/[\w./-]+?)(?::(?P<line>\d{1,9}))?(?=[:)\s])"
)


@dataclass(frozen=True, slots=True)
class Report:
    """Helm's output for a chart: API group and kind of each rendered object; faults; warnings."""

    kinds: tuple[tuple[str, str], ...] = ()
    faults: tuple[Fault, ...] = ()
    warnings: tuple[Fault, ...] = ()


@dataclass(frozen=True, slots=True)
class Helm:
    """The installed program ``helm``, and a folder for its files."""

    program: str
    home: Path

    @staticmethod
    def find(home: Path) -> Helm | None:
        """Return the program that ``HELM_BIN`` names, or None if there is none.

        If ``HELM_BIN`` is not set, return ``helm`` on ``PATH``. ``home`` is helm's home folder.
        """
        program = shutil.which(os.environ.get(HELM_BIN) or "helm")
        return Helm(program, home) if program else None

    def lint(self, chart: Path, values: Path) -> Report:
        """Return the faults and warnings of ``helm lint``."""
        code, out, err = self._run("lint", str(chart), f"--values={values}")
        found = parsed_lint(out, chart.name)
        if code != 0 and not found.faults:
            return Report(faults=(parsed_error(err or out, chart.name),))
        return found

    def template(self, chart: Path, values: Path, release: str, namespace: str) -> Report:
        """Render the chart for a release, and return the kinds of the objects, or a fault."""
        code, out, err = self._run(
            *("template", release, str(chart), "--include-crds", "--skip-tests"),
            *(f"--namespace={namespace}", f"--values={values}"),
        )
        if code != 0:
            return Report(faults=(parsed_error(err, chart.name),))
        return Report(tuple(parsed_kinds(out)))

    def _run(self, *arguments: str) -> tuple[int, str, str]:
        environment = {
            "PATH": os.environ.get("PATH", os.defpath),
            "HOME": str(self.home),
            "KUBECONFIG": os.devnull,
            "HELM_PLUGINS": str(self.home / "plugins"),
            **child_processes.mark(),
        }
        try:
            done = subprocess.run(
                [self.program, *arguments],
                env=environment,
                capture_output=True,
                check=False,
                timeout=_SECONDS,
            )
        except subprocess.TimeoutExpired:
            return 1, "", f"Error: helm did not end within {_SECONDS} s"
        out, err = (text.decode("utf-8", "replace") for text in (done.stdout, done.stderr))
        return done.returncode, out, err


def parsed_kinds(out: str) -> Iterator[tuple[str, str]]:
    """Yield API group and kind of each object that ``helm template`` printed."""
    for document in re.split(r"(?m)^---$", out):
        api, kind = _API.search(document), _KIND.search(document)
        if kind:
            yield api[1].rpartition("/")[0] if api else "", kind[1]


def parsed_lint(out: str, chart: str) -> Report:
    """Return the faults and warnings in the output of ``helm lint``.

    A fault whose template helm does not name is located at ``chart``, the chart's folder.
    """
    found: dict[str, list[Fault]] = {"ERROR": [], "WARNING": []}
    for entry in re.split(r"\n(?=\[|\n)", out):
        match = _LINT.match(entry.strip())
        if match:
            found[match["level"]].append(_fault(entry.strip()[match.start("text") :], chart))
    return Report(faults=tuple(found["ERROR"]), warnings=tuple(found["WARNING"]))


def parsed_error(err: str, chart: str) -> Fault:
    """Return helm's error message as a fault, located at the last template and line in it.

    If helm names no template, the fault is located at ``chart``.
    """
    text = err.partition("Error: ")[2] or err
    return _fault(text.partition("\n\nUse --debug")[0].strip(), chart)


def _fault(text: str, chart: str) -> Fault:
    places = [*_PLACE.finditer(text)]
    place = places[-1] if places else None
    file = place["path"] if place else chart
    line = int(place["line"]) if place and place["line"] else None
    said = quoted(" ".join(text.split()), _MOST)
    return fault("", f"helm says {said}; fix the chart or its values", line=line).within(file)
