"""Runs ``helm`` on charts, and parses its output: kinds of rendered objects, or faults.

The charts are those of a pull request, so their author may be hostile. Helm gets an empty home
folder, no secrets of the environment, no access to a cluster or to chart repositories, limits of
time, memory and output, and no network where the kernel allows that.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from demandops.base.errors import Fault, fault
from demandops.base.quoting import quoted
from demandops.repo.git import child_processes
from demandops.repo.merge_check import confined_process

# The environment variable that names the program, instead of ``helm`` on ``PATH``.
HELM_BIN = "HELM_BIN"

# helm renders a chart in a tenth of a second. The limit of processor time ends a chart that loops,
# also on a busy machine; the other one ends a helm that waits.
_CPU_SECONDS = 30
_SECONDS = 300
_MOST_OUTPUT = 16 << 20
# Patterns search the text of a message, whose length is the author's choice.
_MOST_MESSAGE = 4_000
_MOST_LINT = 100_000
_MOST = 400
_API = re.compile(r"(?m)^[\"']?apiVersion[\"']?\s*: *[\"']?([^\s\"']+)")
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

    @staticmethod
    def find() -> Helm | None:
        program = shutil.which(os.environ.get(HELM_BIN) or "helm")
        return Helm(str(Path(program).absolute())) if program else None

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
        command = [
            sys.executable,
            "-IS",
            confined_process.__file__,
            str(_CPU_SECONDS),
            self.program,
        ]
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
                    timeout=_SECONDS,
                ).returncode
            except subprocess.TimeoutExpired:
                code = -1
        if code not in (0, 1):  # a signal, or 2 from Go, for example if it gets no memory
            limits = f"{_CPU_SECONDS} s or {confined_process.MEMORY >> 30} GiB"
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
        api, kind = _API.search(document), _KIND.search(document)
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
    said = quoted(" ".join(text.split()), _MOST)
    return fault("", f"helm says {said}; fix the chart or its values", line=line).within(file)
