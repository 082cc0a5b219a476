"""A generator whose threads run one at a time: a seed decides everything that it does."""

from __future__ import annotations

import shutil
import threading
from pathlib import Path

from demandops.serve.generator import Generator

from tests.kit import rig
from tests.kit.clock import Turns


def history(seed: int, template: Path, folder: Path) -> list[str]:
    """Return the commits' ids after random demands, sent to a busy or idle generator."""
    bare = Path(shutil.copytree(template, folder / "state.git"))
    turns = Turns(seed)
    threads = threading.active_count()
    generator = Generator(str(bare), data=folder / "data", runtime=turns)
    tickets = []
    for _ in range(12):
        number = turns.chance.randrange(3)
        tickets.append(generator.submit(turns.chance.choice([rig.goal(number), rig.leave(number)])))
        turns.sleep(turns.chance.choice([0, 0.001, 40]))
    stopped = generator.stop()
    turns.wait(stopped.done)
    assert stopped.result() and all(ticket.future.done() for ticket in tickets)
    assert threading.active_count() == threads
    rig.assert_sound(bare)
    return [commit.id for commit in rig.commits(bare)]


def test_resumed_demands_are_answered_in_the_order_of_their_commits(
    bare: Path, tmp_path: Path
) -> None:
    base = rig.tip(bare)
    with rig.running(bare) as generator:
        rig.receipt(generator.submit(rig.goal(2), "op-2"))
    # a journal as if the process had died before op-2's answer and op-1's publication
    turns, answered = Turns(1), []
    rig.leave_in_journal(
        tmp_path,
        *(
            rig.journaled(f"op-{number}", rig.goal(number), turns.now().isoformat(), base)
            for number in (1, 2)
        ),
    )
    generator = Generator(str(bare), data=tmp_path, runtime=turns)
    for operation, ticket in generator._demands._journal.pending.items():
        ticket.future.add_done_callback(lambda _, operation=operation: answered.append(operation))
    turns.wait(generator.stop().done)
    assert answered == rig.operations(bare) == ["op-2", "op-1"]


def test_a_seed_decides_what_is_committed(bare_template: Path, tmp_path: Path) -> None:
    once, again, other = (
        history(seed, bare_template, tmp_path / name)
        for seed, name in ((1, "once"), (1, "again"), (2, "other"))
    )
    assert once == again != other
    assert len(once) > 3
