"""A running generator follows what people merge, even if no demand comes.

No test measures time: each wait ends with the expected event.
"""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from demandops.base.errors import QueueFull
from demandops.serve.generator import Generator

from tests.kit import rig
from tests.kit.cli import Run
from tests.kit.git_over_http import Server
from tests.kit.rig import Person, Stages, goal

NODES, SOON_S = "inventory/nodes.yaml", 0.1


def followed(bare: Path, made: str) -> str:
    """Wait until a generator has followed a person's commit; return the generator's commit."""
    rig.wait_until(lambda: rig.tip(bare) != made, "the generator follows")
    (commit,) = [c for c in rig.commits(bare, f"{made}..main") if c.one("Operation") == "follow"]
    assert commit.one("Follows") == made
    return commit.id


def test_off_means_off(url: str, bare: Path, person: Person, tmp_path: Path) -> None:
    with (
        rig.running(url) as off,
        rig.running(url, fetch_interval=SOON_S, data=tmp_path / "other") as on,
    ):
        rig.book(off, goal(1))
        known = str(off.snapshot.commit)
        made = person.edit("inventory/brokers.yaml", "service-mqtt-broker-edge", "elsewhere")
        commit = followed(bare, made)
        rig.wait_until(lambda: str(on.snapshot.commit) == commit, "the other generator follows")
        assert str(off.snapshot.commit) == known
        off.fetch_now()  # as after a webhook's call
        rig.wait_until(lambda: str(off.snapshot.commit) == commit, "the generator follows now")


# ---- the remote is slow, or away ----


def test_a_fetch_that_hangs_delays_no_demand(http: str, server: Server, bare: Path) -> None:
    with rig.running(http, fetch_interval=SOON_S) as generator:
        rig.book(generator, goal(1))
        hang = server.faults.hang = threading.Event()
        rig.wait_until(lambda: generator._repository._process, "a fetch is under way and hangs")  # type: ignore[attr-defined]
        talking = generator._repository._process  # type: ignore[attr-defined]
        stages = Stages()
        ticket = generator.submit(goal(2), listener=stages)
        rig.wait_until(
            lambda: "committed" in stages.names, "the demand is committed although the fetch hangs"
        )
        assert talking.poll() is not None, "the fetch must be ended for the demand"
        assert not generator.remote_status.unreachable
        server.faults.hang = None
        hang.set()
        assert rig.receipt(ticket).outcome == "booked"
    rig.assert_sound(bare)


def test_stopping_does_not_wait_for_a_look_that_hangs(http: str, server: Server) -> None:
    generator = Generator(http, fetch_interval=SOON_S)
    hang = server.faults.hang = threading.Event()
    try:
        rig.wait_until(lambda: generator._repository._process, "a fetch is under way and hangs")  # type: ignore[attr-defined]
        assert generator.stop(timeout=2 * rig.PATIENCE_S).result(rig.PATIENCE_S) is True
    finally:
        server.faults.hang = None
        hang.set()


def test_a_goal_is_told_why_it_waits_and_can_be_taken_back_meanwhile(
    http: str, server: Server, bare: Path
) -> None:
    with rig.running(http, fetch_interval=SOON_S) as generator:
        rig.book(generator, goal(1))
        server.faults.away = True
        rig.wait_until(
            lambda: generator.remote_status.unreachable, "the remote is known to be away"
        )
        stages = Stages()
        stays = generator.submit(goal(2), "op-2")
        goes = generator.submit(goal(3), "op-3", stages)
        rig.wait_until(lambda: stages.told, "the requester is told")
        ((stage, text),) = stages.told
        assert stage == "away" and http in text and "503" in text
        assert generator.withdraw("op-3") is True
        assert rig.outcome(goes) == "Withdrawn"
        assert not stays.future.done()
        assert generator.snapshot.state.ledger.claims_with("requester", "user1"), (
            "the known state must stay readable"
        )
        server.faults.away = False
        assert rig.outcome(stays) == "booked"
    assert rig.operations(bare)[-1] == "op-2"


def test_a_full_queue_says_that_the_remote_is_away(http: str, server: Server) -> None:
    with rig.running(http, fetch_interval=SOON_S, queue_limit=3) as generator:
        server.faults.away = True
        rig.wait_until(
            lambda: generator.remote_status.unreachable, "the remote is known to be away"
        )
        tickets = [generator.submit(goal(number)) for number in range(500)]
        # the worker may take demands from the queue into its batch, so the last may find room
        rig.wait_until(lambda: any(one.future.done() for one in tickets), "a demand is refused")
        refused = next(one for one in tickets if one.future.done())
        with pytest.raises(QueueFull, match=r"503"):
            rig.receipt(refused)
        server.faults.away = False


# ---- what the command line reports ----


def test_views_go_on_while_something_is_not_valid_and_say_so(
    bare: Path, person: Person, demandops: Run
) -> None:
    first = "  - id: vehicle00\n    type: vehicle\n    cluster: "
    with rig.running(bare, fetch_interval=SOON_S) as generator:
        rig.book(generator, goal(1))
        made = person.edit(NODES, f"{first}c-its", f"{first}c-itz")
        followed(bare, made)
    status = demandops("status", "--state-repo", bare)
    problem, mend = (line.strip() for line in status.out.splitlines()[1:3])
    assert problem.startswith(f"{NODES}:") and f"(since {made[:10]} by Petra" in problem
    assert mend.endswith(f"git revert --no-edit -m 1 {made[:10]}")
    assert "of-edge-fusion-1" in status.out
    assert (status.code, "problems in files: 1" in status.err) == (1, True)
    (told,) = demandops("status", "--state-repo", bare, "--output", "json").json()["faults"]
    assert (told["file"], told["field"], told["since"]) == (NODES, "nodes[0].cluster", made)
    books = demandops("bookkeeping", "--state-repo", bare)
    assert (books.code, "edge/fusion-1" in books.out) == (0, True)
    assert books.err.splitlines() == [f"warning: not in effect: {problem}", f"warning: {mend}"]
