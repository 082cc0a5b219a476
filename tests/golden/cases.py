"""The golden cases: requests played in memory on a state repo, and the files that they must render.

The requests are ``tests/golden/<case>/requests/*.yaml``, in order. ``expected/<step>/`` has the
files that a step writes, as real files that a reviewer and `kubectl` can read. If a step deletes
files, the file ``DELETED`` in its folder lists their paths. The first step, ``0-start``, is what
`init` renders. The YAML files in a case's ``state-repo/`` replace or extend the skeleton's files.

The folder of a step has these files:

- the start of ``experiment``: all files.
- the start of another case: the files that differ from the start of ``experiment``.
- a later step: the files that differ from the step before.
- a later step of a case in ``FOLLOWING``, which plays the requests of ``experiment``: the changes
  that differ from the changes of the same step of ``experiment``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path

from demandops.base import strict_yaml
from demandops.decide.state import State, rendered_files

from tests.kit import goals
from tests.kit.config import texts_below
from tests.kit.memory import MemoryRepo

Files = Mapping[str, str]

GOLDEN = Path(__file__).parent

EXPERIMENT = "experiment"
FOLLOWING = ("argocd-experiment",)
CASES = tuple(sorted(path.name for path in GOLDEN.glob("[a-z]*") if path.is_dir()))
START = "0-start"
DELETED = "DELETED"


# ---- what is rendered ----


def requests_of(case: str) -> list[Path]:
    if case in (EXPERIMENT, *FOLLOWING):
        return list(goals.EXPERIMENT)
    return sorted((GOLDEN / case / "requests").glob("*.yaml"))


def start(case: str) -> tuple[State, dict[str, str]]:
    state = MemoryRepo(texts_below(GOLDEN / case / "state-repo")).state
    return state, rendered_files(state)


def play(case: str) -> Iterator[tuple[str, MemoryRepo]]:
    """Yield each step's name and the state repo after it."""
    repo = MemoryRepo(state=start(case)[0])
    yield START, repo
    for file in requests_of(case):
        repo.send(strict_yaml.load(file.read_text()))
        yield file.stem, repo


@lru_cache
def rendered(case: str) -> Mapping[str, Files]:
    return {name: dict(repo.files) for name, repo in play(case)}


# ---- what is stored ----


def read(case: str) -> dict[str, dict[str, str]]:
    steps: dict[str, dict[str, str]] = {}
    for path, text in texts_below(GOLDEN / case / "expected").items():
        step, _, name = path.partition("/")
        steps.setdefault(step, {})[name] = text
    return steps


def to_store(case: str) -> dict[str, dict[str, str]]:
    """Return the files that ``expected/`` must have, by step; steps without a change are absent."""
    steps: dict[str, dict[str, str]] = {}
    before: Files = {}
    for step, files in rendered(case).items():
        if change := _change(_base(case, step, before), files):
            steps[step] = change
        before = files
    return steps


def _base(case: str, step: str, before: Files) -> dict[str, str]:
    if case == EXPERIMENT or (step != START and case not in FOLLOWING):
        return dict(before)
    steps: dict[str, Files] = {"": {}, **rendered(EXPERIMENT)}
    previous = list(steps)[list(steps).index(step) - 1]
    change = _change(steps[previous], steps[step])
    gone = change.pop(DELETED, "").splitlines()
    return {path: text for path, text in {**before, **change}.items() if path not in gone}


def _change(before: Files, after: Files) -> dict[str, str]:
    change = {path: text for path, text in after.items() if before.get(path) != text}
    if gone := sorted(set(before) - set(after)):
        change[DELETED] = "".join(f"{path}\n" for path in gone)
    return change
