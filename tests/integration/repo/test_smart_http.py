"""The state repo on a real smart-HTTP server, which loses answers or is away."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from demandops.base.errors import StateRepoError
from demandops.serve.generator import Generator

from tests.kit import rig
from tests.kit.clock import Clock
from tests.kit.git_over_http import Server, serving
from tests.kit.rig import goal, leave


def _cut(server: Server) -> None:
    """Let the server take the next push without an answer, and then be away."""
    server.faults.cut_answers, server.faults.away_after_cut = 1, True


def _come_back(server: Server, clock: Clock) -> None:
    rig.wait_until(lambda: server.refused > 3, "the server was asked again in vain")
    clock.pass_(5)  # a repeated commit would get another time and id
    server.faults.away = server.faults.away_after_cut = False


def test_a_demand_counts_once_when_the_answer_to_its_push_is_lost(
    http: str, server: Server, bare: Path
) -> None:
    with rig.running(http) as generator:
        server.faults.cut_answers = 1
        receipt = rig.receipt(generator.submit(goal(1), "op-1"))
        assert receipt.commit == rig.tip(bare)
        server.faults.cut_answers = 1
        assert rig.outcome(generator.submit(leave(1), "op-2")) == "released"
    assert server.taken == 2
    assert rig.operations(bare) == ["op-1", "op-2"]
    rig.assert_sound(bare)


def test_demands_count_once_when_the_server_goes_away_before_it_answers_the_push(
    http: str, server: Server, bare: Path, clock: Clock
) -> None:
    """Other demands come while the generator cannot ask whether the server took the push."""
    with rig.running(http, runtime=clock) as generator:
        rig.book(generator, goal(0))
        _cut(server)
        with rig.busy(generator, goal(1), "op-1") as first:
            tickets = [first, generator.submit(leave(0), "op-2")]
        rig.wait_until(lambda: server.faults.away, "the server has taken the push and is away")
        tickets.append(generator.submit(goal(3), "op-3"))
        assert not first.future.done()
        _come_back(server, clock)
        commits = [rig.receipt(ticket).commit for ticket in tickets]
    assert rig.operations(bare)[1:] == ["op-1", "op-2", "op-3"]
    assert commits == [commit.id for commit in rig.commits(bare)][1:]
    assert rig.books(bare) == rig.books_after(map(goal, (1, 3)))
    rig.assert_sound(bare)


def test_a_push_is_repeated_until_the_server_takes_it(bare: Path) -> None:
    """An error 503 is no refusal, even if the URL has `403`, `denied` and `rejected` in it."""
    prefix = "/403/denied-and-rejected"
    with serving(bare.parent, prefix) as server, rig.running(f"{server.url}/state.git") as one:
        server.faults.pushes_to_refuse, server.faults.status = 3, 503
        rig.book(one, goal(1))
        assert server.refused == 3


def test_a_server_that_forbids_the_push_is_told_and_not_asked_for_ever(
    http: str, server: Server, bare: Path
) -> None:
    with rig.running(http, refusal_patience_s=0.5) as generator:
        server.faults.pushes_to_refuse, server.faults.status = 1000, 403
        with pytest.raises(StateRepoError, match="rejects the push"):
            rig.receipt(generator.submit(goal(1)))
        server.faults.pushes_to_refuse = 0
        rig.book(generator, goal(2))
    assert rig.books(bare) == rig.books_after([goal(2)])


def test_closing_does_not_wait_for_a_server_that_never_answers(
    http: str, server: Server, bare: Path
) -> None:
    generator = Generator(http)
    rig.book(generator, goal(1))
    server.faults.hang = threading.Event()
    try:
        generator.submit(goal(2), "op-2")
        rig.wait_until(lambda: server.faults.hanging, "the server has a request")
        published = generator.stop(timeout=0.5).result(rig.PATIENCE_S)
    finally:
        server.faults.hang.set()
        server.faults.hang = None
    assert published is False
    assert rig.restart(http) is True
    assert rig.operations(bare)[-1] == "op-2"
