"""Routes in claims: their form in files, contradictions, and the nodes that connections link."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timezone
from typing import Any

import pytest
import yaml
from demandops.base.errors import InvalidInput, Refused
from demandops.connections.connection import Connection, ConnectionType, Route, merged_routes
from demandops.connections.mqtt import MQTT
from demandops.connections.ros import ROS
from demandops.connections.zenoh import ZENOH
from demandops.decide.booking import apply
from demandops.model.demand.claim import Claim, demand_id
from demandops.model.demand.demand_request import Demanded, Join
from demandops.model.ledger import claim_file
from demandops.model.ledger.ledger import Ledger

NOW = datetime(2026, 1, 31, 12, 0, tzinfo=timezone.utc)
STRING = "std_msgs/msg/String"


def claim(*routes: Route) -> Claim:
    held = Connection("c", MQTT, "s", "t", "", merged_routes(routes))
    return Claim(held, demand_id("r", ["v"]), "r", ("v",), NOW)


def joined(ledger: Ledger, *routes: Route, who: str = "v", **more: Any) -> Ledger:
    asked = replace(Connection("c", MQTT, "s", "t", "", routes), **more)
    request = Join("r", (Demanded(asked, (who,), "connections[0].{}".format),))
    return apply(ledger, request, NOW)[0]


def refusal(ledger: Ledger, *routes: Route, who: str = "w") -> list[str]:
    with pytest.raises(Refused) as refused:
        joined(ledger, *routes, who=who)
    return [f"{found.field}: {found.message}" for found in refused.value.faults]


class TestFiles:
    """In a claim's file, a route without options is one line. Other routes list their options."""

    def test_topics_stay_readable(self) -> None:
        held = claim(Route("/b", "/c", qos=1, rate=0.5), Route("/a", "/b"))
        text = claim_file.text_of(held)
        assert text.endswith(
            "topics:\n  /a: /b\n  /b:\n    target: /c\n    qos: 1\n    rate: 0.5\n"
        )
        assert claim_file.read(text, claim_file.path_of(held.key)) == held

    @pytest.mark.parametrize(
        ("written", "expected"),
        [
            ("{qos: 1}", "topics./a.target: is missing; add it"),
            (
                "{target: /b, qso: 1}",
                "topics./a.qso: is not a field here; remove it or correct its",
            ),
            ("{target: /b, qos: 7}", "topics./a.qos: input should be less than or equal to 2"),
            ("{target: /b, reverse: 1}", "topics./a.reverse: must be true or false, not 1"),
            ("[/b]", "topics./a: must be a mapping, not ['/b']"),
            ("5", "topics./a: must be a mapping, not 5"),
        ],
    )
    def test_they_are_read_strictly(self, written: str, expected: str) -> None:
        held = claim(Route("/a", "/b"))
        text = claim_file.text_of(held).replace("/a: /b", f"/a: {written}")
        path = claim_file.path_of(held.key)
        with pytest.raises(InvalidInput) as invalid:
            claim_file.read(text, path)
        (found,) = invalid.value.faults
        assert str(found).startswith(f"{path}: {expected}")

    def test_a_claim_of_a_type_that_is_open_is_not_read(self) -> None:
        held = claim(Route("/a", "/b"))
        text = claim_file.text_of(held).replace("type: mqtt", "type: auto")
        with pytest.raises(InvalidInput, match="type: is 'auto', but must be"):
            claim_file.read(text, claim_file.path_of(held.key))


class TestContradictions:
    """A demand that contradicts an existing claim is refused, and the message names the claim."""

    @pytest.mark.parametrize(
        ("option", "stands", "asked"),
        [
            ("qos", "2", "0"),
            ("retained", "true", "false"),
            ("primitive", "true", "false"),
            ("reliability", "'reliable'", "''"),
            ("durability", "'volatile'", "''"),
            ("queue", "3", "0"),
            ("rate", "1.5", "0.0"),
            ("reverse", "true", "false"),
        ],
    )
    def test_another_way_to_carry_a_topic(self, option: str, stands: str, asked: str) -> None:
        value: Any = yaml.safe_load(stands)
        ledger = joined(Ledger(), Route("/a", "/b", **{option: value}))
        assert refusal(ledger, Route("/a", "/b")) == [
            f"connections[0].topics[0].{option}: {option} {asked} of '/a' contradicts an existing "
            f"claim: 'c' is held by v with {option} {stands}; use the same {option}, or a second "
            "connection"
        ]
        assert joined(ledger, Route("/a", "/b", **{option: value}), who="w") != ledger

    def test_another_message_type(self) -> None:
        ledger = joined(Ledger(), Route("/a", "/b", type=STRING))
        (found,) = refusal(ledger, Route("/a", "/b", type="std_msgs/msg/Bool"))
        assert found.startswith("connections[0].topics[0].type: type 'std_msgs/msg/Bool' of '/a'")

    def test_a_requester_cannot_contradict_its_own_claim(self) -> None:
        ledger = joined(Ledger(), Route("/a", "/b", qos=1))
        assert len(refusal(ledger, Route("/a", "/b", qos=2), who="v")) == 1

    def test_a_topic_that_somebody_has_carried_back_to_another(self) -> None:
        ledger = joined(Ledger(), Route("/a", "/x", reverse=True))
        assert refusal(ledger, Route("/b", "/x", reverse=True)) == [
            "connections[0].topics[0].target: connection 'c' is held by v and already carries '/x' "
            "back to '/a'; a connection carries a target topic back to only one source topic, so "
            "use a second connection"
        ]
        assert joined(ledger, Route("/b", "/x"), who="w")


def test_a_message_type_that_is_given_later_is_added_and_kept() -> None:
    ledger = joined(Ledger(), Route("/a", "/b"))
    ledger = joined(ledger, Route("/a", "/b", type=STRING))
    assert joined(ledger, Route("/a", "/b")) == ledger
    (held,) = ledger.connection_claims("c")
    assert held.connection.topics == (Route("/a", "/b", type=STRING),)


def test_a_reverse_route_delivers_to_the_source() -> None:
    ledger = joined(Ledger(), Route("/a", "/b"), Route("/c", "/d", reverse=True))
    assert ledger.is_carried_to("t", "/b")
    assert ledger.is_carried_to("s", "/c")
    assert not ledger.is_carried_to("t", "/d")


@pytest.mark.parametrize("kind", [ZENOH, ROS])
def test_links_are_known_at_both_nodes_as_long_as_somebody_holds_them(kind: ConnectionType) -> None:
    ledger = joined(Ledger(), Route("/a", "/a"), type=kind)
    ledger = joined(ledger, Route("/a", "/a"), type=kind, who="w")
    ledger = joined(ledger, Route("/a", "/a"), type=kind, id="d", target="u")
    first, second = ledger.connection_claims("c")
    assert (ledger.connections_at(kind, "s"), ledger.connections_at(kind, "t")) == (
        ("c", "d"),
        ("c",),
    )
    ledger = ledger.replace(first.key, None)
    assert ledger.connections_at(kind, "t") == ("c",)
    ledger = ledger.replace(second.key, None)
    assert (ledger.connections_at(kind, "s"), ledger.connections_at(kind, "t")) == (("d",), ())
