"""The end state is right although a part is killed and restarted in each step of the experiment."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.e2e.common import expected
from tests.e2e.common.domain import Domain
from tests.e2e.common.expected import STEPS
from tests.e2e.common.world import World
from tests.e2e.rig.tools import Report

Act = Callable[[World, dict[str, Any]], None]


def test_eight_steps_with_a_kill_in_each(world: World, say: Report) -> None:
    domain = world.domain
    at_first = domain.inventory()
    for step in STEPS:
        before = world.tip()
        what, play = KILLS[step]
        play(world, expected.demand(step))
        domain.wait_lines(expected.after(step))
        say(f"  {step}: {what}: the end state is reached")
        assert world.commits_since(before) == 1, "one demand must become one commit"
    domain.wait_inventory(at_first)


def kill(part: str, reached: Callable[[Domain, str], object]) -> Act:
    """Return what demands a goal, and kills a part once the goal's commit has got so far.

    `part` is the attribute of the domain that has the name of the controller's program.
    """

    def act(world: World, goal: dict[str, Any]) -> None:
        sent = world.demand(goal)
        world.domain.wake()
        reached(world.domain, sent.commit)
        program = getattr(world.domain, part)
        world.rig.parts.kill(program)
        world.rig.parts.start(program)
        world.domain.wake()

    return act


def a_release_is_begun(domain: Domain, _: str) -> None:
    domain.kube.wait("a release", lambda: domain.find(domain.RELEASE) or None)


def told_to_fetch(_: Domain, __: str) -> None:
    """Do not wait."""


def send_until_committed(world: World, goal: dict[str, Any]) -> None:
    world.client.ready()
    sent = world.client.send(goal)
    world.client.wait(lambda: "committed" in sent.stages)


def generator_without_git(world: World, goal: dict[str, Any]) -> None:
    """Kill the generator while it cannot push its commit; the next generator pushes the commit."""
    before = world.tip()
    world.rig.parts.stop("git")
    try:
        send_until_committed(world, goal)
        world.generator.kill()
    finally:
        world.rig.parts.start("git")
    assert world.tip() == before
    world.generator.start()
    world.domain.kube.wait(
        "the push of what was committed before the kill", lambda: world.tip() != before
    )
    world.domain.wake()


def generator_while_pushing(world: World, goal: dict[str, Any]) -> None:
    """Kill the generator in a `git push`, then start it again and send the goal again.

    The push survives the generator and may succeed. The next generator must notice this, so that
    the repeated goal makes no second commit. The goal must be a join: a repeated shutdown never
    makes a second commit, so it would prove nothing.
    """
    world.rig.parts.pause("git")
    try:
        send_until_committed(world, goal)
        world.domain.kube.wait("a push", lambda: pushes(world.url))
        world.generator.kill()
    finally:
        world.rig.parts.resume("git")
    world.generator.start()
    world.demand(goal)
    world.domain.wake()


def pushes(url: str) -> bool:
    commands = [path.read_bytes() for path in Path("/proc").glob("[0-9]*/cmdline")]
    return any(b"push" in line and url.encode() in line for line in commands)


KILLS: dict[int, tuple[str, Act]] = {
    1: ("the installer while it installs", kill("INSTALLER", a_release_is_begun)),
    2: ("the generator, with a commit that it could not push", generator_without_git),
    3: ("the applier while it applies", kill("APPLIER", Domain.wait_fetched)),
    4: ("the generator while it pushes", generator_while_pushing),
    5: ("the installer while it uninstalls", kill("INSTALLER", Domain.wait_applied)),
    6: ("the applier while it prunes", kill("APPLIER", Domain.wait_fetched)),
    7: ("the fetcher while it fetches", kill("FETCHER", told_to_fetch)),
    8: ("the fetcher at the last commit", kill("FETCHER", told_to_fetch)),
}
