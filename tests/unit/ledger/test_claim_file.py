"""A claim's file contains the whole claim, whatever characters its ids have."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta, timezone
from random import Random

import pytest
from demandops.base.errors import Fault, InvalidInput
from demandops.base.naming import Subject, SubjectKind, id_problem
from demandops.connections.connection import Connection, Route, merged_routes
from demandops.connections.connection_types import CONNECTION_TYPES
from demandops.connections.mqtt import MQTT
from demandops.model.config.base_model import time_text
from demandops.model.demand.demand import (
    LONGEST_S,
    Application,
    Delivery,
    InputTopic,
    Lease,
    Requirement,
)
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger.claim import Claim, ClaimKey, demand_id
from demandops.model.ledger.ledger import Ledger
from hypothesis import given
from hypothesis import strategies as st

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
    datetime(2000, 1, 1),
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
    parameters=st.dictionaries(ids, values, max_size=3),
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


AT = datetime(2026, 1, 31, tzinfo=timezone.utc)
LINK = Connection("a", MQTT, "d", "e", "", (Route("/a", "/b"), Route("/c", "/d")))


def edited(claim: Claim, *changes: tuple[str, str]) -> Claim:
    """Write a claim's file, replace texts in it as a person may, and return the claim it has."""
    text = claim_files.text_of(claim)
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return claim_files.read(text, claim_files.path_of(claim.key))


def fault_of(claim: Claim, *changes: tuple[str, str]) -> Fault:
    with pytest.raises(InvalidInput) as invalid:
        edited(claim, *changes)
    (found,) = invalid.value.faults
    assert found.file == claim_files.path_of(claim.key)
    return found


OF_A_CONNECTION = """apiVersion: demandops.ledger/{version}
kind: ConnectionClaim
connection: a
demand: {demand}
request: r
requesters:
- c
- e
booked: "2026-01-31T00:00:00.000000Z"
type: mqtt
source: d
target: e
topics:
  /a:
    target: /b
    requesters:
    - e
  /c: /d
"""
OF_AN_APPLICATION = """apiVersion: demandops.ledger/v2
kind: ApplicationClaim
application: a
demand: d
request: r
requesters:
- c
- e
booked: "2026-01-31T00:00:00.000000Z"
action: DeploymentRequest
definition: object-detection-fusion
node: edge
inputs:
  point_cloud:
  - topic: /a
    source: v
    requesters:
    - e
  - topic: /b
    source: v
place:
  labels:
    zone: north
"""


@pytest.mark.parametrize(
    ("demand", "version", "joined"),
    [(demand_id("r", "ce"), "v1", True), ("d", "v1", False), (demand_id("r", "ce"), "v2", False)],
)
def test_a_claim_on_a_connection_of_an_older_schema_is_read(
    demand: str, version: str, joined: bool
) -> None:
    claim = Claim(LINK, demand, "r", ("c", "e"), AT, joined=joined)
    text = OF_A_CONNECTION.format(version=version, demand=demand)
    assert claim_files.read(text, claim_files.path_of(claim.key)) == claim


def test_a_claim_on_an_application_of_an_older_schema_is_read() -> None:
    inputs = {"point_cloud": (InputTopic("/a", "v"), InputTopic("/b", "v"))}
    place = Requirement(labels=("zone=north",))
    held = Application("a", "object-detection-fusion", "edge", inputs, place=place)
    claim = Claim(held, "d", "r", ("c", "e"), AT, joined=True)
    assert claim_files.read(OF_AN_APPLICATION, claim_files.path_of(claim.key)) == claim


@pytest.mark.parametrize(
    ("written", "edit", "problem"),
    [
        ("booked", "0001-01-01T00:00:00+23:59", "is a time that does not exist"),
        ("booked", "2026-01-31", "is not a time with a time zone"),
        ("until", "9999-12-31T23:59:59Z", "is after the year 8999"),
    ],
)
def test_a_time_that_cannot_be_reckoned_with_is_refused(
    written: str, edit: str, problem: str
) -> None:
    times = {"booked": AT, "until": AT.replace(day=30)}
    claim = Claim(LINK, "d", "r", ("c",), AT, Lease(1, LONGEST_S, times["until"]))
    found = fault_of(claim, (time_text(times[written]), edit))
    assert problem in found.message


def test_a_claim_of_any_year_survives_its_file() -> None:
    claim = Claim(LINK, "d", "r", ("c",), AT.replace(year=7))
    assert edited(claim) == claim


def test_half_a_character_in_a_forged_trailer_has_a_path_segment() -> None:
    assert claim_files.segment("\ud800") != claim_files.segment("\ud801")


def test_topics_stay_readable() -> None:
    topics = (Route("/a", "/b"), Route("/b", "/c", qos=1, rate=0.5))
    text = claim_files.text_of(Claim(replace(LINK, topics=topics), "d", "r", ("v",), AT))
    assert text.endswith(
        "topics:\n  - source: /a\n    target: /b\n"
        "  - source: /b\n    target: /c\n    qos: 1\n    rate: 0.5\n"
    )


@pytest.mark.parametrize(
    ("written", "field", "problem"),
    [
        ("{source: /a, qso: 1}", ".qso", "is not a field here"),
        ("{source: /a, qos: 7}", ".qos", "input should be less than or equal to 2"),
        ("{source: /a, qos: true}", ".qos", "must be a whole number"),
        ("{source: /a, reverse: 1}", ".reverse", "must be true or false, not 1"),
        ("[/b]", "", "must be a mapping, not ['/b']"),
    ],
)
def test_routes_are_read_strictly(written: str, field: str, problem: str) -> None:
    found = fault_of(Claim(LINK, "d", "r", ("c",), AT), ("source: /a\n    target: /b", written))
    assert found.field == f"connection.topics[0]{field}"
    assert found.message.startswith(problem)


def test_a_claim_of_a_type_that_is_open_is_not_read() -> None:
    claim = Claim(LINK, "d", "r", ("c",), AT)
    assert fault_of(claim, ("type: mqtt", "type: auto")).field == "connection"
