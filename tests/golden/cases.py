"""The golden cases: requests played on a state repo's files, in memory.

``tests/golden/<case>/requests/*.yaml`` are played in order; after each, everything below
``clusters/`` and ``ledger/`` stands in ``expected/<request>/``, as real files that a reviewer and
`kubectl` can read. A case may lay files over the skeleton's in ``state-repo/``.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime, timezone
from pathlib import Path

from demandops import strict_yaml
from demandops.config.config import CONFIG_ROOTS
from demandops.config.load import load
from demandops.decision import State, decide, rendered_files
from demandops.ledger.ledger import Ledger
from demandops.staterepo import new_repo

HERE = Path(__file__).parent
EXPERIMENT = HERE.parent.parent / "examples" / "experiment"
NOW = datetime(2026, 1, 31, 12, 0, tzinfo=timezone.utc)

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
    files = new_repo.files()
    overlay = HERE / case / "state-repo"
    for path in sorted(overlay.rglob("*.yaml")):
        files[path.relative_to(overlay).as_posix()] = path.read_text()
    config = load({p: text for p, text in files.items() if p.split("/")[0] in CONFIG_ROOTS})
    state = State.of(config, Ledger())
    return state, rendered_files(state)


def play(case: str) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield (request name, all generated files) after each request."""
    state, world = start(case)
    for file in requests_of(case):
        decision = decide(state, strict_yaml.load(file.read_text()), NOW, world.get)
        state = decision.state
        for path, text in decision.files.items():
            if text is None:
                del world[path]
            else:
                world[path] = text
        yield file.stem, dict(world)
