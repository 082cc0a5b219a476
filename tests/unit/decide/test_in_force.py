"""Under overrides too, the generated files follow from the configuration and the ledger."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
import yaml
from demandops.base.errors import InvalidInput, Refused
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


def after(books: MemoryRepo, changed: dict[str, str | None]) -> dict[str, str]:
    """Return the files when the configuration of a repo with releases is changed."""
    state = replace(MemoryRepo(changed).state, ledger=books.state.ledger)
    return rendered_files(state, books.files)


DETECTION = "clusters/c-its/perception/edge/od-edge-vehicle00.yaml"
HOLD = {"select": [{"services": ["object-detection"]}], "hold": True}


@pytest.mark.parametrize(("priority", "changes"), [(1, True), (-1, False)])
def test_only_an_override_of_higher_priority_than_a_hold_changes_the_held_release(
    priority: int, changes: bool
) -> None:
    books = MemoryRepo()
    books.send(goal([application()]))
    more = {"select": [{"nodes": ["edge"]}], "replicas": 4, "priority": priority}
    held = after(books, files(held=HOLD, more=more))[DETECTION]
    assert (yaml.safe_load(held) != yaml.safe_load(books.files[DETECTION])) is changes


@pytest.mark.parametrize(("select", "fields"), TABLES["denied"], ids=str)
def test_a_denial_names_the_field_the_override_its_reason_and_its_owner(
    select: dict[str, Any], fields: list[str]
) -> None:
    expires = "2090-01-01T00:00:00Z"
    books = MemoryRepo(files(tested={"select": [select], "deny": True, "expires": expires}))
    told = (
        f"is denied by overrides/tested.yaml until {expires}: why; ask the override's owner, petra"
    )
    found = books.faults(goal([application()], [connection()]))
    assert [one.partition(", or")[0] for one in found] == [f"{field}: {told}" for field in fields]


def test_a_refusal_names_the_override_that_breaks_the_demand() -> None:
    """``check`` tries a patch only with an invented demand, so ``check`` can miss a mistake."""
    fields = {"select": [{"services": ["object-detection"]}], "values": {"replicas": {"x": 1}}}
    books = MemoryRepo(files(tested=fields))
    with pytest.raises(InvalidInput) as refusal:
        books.send(goal([application()]))
    (found,) = refusal.value.faults
    assert (found.file, found.field) == ("overrides/tested.yaml", "values.replicas")
    assert "fix the override or appdefs/" in found.message


REGISTRY = """\
apiVersion: demandops/v1
kind: Charts
charts:
  object-detection: {oci: "oci://registry.example/charts/object-detection", version: %s}
  object-fusion: {http: "https://charts.example/perception", version: %s}
"""


@pytest.mark.parametrize("held", [True, False])
def test_a_held_release_keeps_its_chart_when_the_registry_moves_on(held: bool) -> None:
    books = MemoryRepo({"registry/charts.yaml": REGISTRY % ("1.0.0", "2.0.0")})
    books.send(goal([application()]))
    newer = {"registry/charts.yaml": REGISTRY % ("1.1.0", "2.1.0")}
    found = after(books, newer | (files(held=HOLD) if held else {}))
    charts = "clusters/c-its/perception/_charts/object-detection"
    assert (f"{charts}-1.0.0.yaml" in found) is held
    assert f"{charts}-1.1.0.yaml" in found
    assert ("object-detection-1.0.0" in found[DETECTION]) is held
