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
from tests.kit.git_over_http import Server
from tests.kit.rig import Person, Stages, goal

SOON_S = 0.1


def test_off_means_off(url: str, bare: Path, person: Person, tmp_path: Path) -> None:
    with (
        rig.running(url) as off,
        rig.running(url, fetch_interval=SOON_S, data=tmp_path / "other") as on,
    ):
        rig.book(off, goal(1))
        known = str(off.snapshot.commit)
        made = person.edit("inventory/brokers.yaml", "service-mqtt-broker-edge", "elsewhere")
        rig.wait_until(lambda: rig.tip(bare) != made, "the other generator follows")
        commit = rig.tip(bare)
        rig.wait_until(lambda: str(on.snapshot.commit) == commit, "the other generator knows")
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


@pytest.mark.parametrize("sends", [False, True], ids=["a look", "a push"])
def test_stopping_does_not_wait_for_a_server_that_never_answers(
    http: str, server: Server, bare: Path, sends: bool
) -> None:
    generator = Generator(http, fetch_interval=0 if sends else SOON_S)
    hang = server.faults.hang = threading.Event()
    try:
        if sends:
            generator.submit(goal(1), "op-1")
        rig.wait_until(lambda: server.faults.hanging, "the server has a request")
        stopped = generator.stop(timeout=0.5 if sends else 2 * rig.PATIENCE_S)
        assert stopped.result(rig.PATIENCE_S) is not sends
    finally:
        server.faults.hang = None
        hang.set()
    assert rig.restart(http) is True
    assert rig.operations(bare) == ["op-1"] * sends


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
