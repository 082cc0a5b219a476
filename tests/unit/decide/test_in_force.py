"""Under overrides too, the generated files follow from the configuration and the ledger."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import yaml
from demandops.base.errors import Refused
from demandops.decide.bookkeeping import bookkeeping
from demandops.decide.state import rendered_files
from demandops.model.ledger.claim import OVERRIDE_PREFIX
from hypothesis import given
from hypothesis import strategies as st

from tests.appdefs.test_scaling import FOLLOWING
from tests.kit import plain_yaml
from tests.kit.chance import examples
from tests.kit.goals import CLOUD, EGO, STATION_CLOUD, application, connection, goal
from tests.kit.memory import MemoryRepo

HEAD = {"apiVersion": "demandops/v1", "kind": "Override", "reason": "why", "owner": "petra"}


def files(**overrides: Mapping[str, Any]) -> dict[str, str | None]:
    return {
        f"overrides/{name}.yaml": yaml.safe_dump(HEAD | dict(fields), sort_keys=False)
        for name, fields in overrides.items()
    }


TABLES = plain_yaml.beside(__file__)
CROWD = files(**TABLES["crowd"])
people = st.lists(
    st.sampled_from(["adam", "ada", "bob", "eve"]), min_size=1, max_size=2, unique=True
)


@st.composite
def demands(draw: st.DrawFn) -> tuple[str, Any]:
    """Return a random join or shutdown of an application and a connection."""
    who = draw(people)
    app = application(
        f"app/{draw(st.sampled_from('ab'))}",
        node=draw(st.sampled_from(["edge", "cloud"])),
        who=who,
        ego=[EGO] if draw(st.booleans()) else [],
        clouds=[draw(st.sampled_from([CLOUD, STATION_CLOUD]))],
    )
    vehicle = draw(st.sampled_from(["v1", "v2"]))
    link = connection(
        f"{vehicle}/edge", who=who, topics=[draw(st.sampled_from([CLOUD[0], EGO[0]]))]
    )
    return goal([app], [link], id=draw(st.sampled_from("xy")), shutdown=draw(st.booleans()))


@given(st.lists(demands(), max_size=14))
@examples(25)
def test_what_demands_leave_behind_follows_from_the_books(sent: list[Any]) -> None:
    books = MemoryRepo(CROWD | FOLLOWING)
    for made in sent:
        before = dict(books.files)
        try:
            books.send(made)
        except Refused:
            continue
        ledger = books.state.ledger
        generated = {p: t for p, t in books.files.items() if not p.startswith("ledger/")}
        standing = {p: t for p, t in before.items() if p.startswith(("clusters/", "bootstrap/"))}
        again = rendered_files(books.state, standing)
        assert {p: t for p, t in generated.items() if p in again} == again
        assert [p for p in generated if p.startswith("clusters/") and p not in again] == []
        entries = bookkeeping(books.state)
        told = {(one["id"], one["demand"]) for one in entries["suspended"]}
        for claim in ledger:
            suspended = "eve" in claim.requesters or claim.subject.id == "v2/edge"
            assert ((claim.subject.id, claim.demand) in told) is suspended
            if claim.demand.startswith(OVERRIDE_PREFIX):
                assert claim.requesters == ("petra",)
                assert ledger.claims_on(claim.subject) == (claim,), (
                    "a kept claim must be the only one"
                )
        for entry in entries["services"].values():
            assert (entry["service"], entry["node"]) != ("object-detection", "cloud")
        assert "v2/edge" not in entries["connections"]
