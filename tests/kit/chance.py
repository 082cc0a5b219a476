"""Settings of Hypothesis: by default the same examples every time, so no build fails by chance.

``make test`` tries a third of the examples, ``DEMANDOPS_EXAMPLES=1`` all, and
``DEMANDOPS_EXAMPLES=20`` twenty times as many, and different ones each time.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from itertools import count
from typing import Any

from hypothesis import HealthCheck, Phase, note, settings
from hypothesis import strategies as st

from tests.kit.goals import Goal

IN_FULL = "DEMANDOPS_EXAMPLES" in os.environ
TIMES = int(os.environ.get("DEMANDOPS_EXAMPLES", "1"))

chances = st.randoms(use_true_random=False)
visible = st.characters(exclude_categories=["C", "Z"], include_characters=" ")
"""Characters that an id may contain."""


def examples(count: int) -> Callable[[Any], Any]:
    """Return a decorator for a test that in full tries ``count`` examples."""
    return settings(
        max_examples=count * TIMES if IN_FULL else -(-count // 3),
        derandomize=TIMES == 1,
        database=None,
        phases=[Phase.explicit, Phase.generate, Phase.shrink],
        deadline=None,
        suppress_health_check=[
            HealthCheck.too_slow,
            HealthCheck.data_too_large,
            HealthCheck.function_scoped_fixture,
        ],
    )


def told(requests: list[Goal]) -> list[Goal]:
    """Return the requests unchanged; if the test fails, Hypothesis prints their summaries."""
    for request in requests:
        note(json.dumps({key: what for key, what in request.items() if what not in ([], False)}))
    return requests


def rival(id: str, name_of: Callable[[str], str]) -> str:
    """Return another id with the same name; the fixture ``short_digests`` lets chance find one."""
    others = (f"{id}/{'-' * number}" for number in count(1))
    return next(other for other in others if name_of(other) == name_of(id))
