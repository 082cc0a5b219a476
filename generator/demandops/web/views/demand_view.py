"""The view of one demand: what it holds, and what would change if it were released."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from demandops import strict_yaml
from demandops.decision import decide
from demandops.demand.claim import Claim, requesters_of
from demandops.errors import InvalidInput, StateRepoError
from demandops.plan.views.release_causes import how_to_release, is_released_by_demand_id
from demandops.quoting import quoted
from demandops.render.changes.changeset import ReleaseChange
from demandops.settings import API_VERSION
from demandops.staterepo.reader import Reader
from demandops.web.situation import Situation


@dataclass(frozen=True, slots=True)
class Consequence:
    """What would change if a demand were released, and how to release it.

    ``how`` says in words how to release the demand. ``file`` is the text of a file for ``demandops
    request`` that releases the demand by its id; it is empty if ``how`` names another way.
    ``approval`` has the reasons why releasing the demand needs a person's approval. ``refused`` is
    the reason why the generator would refuse to release the demand, or empty.
    """

    releases: tuple[ReleaseChange, ...]
    how: str
    file: str
    approval: tuple[str, ...] = ()
    refused: str = ""


@dataclass(frozen=True, slots=True)
class ExplainedDemand:
    """A demand and its claims; ``releases`` are the names of the releases that it needs."""

    id: str
    claims: Sequence[Claim]
    requesters: tuple[str, ...]
    releases: Sequence[str]
    consequence: Consequence


def explained_demand(now: Situation, reader: Reader, id: str) -> ExplainedDemand:
    """Return a demand and what would change if it were released; refuse one that holds nothing."""
    claims = now.commit_state.claims_of_demands.get(id)
    if not claims:
        waiting = now.commit_state.state.ledger.waiting.values()
        is_waiting = any(demand.demand == id for demand in waiting)
        why = ", because it waits for room on a node" if is_waiting else ""
        raise StateRepoError(f"demand {quoted(id)} holds nothing{why}")
    requesters = requesters_of(claims)
    goal = {
        "apiVersion": API_VERSION,
        "kind": "Demand",
        "operation": "release",
        "demand": id,
        "requesters": list(requesters),
    }
    how = how_to_release(claims[0])
    file = strict_yaml.dump(goal) if is_released_by_demand_id(claims[0]) else ""
    try:
        read = reader.file_reader(now.commit_state.commit)
        decision = decide(now.commit_state.state, goal, now.now, read)
        consequence = Consequence(decision.releases, how, file, decision.approval)
    except InvalidInput as error:
        consequence = Consequence((), how, file, refused=str(error))
    releases = now.commit_state.releases_of_demands.get(id, [])
    return ExplainedDemand(id, claims, requesters, releases, consequence)
