"""Processes compete for a Lease over real HTTP, with a clock that the tests move.

tests/e2e/test_deployment.py shows that a real API server accepts the Lease.
"""

from __future__ import annotations

import copy
import logging
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from demandops.base.errors import InvalidInput
from demandops.base.runtime import Runtime
from demandops.cluster import leadership
from demandops.cluster.leadership import Leadership
from kubernetes import client, config

from tests.kit.chance import IN_FULL
from tests.kit.clock import Turns
from tests.kit.http import Answer, Call, kubeconfig, serving
from tests.kit.limits import PATIENCE_S

PATH = "/apis/coordination.k8s.io/v1/namespaces/its/leases/generator"
TAKES_OVER_S = 15 + 2
"""At most this many seconds after a leader's last renewal, another process leads.

The Lease ends after 15 s, and the standbys poll it every 2 s.
"""


@dataclass
class Server:
    """A stand-in for an API server with one Lease.

    ``trouble`` tells whether the next call fails ``before`` or ``after`` its effect; ``takes`` is
    how many seconds it takes. ``ages`` has the ages of the Lease while a process leads.
    """

    turns: Turns
    lease: dict[str, Any]
    trouble: Callable[[], str] = lambda: ""
    takes: Callable[[], float] = lambda: 0
    api: Any = None
    processes: list[Process] = field(default_factory=list)
    renewed_at: float = 0
    ages: list[float] = field(default_factory=list)

    @property
    def age(self) -> float:
        return self.turns.monotonic() - self.renewed_at

    @property
    def spec(self) -> dict[str, Any]:
        return dict(self.lease.get("spec") or {})

    def answer(self, call: Call) -> Answer:
        assert call.path == PATH
        trouble = self.trouble()
        answer = Answer.json({"reason": "away"}, 503) if trouble == "before" else self._do(call)
        self.turns.pass_(self.takes())
        self.ages += [self.age for process in self.processes if process.leads]
        return Answer.json({"reason": "away"}, 503) if trouble == "after" else answer

    def _do(self, call: Call) -> Answer:
        if call.method == "PUT":
            given, version = call.json(), self.lease["metadata"]["resourceVersion"]
            if given["metadata"]["resourceVersion"] != version:
                return Answer.json({"reason": "Conflict"}, 409)
            given["metadata"]["resourceVersion"] = str(int(version) + 1)
            self.lease, self.renewed_at = given, self.turns.monotonic()
        return Answer.json(copy.deepcopy(self.lease))


class Process(Runtime):
    """A process that competes for the Lease, and that a test can kill."""

    def __init__(self, server: Server, may_lead: Callable[[], bool] = lambda: True) -> None:
        super().__init__()
        turns = server.turns
        self.turns, self.told = turns, list[str]()
        self.now, self.monotonic = turns.now, turns.monotonic  # type: ignore[method-assign]
        self.sleep, self.event = turns.sleep, turns.event  # type: ignore[method-assign]
        self.leadership = Leadership(
            "its/generator", may_lead, lambda: self.told.append("leader"), server.api, self
        )
        server.processes.append(self)

    def start_thread(self, name: str, target: Callable[[], object]) -> Any:
        self.thread = self.turns.start_thread(name, target)
        return self.thread

    @property
    def leads(self) -> bool:
        return self.leadership.is_leader and not self.is_dead

    @property
    def is_dead(self) -> bool:
        return bool(self.thread.dead) or self.told[-1:] == ["killed"]

    def kill(self) -> None:
        self.told.append("killed")
        self.turns.stop([self.thread])


@pytest.fixture
def seed() -> int:
    return 0


@pytest.fixture
def server(tmp_path: Path, seed: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setattr(leadership, "_CALL_S", PATIENCE_S)  # only the moved clock ends a call
    made = Server(Turns(seed), {"metadata": {"name": "generator", "resourceVersion": "1"}})
    with serving(made.answer) as running:
        reached = config.new_client_from_config(str(kubeconfig(tmp_path, running.url)))
        made.api = client.CustomObjectsApi(reached)
        yield made


def test_one_leads_and_the_other_takes_over_after_it_was_killed(
    server: Server, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "demandops")
    first = Process(server)
    server.turns.sleep(1)
    server.turns.set_by(86_400)  # the clocks of machines may differ
    second = Process(server)
    server.turns.sleep(60)
    assert (first.leads, second.leads, second.told) == (True, False, [])
    assert "standing by: the leader is '" in caplog.text
    first.kill()
    server.turns.sleep(10)
    assert not second.leads
    server.turns.sleep(TAKES_OVER_S - 10)
    assert (second.leads, second.told) == (True, ["leader"])
    assert server.spec["leaseTransitions"] == 2


def test_a_leader_that_stops_leaves_at_once(server: Server) -> None:
    first = Process(server)
    server.turns.sleep(1)
    second = Process(server)
    server.turns.sleep(5)
    first.leadership.close()
    assert server.spec["holderIdentity"] == ""
    server.turns.sleep(2)
    assert second.leads


def test_one_that_may_not_lead_yet_leaves_a_free_lease(server: Server) -> None:
    delivered: list[bool] = []
    one = Process(server, may_lead=lambda: bool(delivered))
    server.turns.sleep(30)
    assert (one.leads, server.spec) == (False, {})
    delivered.append(True)
    server.turns.sleep(2)
    assert one.leads


def test_one_that_took_the_lease_but_got_no_answer_leads_at_the_next_try(server: Server) -> None:
    calls = count()
    server.trouble = lambda: "after" if next(calls) == 1 else ""
    one = Process(server)
    server.turns.sleep(1)
    assert (one.leads, bool(server.spec["holderIdentity"])) == (False, True)
    server.turns.sleep(2)
    assert one.leads


TAKEN = {"metadata": {"resourceVersion": "7"}, "spec": {"holderIdentity": "a person"}}


@pytest.mark.parametrize(
    ("happens", "within_s", "why"),
    [
        ({"trouble": lambda: "before"}, 12, "was not renewed for 10 s (the Lease its/generator"),
        ({"takes": lambda: 12}, 30, "was not renewed for 10 s; another process may be the leader"),
        ({"lease": TAKEN}, 2, "is held by 'a person'; another process may be the leader now"),
    ],
)
def test_a_leader_ends_before_another_leads(
    server: Server, happens: dict[str, Any], within_s: float, why: str
) -> None:
    first = Process(server)
    server.turns.sleep(1)
    vars(server).update(happens)
    server.turns.sleep(within_s)
    assert not first.leads
    assert str(first.unsound).startswith(f"the Lease its/generator {why}")


def test_a_lease_that_cannot_be_read_is_told_once(
    server: Server, caplog: pytest.LogCaptureFixture
) -> None:
    server.trouble = lambda: "before"
    one = Process(server)
    server.turns.sleep(30)
    assert (one.is_dead, one.leads) == (False, False)
    (told,) = caplog.messages
    assert told.startswith("the Lease its/generator cannot be read or written: ServiceException: ")


@pytest.mark.parametrize("seed", range(4 if IN_FULL else 1))
def test_never_do_two_lead(server: Server, seed: int) -> None:
    """At random, calls take long, calls fail with or without effect, and processes are killed."""
    chance, turns, away_until = random.Random(seed), server.turns, [0.0]

    def trouble() -> str:
        if chance.random() < 0.02:
            away_until[0] = turns.monotonic() + chance.uniform(0, 40)
        if turns.monotonic() < away_until[0]:
            return chance.choice(["before", "after"])
        return chance.choices(["", "before", "after"], [8, 1, 1])[0]

    server.trouble, server.takes = trouble, lambda: chance.choice([0.01, chance.uniform(0, 2)])
    for _ in range(300):
        while sum(not one.is_dead for one in server.processes) < 3:
            Process(server)
        turns.sleep(chance.uniform(0, 1))
        assert sum(one.leads for one in server.processes) <= 1
        for one in [one for one in server.processes if not one.is_dead]:
            if chance.random() < 0.01:
                one.kill()
    assert max(server.ages) < 15
    assert sum("leader" in one.told for one in server.processes) > 1


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("its/generator", "needs a pod with a service account's token"),
        *((n, "names no Lease") for n in ("generator", "its/", "/generator", "Its/a", "a/b/c")),
    ],
)
def test_what_gives_no_lease_is_refused(
    monkeypatch: pytest.MonkeyPatch, name: str, told: str
) -> None:
    monkeypatch.delenv("KUBERNETES_SERVICE_HOST", raising=False)
    with pytest.raises(InvalidInput, match=f"^--leader-lease: .*{told}"):
        Leadership(name, lambda: True, list)
