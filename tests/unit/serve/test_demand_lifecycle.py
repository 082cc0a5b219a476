"""A refused demand is told why it is not accepted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from demandops.base.errors import QueueFull
from demandops.base.runtime import REAL
from demandops.repo.write.journal import Journal
from demandops.serve.demand_lifecycle import Demands
from demandops.serve.queue import Ticket


@pytest.mark.parametrize(
    ("goal", "whose"), [({"requesters": ["one"]}, "of 'one'"), ({}, "without a requester")]
)
def test_too_many_demands_are_told_with_their_requester(
    tmp_path: Path, goal: dict[str, Any], whose: str
) -> None:
    demands = Demands(Journal(tmp_path / "journal"), 10, 1, REAL)
    tickets = [Ticket(name, goal, REAL.now()) for name in ("a", "b")]
    for ticket in tickets:
        demands.arrive(ticket)
    demands.take([], 0)
    with pytest.raises(QueueFull, match=f"^1 demands {whose} have no answer yet; "):
        tickets[1].future.result(0)
