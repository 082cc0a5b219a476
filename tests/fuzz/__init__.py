"""Fuzzing: whatever comes from outside is taken, or refused in the words that are meant for it.

``make fuzz`` gives each target ``FUZZ_S`` seconds. A target of bytes is driven by atheris, which
looks for inputs that reach other lines of ours; one of values by Hypothesis. A finding is every
other exception, a call that computes for over a second, and one that needs too much memory. Its
input and its traceback are in ``build/fuzz/<target>/``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from demandops.errors import InvalidInput, StateRepoError
from hypothesis import strategies as st


@dataclass(frozen=True)
class Target:
    """A check of anything. It raises only ``expected``, else the input is a finding.

    ``seeds`` are inputs of a target of bytes. One of values has ``values`` instead.
    """

    check: Callable[[Any], object]
    seeds: tuple[bytes, ...] = ()
    values: st.SearchStrategy[Any] | None = None
    expected: tuple[type[Exception], ...] = (InvalidInput, StateRepoError)

    @property
    def name(self) -> str:
        """The name of its check."""
        return self.check.__name__.strip("_").replace("_", "-")
