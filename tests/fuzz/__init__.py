"""Fuzzing: the program accepts any input from outside, or refuses it with an expected exception.

``make fuzz`` gives each target ``FUZZ_S`` seconds. Atheris drives the targets that take bytes: it
searches for inputs that reach new lines of our code. Hypothesis drives the targets that take other
values. An input is a finding if it causes an unexpected exception, takes over a second of processor
time, or needs too much memory. The input and the traceback are in ``build/fuzz/<target>/``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from demandops.base.errors import InvalidInput, StateRepoError
from hypothesis import strategies as st


@dataclass(frozen=True)
class Target:
    """A check of bytes like the ``seeds``, or of ``values``; other errors are findings."""

    check: Callable[[Any], object]
    seeds: tuple[bytes, ...] = ()
    values: st.SearchStrategy[Any] | None = None
    expected: tuple[type[Exception], ...] = (InvalidInput, StateRepoError)
    names_files: bool = False
    """Whether each fault must name its file."""

    @property
    def name(self) -> str:
        return self.check.__name__.strip("_").replace("_", "-")
