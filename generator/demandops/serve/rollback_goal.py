"""A rollback as a goal: plain data that passes through queue and journal like a demand.

Only the command line makes this goal; actions and request files cannot contain it. The goal is
evaluated on the newest tip, so a rollback works while others write. What others book until then
counts as newer than the commit to roll back to.
"""

from __future__ import annotations

from typing import Any

from demandops.base.errors import Refused, fault
from demandops.base.settings import API_VERSION
from demandops.decide.booking.restoration import Restoration
from demandops.repo.git.repository import StateRepository
from demandops.repo.load.ledger_files import restoration
from demandops.repo.load.snapshot import Snapshot

_KIND = "Rollback"


def goal(to: str, *, drop_newer: bool, reason: str, who: tuple[str, str]) -> dict[str, Any]:
    """Return the goal to book the claims of the commit ``to`` again."""
    return {
        "apiVersion": API_VERSION,
        "kind": _KIND,
        "to": to,
        "dropNewer": drop_newer,  # without it, newer claims make the rollback fail
        "reason": " ".join(reason.split()),
        "by": list(who),
    }


def is_rollback(goal: object) -> bool:
    return isinstance(goal, dict) and goal.get("kind") == _KIND


def to_restoration(
    goal: dict[str, Any], repository: StateRepository, head: Snapshot
) -> Restoration:
    """Return the restoration that a goal requests; Refused if ``head`` lacks its commit."""
    to = str(goal["to"])
    if not repository.includes(str(head.commit), to):
        message = f"commit {to} is not in the history of the state repo; roll back to one that is"
        raise Refused([fault("", message)])
    by, email = goal["by"]
    more = {"drop_newer": bool(goal["dropNewer"]), "reason": goal["reason"]}
    return restoration(repository.objects, to, **more, by=by, email=email)
