"""Everything that tests of generators on real state repos need, gathered in one module."""
# ruff: noqa: F401

from tests.kit.generator import (
    Gate,
    Proposed,
    Stages,
    book,
    busy,
    journaled,
    leave_in_journal,
    outcome,
    receipt,
    restart,
    running,
    wait_until,
    wait_until_queued,
)
from tests.kit.goals import Goal, impossible, leave
from tests.kit.goals import numbered as goal
from tests.kit.limits import PATIENCE_S
from tests.kit.memory import NOW, books_after
from tests.kit.processes import Drivers, Run, Told, demand, listen_to_all
from tests.kit.repo import (
    GIT_ENVIRONMENT,
    Commit,
    Person,
    assert_sound,
    away,
    books,
    branches,
    claims,
    commits,
    differing,
    git,
    hook,
    init,
    operations,
    root,
    tip,
    without_vehicle01,
)
