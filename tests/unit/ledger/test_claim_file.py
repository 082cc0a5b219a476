"""A claim's file contains the whole claim, whatever characters its ids have."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone
from random import Random

import pytest
from demandops.base.errors import InvalidInput
from demandops.base.naming import Subject, SubjectKind, id_problem
from demandops.connections.connection import Connection, Route, merged_routes
from demandops.connections.connection_types import CONNECTION_TYPES
from demandops.model.demand.demand import (
    LONGEST_S,
    Application,
    Delivery,
    InputTopic,
    Lease,
)
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger.claim import Claim, ClaimKey
from demandops.model.ledger.ledger import Ledger
from hypothesis import given
from hypothesis import strategies as st

from tests.kit import plain_yaml
from tests.kit.chance import chances, examples, visible
from tests.kit.memory import rebuilt

TRICKY = [
    "null", "~", "yes", "on", "1", "1e3", "0x1f", "1_000", "12:30:45", "2026-01-31", ".inf", "<<",
    "- a", "? a", "a: b", "#", "a #b", "'", '"', "\\n", "{a}", "[a]", "&a", "*a", "!a", "%a", "=",
    "@", " a", "a ", "---", "...", "é", "e\u0301", "😀", "a" * 1024,
]  # fmt: skip
ids = st.one_of(st.sampled_from(TRICKY), st.text(visible, min_size=1, max_size=20)).filter(
    lambda text: not id_problem(text)
)
topics = st.from_regex(r"(/[a-zA-Z_][a-zA-Z0-9_]{0,6}){1,3}", fullmatch=True)
zones = [timezone(timedelta(hours=hours, minutes=45)) for hours in (-11, 5)]
moments = st.datetimes(
    datetime(1, 1, 3),
    datetime(2100, 1, 1),
    timezones=st.sampled_from([timezone.utc, *zones]),
)
leases = st.none() | st.builds(Lease, st.integers(1, LONGEST_S), st.integers(0, LONGEST_S), moments)
people = st.lists(ids, min_size=1, max_size=4, unique=True).map(lambda who: tuple(sorted(who)))
deliveries = st.builds(Delivery, ids, ids, st.just("") | topics)
routes = st.builds(
    Route,
    topics,
    topics,
    type=st.sampled_from(["", "std_msgs/msg/String"]),
    reverse=st.booleans(),
    qos=st.integers(0, 2),
    retained=st.booleans(),
    primitive=st.booleans(),
    reliability=st.sampled_from(["", "reliable", "best_effort"]),
    durability=st.sampled_from(["", "volatile", "transient_local"]),
    queue=st.integers(0, 1000),
    rate=st.sampled_from([0.0, 0.5, 10.0]),
)
words = ids | st.text(st.characters(codec="utf-8"))
values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | words,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words, inner, max_size=3),
    max_leaves=6,
)
# sorted, and only one of those with the same name and source
inputs = st.lists(
    st.builds(InputTopic, topics, ids, st.just("") | ids),
    min_size=1,
    max_size=4,
    unique_by=lambda one: (one.topic, one.source),
).map(lambda found: tuple(sorted(found)))
applications = st.builds(
    Application,
    id=ids,
    appdef=ids,
    node=ids,
    inputs=st.dictionaries(st.sampled_from(["ego_data", "point_cloud", "radar"]), inputs).map(
        lambda found: dict(sorted(found.items()))
    ),
    parameters=st.dictionaries(ids.filter(lambda name: len(name) < 100), values, max_size=3),
    version=st.sampled_from(["", "1.0.0", "1e3", "0x10", "next", "on", "2024-01-01"]),
    deliver=st.sets(deliveries, max_size=2).map(lambda found: tuple(sorted(found))),
)
connections = st.builds(
    Connection,
    id=ids,
    type=st.sampled_from(CONNECTION_TYPES),
    source=ids,
    target=ids,
    broker=st.just("") | ids,
    topics=st.lists(routes, min_size=1, max_size=4).map(merged_routes),
)


claims = st.builds(
    Claim,
    held=applications | connections,
    demand=ids,
    request=st.just("") | ids,
    requesters=people,
    booked=moments,
    lease=leases,
    joined=st.booleans(),
)


@examples(50)
@given(claims)
def test_every_claim_survives_its_file(claim: Claim) -> None:
    path, text = claim_files.path_of(claim.key), claim_files.text_of(claim)

    read = claim_files.read(text.encode().decode(), path)

    assert read == claim
    if claim.is_on_application:  # 1, 1.0 and True are equal in Python, so compare their texts
        parameters = (sorted(held.application.parameters.items()) for held in (read, claim))
        assert len(set(map(repr, parameters))) == 1
    assert claim_files.text_of(read) == text
    assert claim_files.kind_of(path) is claim.subject.kind
    assert path.isascii()
    assert all(0 < len(part) <= 100 for part in path.split("/"))


@examples(30)
@given(st.dictionaries(st.tuples(st.sampled_from(SubjectKind), ids, ids), st.none(), min_size=2))
def test_two_claims_never_share_a_file(keys: dict[tuple[SubjectKind, str, str], None]) -> None:
    paths = {
        claim_files.path_of(ClaimKey(Subject(kind, subject), demand)).lower()
        for kind, subject, demand in keys
    }
    assert len(paths) == len(keys)


def everything(ledger: Ledger) -> tuple[object, ...]:
    return ledger.claims, ledger.index, ledger.minutes


@examples(35)
@given(st.lists(claims, max_size=8), chances)
def test_a_ledger_is_the_same_in_whatever_order_it_was_built(
    claims: list[Claim], random: Random
) -> None:
    ledger = rebuilt(claims)
    for claim in random.sample(claims, len(claims) // 2):
        ledger = ledger.replace(claim.key, None)
    rest = list(ledger)
    assert everything(ledger) == everything(rebuilt(random.sample(rest, len(rest))))
    ends = [claim.lease.expires_at for claim in rest if claim.lease]
    assert ledger.next_lease_end() == min(ends, default=None)
    for now in ends:
        gone = [claim.lease.expires_at for claim in ledger.ended_claims(now) if claim.lease]
        assert gone == sorted(end for end in ends if end < now)
    for claim in rest:
        ledger = ledger.replace(claim.key, None)
    assert everything(ledger) == everything(Ledger())


CASES = plain_yaml.beside(__file__)


@pytest.mark.parametrize("case", CASES["older"])
def test_a_claim_of_an_older_schema_is_read_as_the_present_one(case: dict[str, str]) -> None:
    claims = [claim_files.read(case[schema], case["path"]) for schema in ("written", "now")]
    assert claims[0] == claims[1]


@pytest.mark.parametrize("case", CASES["refused"], ids=lambda case: case["says"])
def test_a_claim_that_a_person_edited_is_read_strictly(case: dict[str, str]) -> None:
    assert case["old"] in CASES["edited"]
    with pytest.raises(InvalidInput) as invalid:
        claim_files.read(CASES["edited"].replace(case["old"], case["new"]), CASES["path"])
    (found,) = invalid.value.faults
    assert (found.file, found.field) == (CASES["path"], case["field"])
    assert case["says"] in found.message


def test_a_version_of_any_length_is_a_fault() -> None:
    with pytest.raises(InvalidInput):
        claim_files.read(CASES["edited"].replace("/v3", f"/v{'9' * 5000}"), CASES["path"])


def test_half_a_character_in_a_forged_trailer_has_a_path_segment() -> None:
    assert claim_files.segment("\ud800") != claim_files.segment("\ud801")
