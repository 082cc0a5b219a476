"""The detector sends one goal of an event at a time, and a failed goal again while it is wanted."""

from __future__ import annotations

from demandops.detect.detector import Outcome, Sending, Want, WantedDemands
from demandops.detect.rule_file import Goal

KEY = ("rule", ("a",))
PUT = Goal("demand", {"demand": "d", "requesters": ["a"], "applications": [1]})
OTHER = Goal("demand", {"demand": "d", "requesters": ["a"], "applications": [2]})
JOIN = Goal("deployment_request", {"id": "r", "apps": []})


class Sent:
    """The goals that are wanted for one event, sent one at a time."""

    def __init__(self) -> None:
        self.wanted = WantedDemands()

    def want(self, goal: Goal | None, **more: float) -> None:
        self.wanted.want(Want(KEY, goal, **more))

    def next(self, now: float) -> Sending:
        sending = self.wanted.next(now)
        assert sending is not None
        return sending

    def done(self, now: float, lease_s: float = 0.0, code: str = "", message: str = "") -> str:
        """Send and answer the next goal; return the goal's purpose.

        If ``code`` is given, the goal fails with this code. Then return the text for the log
        instead of the purpose.
        """
        sending = self.next(now)
        told = self.wanted.answered(sending, Outcome(code, message, lease_s), now)
        assert code or not told
        return told if code else sending.purpose


def test_a_demand_is_sent_renewed_after_a_third_of_its_lease_and_ended() -> None:
    sent = Sent()
    sent.want(PUT)
    assert sent.done(0, lease_s=9) == "start"
    assert sent.wanted.next(2.9) is None
    assert sent.wanted.next_at() == 3
    assert sent.done(3, lease_s=9) == "renew"
    sent.want(None)
    assert sent.next(3).goal.data == {
        "demand": "d",
        "requesters": ["a"],
        "operation": "release",
    }
    assert len(sent.wanted) == 1


def test_a_demand_that_ends_before_it_is_sent_is_never_sent() -> None:
    sent = Sent()
    sent.want(PUT)
    sent.want(None)
    assert sent.wanted.next(0) is None
    assert len(sent.wanted) == 0


def test_a_demand_that_ends_while_its_put_is_under_way_is_ended_after_the_answer() -> None:
    sent = Sent()
    sent.want(PUT)
    under_way = sent.next(0)
    sent.want(None)
    assert sent.wanted.next(0) is None, "only one goal may be under way"
    sent.wanted.answered(under_way, Outcome(), 1)
    assert sent.done(1) == "end"
    assert len(sent.wanted) == 0


def test_a_refused_demand_is_told_once_and_sent_again_as_its_rule_says() -> None:
    sent = Sent()
    sent.want(PUT, retry_s=7)
    assert sent.done(0, code="unknown-node", message="no") == "no"
    assert [*sent.wanted.refusals()] == [(KEY, "no")]
    assert sent.wanted.next(6.9) is None
    assert sent.done(7, code="unknown-node", message="no") == ""
    assert sent.done(14, code="quota", message="full") == "full"
    assert sent.done(21) == "start"
    assert sent.wanted.unanswered() == 0


def test_a_demand_without_an_answer_is_sent_again_or_ended() -> None:
    sent = Sent()
    sent.want(PUT)
    sent.done(0, code="timeout", message="late")
    assert sent.wanted.unanswered() == 1
    sent.want(None)
    assert sent.next(0).purpose == "end", "a demand that may be booked must be ended"


def test_a_demand_that_ended_meanwhile_is_put_again() -> None:
    sent = Sent()
    sent.want(PUT)
    sent.done(0, lease_s=3)
    sent.done(1, code="not-held", message="it ended")
    assert sent.done(1) == "start"


def test_a_changed_demand_is_put_and_a_changed_request_is_ended_first() -> None:
    sent = Sent()
    sent.want(PUT)
    sent.done(0)
    sent.want(OTHER)
    assert sent.next(0).goal == OTHER
    sent = Sent()
    sent.want(JOIN)
    sent.done(0)
    changed = Goal("deployment_request", {"id": "r", "apps": [1]})
    sent.want(changed)
    assert sent.next(0).goal.data == {"id": "r", "apps": [], "shutdown": True}


def test_a_request_is_sent_again_as_often_as_its_rule_says() -> None:
    sent = Sent()
    sent.want(JOIN, renew_s=60)
    sent.done(0)
    assert sent.wanted.next_at() == 60
    assert sent.next(60).goal == JOIN


def test_a_demand_booked_before_the_start_is_renewed_at_once_and_not_put_again() -> None:
    sent = Sent()
    sent.wanted.hold(KEY, PUT)
    sent.want(PUT)
    assert sent.done(0, lease_s=30) == "renew"
    assert sent.wanted.next(9.9) is None
    assert sent.wanted.next_at() == 10


def test_an_event_waits_until_another_one_has_ended_the_demand_with_the_same_id() -> None:
    """A renamed rule may demand under the same id as before.

    Then the release of the demand of the old name must not end the demand of the new name.
    """
    sent = Sent()
    sent.want(PUT)
    assert sent.done(0) == "start"
    sent.want(None)
    sent.wanted.want(Want(("new", ("a",)), OTHER))
    ending = sent.next(1)
    assert ending.purpose == "end"
    assert sent.wanted.next(1) is None
    assert 1 < sent.wanted.next_at() < 2
    assert sent.wanted.answered(ending, Outcome(), 1) == ""
    assert sent.next(2) == Sending(("new", ("a",)), "start", OTHER)
