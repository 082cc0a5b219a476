"""Shared parts of the commands that change the ledger: booking, and printing the changes."""

from __future__ import annotations

import signal
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from demandops.cli.json_output import Json
from demandops.cli.output import busy, console, errors, progress
from demandops.cli.views.diff import release_lines
from demandops.decision import Decision
from demandops.errors import Fault
from demandops.service import Generator, Receipt

_LOOK_UP_S = 0.5


def await_answer(future: Future[Any]) -> None:
    """Wait until a demand has an answer; Ctrl-C and SIGTERM interrupt the wait."""
    # Polled, because a wait without a timeout could miss a signal that arrives just before the wait
    # begins, or a signal that another library handles.
    while not future.done():
        wait([future], timeout=_LOOK_UP_S)


def booked(generator: Generator, goal: Json) -> Receipt:
    """Submit a goal, and return its receipt when it is published."""
    ticket = generator.submit(goal)
    with busy("booking"):
        await_answer(ticket.future)
    return ticket.future.result()


@contextmanager
def started_generator(state_repo: str, signing_key: Path | None) -> Iterator[Generator]:
    # within the block, SIGTERM acts like Ctrl-C
    before = signal.getsignal(signal.SIGTERM)
    with suppress(ValueError):  # only the main thread may set a handler
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with progress("reading the ledger") as report:
            generator = Generator(
                state_repo,
                requester_limit=None,  # the command is its only client
                start_offline=False,
                signing_key=signing_key,
                progress=report,
            )
        try:
            yield generator
        finally:
            if not generator.close(timeout=0):
                errors.print(
                    "accepted demands that are not published stay in the journal (`demandops "
                    "journal` lists them); the next generator that starts on this machine for this "
                    "state repo continues with them"
                )
    finally:
        with suppress(ValueError):
            signal.signal(signal.SIGTERM, before)


def print_consequences(decision: Decision) -> None:
    out = console()
    for line in release_lines(decision.releases):
        out.print(f"  {line}", soft_wrap=True)
    for path, text in sorted(decision.files.items()):
        out.print(f"  {'remove' if text is None else 'write '} {path}", soft_wrap=True)


def print_refusal(title: str, faults: Iterable[Json]) -> None:
    errors.print(title)
    for each in faults:
        errors.print(f"  {Fault(**each)}")


def claim_text(claim: Json) -> str:
    return f"{claim['subject']['kind']} '{claim['subject']['id']}'"
