"""Generators in this process, listeners that follow their demands, and all else for their tests."""
# ruff: noqa: F401 - tests import from here what is imported here

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from demandops.base.errors import InvalidInput
from demandops.serve.generator import Generator
from demandops.serve.journal import Receipt, Ticket

from tests.kit.goals import Goal, impossible, leave
from tests.kit.goals import numbered as goal
from tests.kit.limits import PATIENCE_S
from tests.kit.memory import NOW, books_after
from tests.kit.processes import Drivers, Told, demand, listen, listen_to_all
from tests.kit.repo import (
    Commit,
    Person,
    assert_sound,
    away,
    books,
    branches,
    claims,
    commits,
    differing,
    git,
    hook,
    lose,
    operations,
    root,
    tip,
)


@contextmanager
def running(address: str | Path, **options: Any) -> Iterator[Generator]:
    generator = Generator(str(address), **options)
    try:
        yield generator
    finally:
        generator.close(PATIENCE_S)


def restart(address: str | Path) -> bool:
    """Start and close a generator; return whether it published all demands of its journals."""
    return Generator(str(address)).close(timeout=PATIENCE_S)


def receipt(ticket: Ticket) -> Receipt:
    return ticket.future.result(PATIENCE_S)


def outcome(ticket: Ticket) -> str:
    """Return a demand's outcome, the code of its first fault, or the name of its error's class."""
    error = ticket.future.exception(PATIENCE_S)
    if isinstance(error, InvalidInput):
        return error.faults[0].code
    return type(error).__name__ if error else receipt(ticket).outcome


def journaled(operation: str, made: object, received: str, base: str) -> Ticket:
    """Return a ticket as in the journal of a generator that died before it answered a demand."""
    data = {"operation": operation, "goal": made, "received": received, "base": base}
    return Ticket.from_data(data)


def wait_until_queued(tickets: Iterable[Ticket]) -> None:
    for ticket in tickets:
        assert ticket.journaled.result(PATIENCE_S)


def book(generator: Generator, *goals: Goal) -> list[Receipt]:
    return [receipt(generator.submit(made)) for made in goals]


class Gate:
    """A listener that blocks the worker at an admitted demand until a test sets ``open``.

    After ``PATIENCE_S``, it blocks no longer.
    """

    def __init__(self) -> None:
        self.reached = threading.Event()
        self.open = threading.Event()

    def __call__(self, stage: str, text: str) -> None:
        if stage == "admitted":
            self.reached.set()
            self.open.wait(PATIENCE_S)


@contextmanager
def busy(generator: Generator, made: Goal, operation: str | None = None) -> Iterator[Ticket]:
    """Keep the worker busy with a demand for the length of a block."""
    gate = Gate()
    ticket = generator.submit(made, operation, gate)
    try:
        assert gate.reached.wait(PATIENCE_S)
        yield ticket
    finally:
        gate.open.set()


@dataclass
class Stages:
    told: list[tuple[str, str]] = field(default_factory=list)

    def __call__(self, stage: str, text: str) -> None:
        self.told.append((stage, text))

    @property
    def names(self) -> list[str]:
        return [stage for stage, _ in self.told]


def wait_until(true: Callable[[], object], what: str) -> None:
    end = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < end, f"not true within {PATIENCE_S:.0f} s: {what}"
        time.sleep(0.01)


class Proposed:
    def __init__(self, generator: Generator, made: Any, operation: str | None = None) -> None:
        stages = Stages()
        self.told = stages.told
        self.ticket: Ticket = generator.submit(made, operation, stages)

    @property
    def branch(self) -> str:
        def proposed() -> list[str]:
            return [text for stage, text in self.told if stage == "proposed"]

        wait_until(proposed, "the demand is proposed")
        assert proposed()[-1].startswith("awaiting approval: demand/")
        name = proposed()[-1].split()[2]
        assert name.isascii() and len(name) < 70, "whatever ids the demand has"
        return name

    def outcome(self) -> str:
        return outcome(self.ticket)
