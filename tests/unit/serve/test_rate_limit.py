"""How many demands a requester may send in a minute, and what the limiter keeps in memory."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone
from itertools import count

from demandops.model.config.load import load
from demandops.model.demand.claim import Application
from demandops.model.demand.demand_request import Demanded, Join
from demandops.serve.timing.timers import RateLimit

from tests.kit.config import configuration, edited

START = datetime(2026, 3, 1, 12, 0, tzinfo=timezone.utc)


class Sending:
    """Sends demands to a rate limit of two a minute."""

    def __init__(self) -> None:
        self.throttle = RateLimit()
        quotas = "    quotas: {demandsPerMinute: 2}\n    namespace:"
        policy = edited("policy/access-domains.yaml", "    namespace:", quotas)
        self._config = load(configuration(policy))
        self._names = map(str, count())

    def send(self, requester: str, at_s: float, operation: str = "") -> bool:
        """Send a demand; return whether the limit allowed it."""
        app = Application("edge/fusion", "object-detection-fusion", "edge", inputs={})
        request = Join("one", (Demanded(app, (requester,), "applications[0].{}".format),))
        moment, name = START + timedelta(seconds=at_s), operation or next(self._names)
        return not list(self.throttle.faults(request, self._config, name, moment))


def test_a_hand_in_that_is_judged_again_counts_once() -> None:
    sending = Sending()
    assert [sending.send("vehicle00", 0, "same") for _ in range(5)] == [True] * 5
    assert sending.send("vehicle00", 1)
    assert not sending.send("vehicle00", 2)


def test_who_sends_no_more_is_forgotten() -> None:
    sending = Sending()
    for number in range(500):
        assert sending.send(f"vehicle{number}", number)
    assert len(sending.throttle._seen) <= 62
    assert sending.send("vehicle499", 499.5)
    assert not sending.send("vehicle499", 499.6)


def test_a_clock_that_is_set_back_does_not_shut_anybody_out() -> None:
    sending = Sending()
    assert [sending.send("vehicle00", at) for at in (5000, 5001)] == [True, True]
    assert sending.send("vehicle00", 0)
