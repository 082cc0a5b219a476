"""The golden cases: requests played on a state repo's files, in memory.

``tests/golden/<case>/requests/*.yaml`` are played in order; after each, everything below
``clusters/`` and ``ledger/`` stands in ``expected/<request>/``, as real files that a reviewer and
`kubectl` can read. A case may lay files over the skeleton's in ``state-repo/``.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from demandops import strict_yaml
from demandops.decision import State, rendered_files

from tests.kit.memory import MemoryRepo

HERE = Path(__file__).parent
EXPERIMENT = HERE.parent.parent / "examples" / "experiment"

CASES = (
    "experiment",
    "differing-topic-names",
    "charts-from-registries",
    "mqtt-secured",
    "zenoh",
    "ros",
    "argocd-experiment",
    "argocd-charts-from-registries",
    "overrides",
)


def requests_of(case: str) -> list[Path]:
    """Return the request files of a case, in order; the experiment's are the example's."""
    folder = EXPERIMENT if case.endswith("experiment") else HERE / case / "requests"
    return sorted(folder.glob("*.yaml"))


def start(case: str) -> tuple[State, dict[str, str]]:
    """Return the state before the first request, and the generated files."""
    overlay = HERE / case / "state-repo"
    files = {p.relative_to(overlay).as_posix(): p.read_text() for p in overlay.rglob("*.yaml")}
    state = MemoryRepo(files).state
    return state, rendered_files(state)


def play(case: str) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield (request name, all generated files) after each request."""
    repo = MemoryRepo(state=start(case)[0])
    for file in requests_of(case):
        repo.send(strict_yaml.load(file.read_text()))
        yield file.stem, dict(repo.files)
