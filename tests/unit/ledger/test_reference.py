"""Holds are counted as the reference counts requesters: a list for each topic.

A join extends the lists; a shutdown removes one entry of each requester that it names. The
reference counts a join that is sent again twice and we do not, so none is.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from datetime import datetime, timedelta, timezone
from random import Random
from types import MappingProxyType

from demandops.connections.connection import Connection
from demandops.connections.mqtt import MQTT
from demandops.connections.route import Route
from demandops.demand.application import Application, InputTopic
from demandops.demand.claim import ClaimKey, demand_id
from demandops.demand.demand_request import Demanded, Join, Shutdown
from demandops.errors import Refused
from demandops.ledger.ledger import Ledger
from demandops.ledger.operations.join import join
from demandops.ledger.operations.shutdown import shut_down
from demandops.ledger.recent_shutdowns import REMEMBERED
from demandops.subject import Subject, TopicKey

from tests.kit.chance import TIMES

PEOPLE = ("station00", "vehicle00", "vehicle01")
Lists = dict[tuple[Subject, TopicKey], list[str]]


def some(random: Random, among: str | tuple[str, ...]) -> tuple[str, ...]:
    return tuple(random.sample(among, random.randint(1, len(among))))


def demanded(random: Random) -> Demanded:
    """Return some topics of an application or a connection, for some requesters."""
    topics = [f"/{name}" for name in some(random, "abc")]
    inputs = {"ego_data": tuple(InputTopic(topic, "vehicle00") for topic in topics)}
    routes = tuple(Route(topic, topic) for topic in topics)
    app = Application("edge/fusion", "object-detection-fusion", "edge", MappingProxyType(inputs))
    connection = Connection("vehicle00/edge", MQTT, "vehicle00", "edge", "edge", routes)
    return Demanded(random.choice([app, connection]), some(random, PEOPLE), str)


def listed(one: Demanded) -> Iterator[tuple[tuple[Subject, TopicKey], str]]:
    """Yield each topic and each requester of it."""
    for topic in one.held.topic_keys():
        for who in one.requesters:
            yield (one.held.subject, topic), who


def counted(ledger: Ledger) -> Lists:
    """Return the requesters of each topic as often as they hold it."""
    lists: Lists = defaultdict(list)
    for claim in ledger:
        for topic in claim.held.topic_keys():
            lists[claim.subject, topic] += claim.holders(topic)
    return {key: sorted(who) for key, who in lists.items()}


def repeats(ledger: Ledger, request: Join) -> bool:
    """Return whether a join asks once more for a topic that its own claim has."""
    (one,) = request.demanded
    own = ledger.get(ClaimKey(one.held.subject, demand_id(request.id, one.requesters)))
    return own is not None and bool({*own.held.topic_keys()} & {*one.held.topic_keys()})


def test_topics_have_the_requesters_that_the_reference_counts() -> None:
    for seed in range(300 * TIMES):
        random, ledger, lists = Random(seed), Ledger(), Lists()
        now = datetime(2026, 1, 31, tzinfo=timezone.utc)
        for _ in range(30):
            now += REMEMBERED + timedelta(minutes=2)  # none repeats a shutdown
            request = random.choice([Join, Shutdown])(random.choice("rs"), (demanded(random),))
            asked = list(listed(request.demanded[0]))
            if isinstance(request, Shutdown):
                held = [(key, who) for key, who in asked if who in lists.get(key, ())]
                for key, who in held:
                    lists[key].remove(who)
                try:
                    ledger, changes = shut_down(ledger, request, now)
                except Refused:
                    assert not held, seed
                else:
                    assert held, seed
                    assert bool(changes.not_held) == (len(held) < len(asked)), seed
                    assert shut_down(ledger, request, now + REMEMBERED)[0] is ledger, seed
            elif not repeats(ledger, request):
                ledger, _ = join(ledger, request, now)
                for key, who in asked:
                    lists.setdefault(key, []).append(who)
            assert counted(ledger) == {key: sorted(who) for key, who in lists.items() if who}, seed
